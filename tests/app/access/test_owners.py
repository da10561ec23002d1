"""Owners and their keys: who is let in, what is another's, what they take away and what is left of them."""

from __future__ import annotations

import base64
import hashlib
import inspect
import io
import itertools
import json
import re
import time
import zipfile
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
from fastapi.routing import APIRoute
from sqlalchemy import func, select, update
from starlette.testclient import TestClient
from states import Steps, failed, finish, services_of
from typer.testing import CliRunner
from uploads import receive

from app.blobs.account_data import erase, zipped
from app.blobs.storage import Storage
from app.client import Client
from app.main import create_app
from app.pages import pictures
from app.pages import routes as page_routes
from app.runtime import supervisor
from app.runtime.settings import Settings
from app.store import Store, accounts, tables
from app.store.owners import ANY_OWNER, now
from lensmodel.cli.console import UsageError
from lensmodel.cli.main import app
from lensmodel.core.errors import InvalidInputError

METHODS = ("GET", "POST", "PUT", "PATCH", "DELETE")
OPEN = {"/healthz", "/readyz", "/sign-in", "/v1/session"}


@pytest.fixture
def guarded(settings: Settings, store: Store, monkeypatch: pytest.MonkeyPatch) -> Iterator[TestClient]:
    """Speak with a service that asks for keys, and looks for each request whether they are valid still."""
    monkeypatch.setattr("app.access.FRESH_S", 0.0)
    closed = settings.model_copy(update={"auth": "keys"})
    with TestClient(create_app(closed), raise_server_exceptions=False) as opened:
        yield opened


def key_of(store: Store, owner: str, scope: accounts.Scope = "admin", **options: Any) -> dict[str, str]:
    return {"Authorization": f"Bearer {store.accounts.create_key(owner, [scope], **options)}"}


def furnish(client: TestClient, steps: Steps, owner: str) -> dict[str, str]:
    """Give an owner a counted photo, its lens and a finished correction; return their ids."""
    steps.owner = owner
    photo = steps.counted()
    services_of(client).storage.put(photo.blob_key, b"the original of " + owner.encode())
    row = steps.correct(photo, method="fast", strength=1.0, output={"format": "dng"}, roi=None)
    finish(client, row.public_id)
    ids = {"photo_id": photo.public_id, "job_id": photo.public_id, "correction_id": row.public_id}
    return {"lens_id": steps.lens_id(photo), **ids}


def body_of(path: str, method: str, ids: dict[str, str]) -> dict[str, Any]:
    """Return what a right request has besides its address: nothing else may be what is refused."""
    if method == "PATCH":
        return {"json": {"label": "mine"} if path.startswith("/v1/lenses") else {"aperture": 2.8}}
    bodies: dict[str, dict[str, Any]] = {
        "/v1/corrections": {"json": {"photo_id": ids["photo_id"]}},
        "/v1/photos": {"content": b"\xff\xd8\xff" + bytes(64), "params": {"lens_id": ids["lens_id"]}},
        "/v1/session": {"json": {"key": "x"}},
    }
    return bodies.get(path, {}) if method == "POST" else {}


# Parts of paths that name nobody's thing
PARTS = {"suffix": "json", "form": "pdf", "which": "after", "name": "before"}
PARTS |= dict.fromkeys(("half", "col", "row", "place"), "0")


def requests(client: TestClient, ids: dict[str, str]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield every path with every method: those of the OpenAPI document, and the pages that are not in it."""
    app: Any = client.app
    described = set(app.openapi()["paths"])
    rooms = (page_routes, pictures)  # a stream of events has no end
    hidden = [route for room in rooms for route in room.router.routes] + page_routes.strangers.routes
    pages = {
        route.path.replace("{kind}/{subject}", subject)
        for route in hidden
        if isinstance(route, APIRoute)
        for subject in ("photos/{photo_id}", "corrections/{correction_id}")
    }
    for path, method in itertools.product(sorted(described | pages), METHODS):
        if method == "DELETE" and path == "/v1/account":
            continue  # of the one who asks; it would end the walk
        address = re.sub(r"\{(\w+)\}", lambda found: ids.get(found[1]) or PARTS[found[1]], path)
        needed = {"r": 0.5} if "/psf" in path else {}
        options = body_of(path, method, ids)
        yield method, address, {**options, "params": {**options.get("params", {}), **needed}}


def test_no_route_shows_an_owner_things_of_another(guarded: TestClient, store: Store, steps: Steps) -> None:
    ids = furnish(guarded, steps, "anna")
    anna, ben = key_of(store, "anna"), key_of(store, "ben")
    secrets = {*ids.values(), "anna", "p1.dng", "EF24mm"}
    walked = list(requests(guarded, ids))

    named = [each for each in walked if any(value in each[1] for value in ids.values())]
    assert len({address for _, address, _ in walked}) >= 40
    assert len(named) >= 100

    for method, address, options in walked:
        answer = guarded.request(method, address, headers=ben, **options)

        if (method, address, options) in named:
            assert answer.status_code in {404, 405}, (method, address, answer.text)
        shown = {word for word in secrets if word in answer.text}
        asked = {word for word in ids.values() if word in address or word in str(options)}
        assert shown <= asked, (method, address, answer.text)

    statuses = {
        address: guarded.get(address, headers=anna, **options).status_code
        for method, address, options in named
        if method == "GET"
        # events do not end, and the model takes its time: other routes show that the ids are real
        and not re.search(r"/(events|psf|psf\.json|field\.png)$", address)
    }
    assert len(statuses) >= 12
    assert not {address for address, status in statuses.items() if status in {401, 403}}
    missing = {address for address, status in statuses.items() if status == 404}
    assert missing <= {f"/ui/photos/{ids['photo_id']}/tiles/before/whole.jpg"}


def test_ids_in_bodies_and_queries_of_another_owner_are_unknown_too_and_nothing_happens(
    guarded: TestClient, store: Store, steps: Steps
) -> None:
    mine, theirs = furnish(guarded, steps, "ben"), furnish(guarded, steps, "anna")
    begun, ended = steps.receive(), failed(steps, "outage")
    ben = key_of(store, "ben")
    foreign_lens = {"photo_id": mine["photo_id"], "lens_id": theirs["lens_id"]}

    for method, path, body in (
        ("POST", "/v1/corrections", {"photo_id": theirs["photo_id"]}),
        ("POST", "/v1/corrections", foreign_lens),
        ("PATCH", f"/v1/photos/{mine['photo_id']}", {"lens_id": theirs["lens_id"]}),
        ("GET", f"/v1/corrections?photo_id={theirs['photo_id']}", None),
        ("GET", f"/batch?ids={mine['correction_id']},{theirs['correction_id']}", None),
        ("GET", f"/ui/parts?page=photo&id={theirs['photo_id']}", None),
        ("PATCH", "/v1/photos", {"photo_ids": [mine["photo_id"], begun.public_id], "aperture": 2.8}),
        ("PATCH", f"/v1/photos/{begun.public_id}", {"aperture": 2.8}),
        ("POST", f"/v1/jobs/{begun.public_id}/cancel", None),
        ("POST", f"/v1/jobs/{ended.public_id}/retry", None),
        ("DELETE", f"/v1/photos/{begun.public_id}", None),
    ):
        assert guarded.request(method, path, headers=ben, json=body).status_code == 404, (path, body)
    listed = guarded.get(f"/v1/photos?lens_id={theirs['lens_id']}", headers=ben).json()
    assert listed["items"] == []
    seen = [(row.state, row.given) for row in map(steps.fresh, (begun, ended))]
    assert seen == [("received", {}), ("failed", {})]
    own = store.photos.get(mine["photo_id"], "ben")  # of a list that held another's, none was changed
    assert own is not None
    assert own.aperture == 1.4


def test_the_same_bytes_of_two_owners_are_two_photos(guarded: TestClient, store: Store) -> None:
    jpeg = b"\xff\xd8\xff" + bytes(200)
    anna, ben = key_of(store, "anna"), key_of(store, "ben")

    first = guarded.post("/v1/photos?filename=a.jpg", content=jpeg, headers=anna)
    second = guarded.post("/v1/photos?filename=b.jpg", content=jpeg, headers=ben)
    guarded.delete(f"/v1/photos/{first.json()['id']}", headers=anna)

    assert (first.status_code, second.status_code) == (202, 202)  # 200 would say that somebody has it
    left = store.photos.get(second.json()["id"], ANY_OWNER)
    assert left is not None
    assert services_of(guarded).storage.get(left.blob_key) == jpeg
    assert guarded.get(f"/v1/photos/{second.json()['id']}", headers=ben).status_code == 200


def test_all_but_probes_and_sign_in_needs_a_key(guarded: TestClient, store: Store, steps: Steps) -> None:
    ids = dict.fromkeys(("photo_id", "lens_id", "job_id", "correction_id"), "x")
    allowed: dict[str, set[str]] = {}
    for method, address, options in requests(guarded, ids):
        answer = guarded.request(method, address, follow_redirects=False, **options)
        if answer.status_code not in {401, 405}:
            allowed.setdefault(address, set()).add(method)

    assert set(allowed) == OPEN
    assert allowed["/v1/session"] == {"DELETE"}
    assert guarded.get("/v1/photos").headers["WWW-Authenticate"] == "Bearer"


def test_a_person_who_is_not_signed_in_is_sent_to_the_page_for_it(guarded: TestClient) -> None:
    answer = guarded.get("/photos/abc", headers={"Accept": "text/html"}, follow_redirects=False)

    assert (answer.status_code, answer.headers["Location"]) == (303, "/sign-in?next=/photos/abc")
    page = guarded.get("/sign-in", headers={"Accept": "text/html"})
    assert page.status_code == 200
    assert 'type="password"' in page.text
    assert guarded.get("/static/session.js").status_code == 200


def test_a_browser_signs_in_with_a_cookie_for_this_site_alone(guarded: TestClient, store: Store) -> None:
    text = key_of(store, "anna")["Authorization"].removeprefix("Bearer ")
    at_home = {"Host": "127.0.0.1:8000"}

    wrong = guarded.post("/v1/session", json={"key": text[:-1] + ("A" if text[-1] != "A" else "B")})
    far = guarded.post("/v1/session", json={"key": text}, headers={"Host": "192.0.2.7"})
    near = guarded.post("/v1/session", json={"key": text}, headers=at_home)

    assert wrong.status_code == 401
    assert "set-cookie" not in wrong.headers
    cookie, kept_safe = near.headers["Set-Cookie"], ("HttpOnly", "SameSite=strict", "Secure")
    assert [word in cookie for word in kept_safe] == [True, True, False]
    assert all(word in far.headers["Set-Cookie"] for word in kept_safe)
    token = re.search(r"lens_session=([^;]+)", cookie)[1]  # type: ignore[index]  # it is there, see above
    shown = {"Cookie": f"lens_session={token}", **at_home}
    guarded.cookies.clear()
    told = guarded.get("/v1/account", headers=shown).json()
    assert (told["owner"], told["scopes"], told["signed_in"]) == ("anna", ["admin"], True)
    with store.database.reading() as session:
        assert token not in {row.token_hash for row in session.scalars(select(tables.SessionRow))}
    assert guarded.delete("/v1/session", headers=shown).status_code == 204
    assert guarded.get("/v1/account", headers=shown).status_code == 401


def test_keys_end_by_revoking_and_expiry_and_are_kept_nowhere(guarded: TestClient, store: Store) -> None:
    made = store.accounts.create_key("anna", ["read"], lasts=timedelta(days=1))
    with store.database.reading() as session:
        row = session.scalars(select(tables.KeyRow)).one()
    assert made.split("_", 2)[2] not in str(vars(row))  # a secret may hold the sign that parts it off
    assert row.key_hash == hashlib.sha256(made.encode()).hexdigest()
    renewed = store.accounts.create_key("anna", ["read"])

    def statuses() -> list[int]:
        keys = [{"Authorization": f"Bearer {key}"} for key in (made, renewed, made[:-1])]
        return [guarded.get("/v1/photos", headers=key).status_code for key in keys]

    assert statuses() == [200, 200, 401]
    with store.database.writing() as session:
        old = update(tables.KeyRow).where(tables.KeyRow.prefix == row.prefix)
        session.execute(old.values(expires_at=now() - timedelta(seconds=1)))
    assert statuses() == [401, 200, 401]
    assert store.accounts.revoke_key(renewed.split("_")[1])
    assert statuses() == [401, 401, 401]


@pytest.mark.parametrize(
    ("scope", "asks", "changes", "erases"),
    [("read", 200, 403, 403), ("write", 200, 404, 403), ("admin", 200, 404, 204)],
)
def test_scopes_allow_what_they_say(
    guarded: TestClient, store: Store, scope: accounts.Scope, asks: int, changes: int, erases: int
) -> None:
    key = key_of(store, "anna", scope)

    assert guarded.get("/v1/lenses", headers=key).status_code == asks
    assert guarded.post("/v1/jobs/abc/cancel", headers=key).status_code == changes
    assert guarded.delete("/v1/account", headers=key).status_code == erases


def test_loopback_asks_nobody_until_there_is_a_key(
    client: TestClient, store: Store, steps: Steps, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.access.FRESH_S", 0.0)
    photo = steps.receive()

    before = client.get("/v1/account").json()
    key = key_of(store, "local")

    assert (before["owner"], before["scopes"]) == ("local", ["read", "write", "admin"])
    assert not before["signed_in"]
    assert client.get("/v1/photos").status_code == 401
    listed = client.get("/v1/photos", headers=key).json()["items"]
    assert [item["id"] for item in listed] == [photo.public_id]


def test_a_stream_of_events_ends_with_the_key(
    guarded: TestClient, store: Store, steps: Steps, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.routes.jobs.LOOK_S", 0.1)
    steps.owner = "anna"
    photo = steps.receive()
    made = store.accounts.create_key("anna", ["read"])
    gate, asked = services_of(guarded).gate, list[bool]()
    really = gate.is_still

    def revoked_meanwhile(who: Any) -> bool:
        if asked:
            store.accounts.revoke_key(made.split("_")[1])
        asked.append(really(who))
        assert len(asked) < 5, "the stream goes on"
        return asked[-1]

    monkeypatch.setattr(gate, "is_still", revoked_meanwhile)
    # the photo never ends: only the key's end can end this
    answer = guarded.get(f"/v1/jobs/{photo.public_id}/events", headers={"Authorization": f"Bearer {made}"})

    assert asked == [True, False]
    events = [line for line in answer.text.splitlines() if line.startswith("data:")]
    assert [json.loads(event[5:])["id"] for event in events] == [photo.public_id]


def test_quotas_of_an_owner_go_before_the_settings(guarded: TestClient, store: Store) -> None:
    anna, ben = key_of(store, "anna", quota_photos=1), key_of(store, "ben", quota_bytes=100)

    def send(key: dict[str, str], number: int) -> Any:
        return guarded.post("/v1/photos", content=b"\xff\xd8\xff" + bytes([number] * 200), headers=key)

    for key in (anna, ben):
        first, second = (send(key, number) for number in range(2))
        assert (first.status_code, second.status_code) == (202, 429)
        assert second.headers["Retry-After"] == "3600"
    account = guarded.get("/v1/account", headers=anna).json()
    assert (account["photos"], account["max_photos"], account["stored_bytes"]) == (1, 1, 203)


@pytest.mark.parametrize("open_to", [{"host": "0.0.0.0"}, {"allowed_hosts": "localhost"}])
def test_an_open_port_needs_a_key(settings: Settings, store: Store, open_to: dict[str, Any]) -> None:
    open_settings = settings.model_copy(update=open_to)

    with pytest.raises(UsageError, match="lensmodel keys create"):
        supervisor._prepare(open_settings, api=True)
    made = store.accounts.create_key("anna", ["write"])
    supervisor._prepare(open_settings, api=True)
    store.accounts.revoke_key(made.split("_")[1])
    with pytest.raises(UsageError, match="no valid key"):
        supervisor._prepare(open_settings, api=True)


def test_nobody_asks_for_the_rows_of_all_by_leaving_the_owner_out(store: Store) -> None:
    parts = [part for name, part in vars(store).items() if name != "database"]
    methods = [method for part in parts for _, method in inspect.getmembers(part, inspect.ismethod)]
    signatures = [inspect.signature(method).parameters for method in methods]
    owners = [parameters["owner"] for parameters in signatures if "owner" in parameters]

    assert len(owners) > 10
    assert all(owner.default is inspect.Parameter.empty for owner in owners)


# --- the command `lensmodel keys`, and the client that sends one ------------------------------------


RUNNER = CliRunner()


def run(folder: Path, *words: str) -> tuple[str, str]:
    done = RUNNER.invoke(app, ["keys", *words, "--data", str(folder)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout, done.stderr


def test_a_key_is_made_listed_and_ended(tmp_path: Path) -> None:
    text, hint = run(tmp_path, "create", "--owner", "anna", "--scope", "read", "--label", "notebook")
    assert text.startswith("lpk_")
    assert text.count("\n") == 1  # it can be passed on as it is
    assert "Shown once" in hint

    [key] = json.loads(run(tmp_path, "list", "--json")[0])
    assert (key["owner"], key["scope"], key["label"], key["state"]) == ("anna", "read", "notebook", "valid")
    assert text.strip().split("_", 2)[2] not in str(key)
    run(tmp_path, "revoke", text.strip())
    run(tmp_path, "create", "--owner", "ben")

    states = [key["state"] for key in json.loads(run(tmp_path, "list", "--owner", "anna", "--json")[0])]
    assert states == ["revoked"]
    with pytest.raises(UsageError, match="such as 90d; got '3months'"):
        run(tmp_path, "create", "--expires", "3months")
    with pytest.raises(UsageError, match="owner's name"):
        run(tmp_path, "create", "--owner", "|")
    with pytest.raises(InvalidInputError, match="no key begins with abcd2345"):
        run(tmp_path, "revoke", "abcd2345")


def test_the_client_sends_its_key_or_that_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    def sent(**options: Any) -> str | None:
        with Client(**options) as client:
            return client._http.headers.get("Authorization")

    monkeypatch.delenv("LENS_API_KEY", raising=False)
    assert (sent(), sent(key="lpk_a")) == (None, "Bearer lpk_a")
    monkeypatch.setenv("LENS_API_KEY", "lpk_b")
    assert (sent(), sent(key=""), sent(http=httpx2.Client())) == ("Bearer lpk_b", None, None)


# --- what is kept of an owner -----------------------------------------------------------------------

JPEG = b"\xff\xd8\xff" + bytes(200)


def counts(store: Store, *tables: type[Any]) -> list[int]:
    with store.database.reading() as session:
        return [session.scalar(select(func.count()).select_from(table)) or 0 for table in tables]


def send(client: TestClient) -> Any:
    return client.post("/v1/photos?filename=a.jpg", content=JPEG)


def test_the_export_holds_all_of_the_owner_alone(client: TestClient, steps: Steps, storage: Storage) -> None:
    photo, gone = steps.counted(), steps.receive()
    storage.put(photo.blob_key, b"mine")
    steps.owner = "other"
    foreign = steps.counted()

    answer = client.get("/v1/account/export")

    assert answer.headers["Content-Type"] == "application/zip"
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        assert archive.testzip() is None
        files = {name: archive.read(name).decode() for name in archive.namelist()}
    assert files[f"originals/{photo.public_id}/{photo.filename}"] == "mine"
    assert files["missing.txt"] == f"originals/{gone.public_id}/{gone.filename}\n"
    texts = {name.removesuffix(".jsonl"): text for name, text in files.items() if "jsonl" in name}
    rows = {name: list(map(json.loads, text.splitlines())) for name, text in texts.items()}
    assert [row["public_id"] for row in rows["photos"]] == [photo.public_id, gone.public_id]
    assert [row["serial"] for row in rows["lenses"]] == ["123"]
    assert [row["kind"] for row in rows["calibrations"]] == ["photo_added"]
    assert (len(rows["patches"]), len(rows["samples"])) == (2, 6)
    sample = rows["samples"][0]
    kernel = np.frombuffer(base64.b64decode(sample["psf"]), dtype="<f4")
    assert kernel.size == sample["entry"]["size"] ** 2
    assert kernel.sum() == pytest.approx(1.0, abs=1e-4)
    assert foreign.public_id not in str(files)
    assert not {"owner_id", "key_hash"} & {name for table in rows.values() for row in table for name in row}


def test_an_archive_of_many_files_takes_time_in_proportion_to_them() -> None:
    def seconds(number: int) -> float:
        began = time.process_time()
        for _ in zipped((zipfile.ZipInfo(f"originals/{k:032x}/p{k}.dng"), [b"any"]) for k in range(number)):
            pass
        return time.process_time() - began

    assert seconds(5_000) < 12 * seconds(1_000)  # five times as many


def test_erasure_leaves_nothing(client: TestClient, store: Store, steps: Steps, storage: Storage) -> None:
    steps.owner = "other"
    foreign = steps.counted()
    kept = (tables.OwnerRow, tables.PhotoRow, tables.LensRow, tables.EventRow, tables.SampleRow)
    before = counts(store, *kept, tables.PatchRow)
    steps.owner = "local"
    photo, gone = steps.counted(), steps.counted()
    storage.put(photo.blob_key, b"mine")
    store.photos.delete(gone.public_id, "local")
    client.post("/v1/corrections", json={"photo_id": photo.public_id, "method": "fast"})

    assert client.delete("/v1/account").status_code == 204
    assert counts(store, *kept, tables.PatchRow) == before
    assert counts(store, tables.CorrectionRow, tables.KeyRow) == [0, 0]
    assert store.photos.get(foreign.public_id, "other") is not None
    assert not (storage.folder / photo.blob_key).exists()
    assert client.get("/v1/photos").json()["items"] == []


def test_a_worker_carries_a_killed_erasure_through(store: Store, steps: Steps, storage: Storage) -> None:
    photo = steps.counted()
    store.accounts.create_key("local", ["write"])
    key = store.accounts.begin_erasing("local")
    assert key is not None
    prefixes = store.accounts.erase_some(key)  # and then the API is killed

    assert not store.accounts.has_valid_key()
    assert store.photos.get(photo.public_id, "local") is None
    assert store.accounts.to_erase() == [key]
    assert prefixes == [photo.folder]
    with store.database.reading() as session:  # it is deleted once more later
        assert photo.folder in set(session.scalars(select(tables.GarbageRow.prefix)))
    erase(store.accounts, storage, key)
    assert store.accounts.to_erase() == []
    kinds = (tables.OwnerRow, tables.PhotoRow, tables.LensRow, tables.SampleRow, tables.KeyRow)
    assert counts(store, *kinds) == [0] * 5


def test_an_upload_that_outlasts_its_owner_makes_no_new_one(store: Store) -> None:
    with pytest.raises(Exception, match="erased"):
        receive(store, "a1", owner="anna", may_be_new=False)
    assert counts(store, tables.OwnerRow) == [0]


def ended(store: Store, photo: tables.PhotoRow, ago: timedelta) -> None:
    with store.database.writing() as session:
        mine = update(tables.PhotoRow).where(tables.PhotoRow.id == photo.id)
        session.execute(mine.values(finished_at=now() - ago))


def test_files_stay_as_long_as_the_setting_says(store: Store, steps: Steps) -> None:
    counted, running, corrected, stored = steps.counted(), steps.receive(), steps.counted(), steps.receive()
    steps.inspect(running)
    store.photos.set_state(stored.public_id, ("received",), "stored")
    row = steps.correct(corrected, method="fast")
    for photo in (counted, corrected, stored):
        ended(store, photo, timedelta(hours=2))

    assert store.photos.unneeded() == [counted.public_id]  # the others are to be corrected
    store.jobs.cancel(row.public_id, "local")
    ended(store, stored, timedelta(hours=25))
    assert set(store.photos.unneeded()) == {counted.public_id, corrected.public_id, stored.public_id}


def test_a_file_that_was_given_up_takes_no_room_and_comes_back_with_the_same_bytes(
    client: TestClient, store: Store, steps: Steps, storage: Storage
) -> None:
    sent = send(client).json()["id"]
    store.photos.set_state(sent, ("received",), "counted", finished_at=now())
    with store.database.writing() as session:
        session.execute(update(tables.PhotoRow).values(width=10, height=10))
    before = store.photos.get(sent, "local")
    assert before is not None
    room = [client.get("/v1/account").json()["stored_bytes"]]

    assert store.photos.give_up_file(sent, ("preview.jpg",))
    assert not store.photos.give_up_file(sent, ("preview.jpg",))
    garbage, usage = set(store.jobs.garbage()), store.accounts.usage("local")
    room.append(client.get("/v1/account").json()["stored_bytes"])
    refused = client.post("/v1/corrections", json={"photo_id": sent})
    storage.remove(before.blob_key)
    storage.remove(before.blob_key)  # again, and nothing happens
    again = send(client)
    after = steps.fresh(before)

    assert {before.blob_key, f"photos/{sent}/preview.jpg"} <= garbage
    assert (room, usage.working_photos, usage.photos) == ([len(JPEG), 0], 0, 1)
    assert refused.status_code == 409
    assert "send the same file again" in refused.json()["detail"]
    assert (again.status_code, again.json()["id"]) == (200, sent)
    assert after.file_gone_at is None
    assert after.blob_key != before.blob_key  # what deletes the old one cannot delete this
    assert storage.get(after.blob_key) == JPEG
    assert counts(store, tables.PhotoRow) == [1]
