"""The settings, and the compose file that gives some, as far as it can be checked without containers."""

from __future__ import annotations

import re
import signal
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import yaml  # type: ignore[import-untyped]  # its types are a package of their own

from app.runtime.settings import PREFIX, Settings, described
from app.runtime.supervisor import listen, run
from lensmodel.core.errors import InvalidInputError

ROOT = Path(__file__).parents[3]
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "compose.yaml").read_text(encoding="utf-8"))
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
OURS = {name: service for name, service in SERVICES.items() if service["image"] == "lensmodel"}
SERVER = "postgresql+psycopg://db/lens"


def test_an_unknown_setting_is_refused_with_the_likely_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LENS_WORKER_SLOT", "3")

    with pytest.raises(ValueError, match="did you mean LENS_WORKER_SLOTS"):
        Settings()


def test_a_port_open_to_the_world_asks_for_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not Settings().needs_keys
    monkeypatch.setenv("LENS_API_KEY", "what clients send is no setting")
    monkeypatch.setenv("LENS_HOST", "0.0.0.0")

    assert Settings().needs_keys
    with pytest.raises(ValueError, match="LENS_AUTH=none lets everybody in"):
        Settings(auth="none")


def test_the_page_of_the_service_lists_all_settings() -> None:
    rows = []
    for name, said in described().items():
        field = Settings.model_fields[name]
        default = "cores of the machine" if field.default_factory else str(field.default).lower() or "none"
        rows.append(f"| `{PREFIX}{name.upper()}` | {default} | {said} |")

    page = (ROOT / "docs" / "service.md").read_text(encoding="utf-8")
    assert "\n".join(["| setting | default | |", "|---|---|---|", *rows]) in page


def test_a_database_server_needs_storage_that_all_machines_see_and_has_the_jobs() -> None:
    with pytest.raises(ValueError, match="s3://"):
        Settings(database_url=SERVER)

    settings = Settings(database_url=SERVER, storage_url="s3://lensmodel")

    assert settings.jobs == settings.database


def test_a_port_that_is_taken_is_named() -> None:
    with listen("127.0.0.1", 0) as listener:
        port = listener.getsockname()[1]
        with pytest.raises(InvalidInputError, match=f"127.0.0.1:{port}"):
            listen("127.0.0.1", port)


def test_the_settings_of_the_compose_file_fit_together(monkeypatch: pytest.MonkeyPatch) -> None:
    environment = OURS["api"]["environment"]
    for name, value in environment.items():
        monkeypatch.setenv(name, re.sub(r"\$\{[^}]+\}", "secret", value))

    settings = Settings(host="0.0.0.0")

    assert {service["command"][0] for service in OURS.values()} == {"api", "worker"}
    assert environment == OURS["worker"]["environment"]
    assert (settings.database.partition("+")[0], settings.storage) == ("postgresql", "s3://lensmodel")
    assert settings.hosts


def test_our_containers_have_no_rights_and_a_root_that_nobody_writes_to() -> None:
    for service in OURS.values():
        assert service["read_only"] is True
        assert service["cap_drop"] == ["ALL"]
        assert "no-new-privileges:true" in service["security_opt"]
        assert any(str(volume).endswith("/data") for volume in service["volumes"])


@pytest.mark.parametrize("name", SERVICES)
def test_no_secret_is_written_down_no_image_floats_and_ports_are_on_loopback(name: str) -> None:
    service = SERVICES[name]
    for key, value in service.get("environment", {}).items():
        assert value.startswith("${") or not re.search("PASSWORD|SECRET", key), key
    assert name in OURS or re.search(r":\d", service["image"])
    assert all(port.startswith("127.0.0.1:") for port in service.get("ports", []))
    for other, wait in service.get("depends_on", {}).items():  # that is there, and can tell its health
        assert wait["condition"] != "service_healthy" or "test" in SERVICES[other]["healthcheck"]


def test_an_unknown_estimator_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"no estimator 'nothing'; known: .*michaeli-irani"):
        Settings(estimator="nothing")
    assert Settings(estimator="michaeli-irani").estimator == "michaeli-irani"


class Asked:
    """A worker that lives; the order to stop comes just when it is asked."""

    def __init__(self) -> None:
        self.times = 0

    def poll(self) -> None:
        self.times += 1
        if self.times == 1:
            signal.raise_signal(signal.SIGINT)
        elif self.times > 5:  # the order was lost
            pytest.fail("the service goes on")


def test_an_order_to_stop_is_not_lost_while_the_worker_is_asked(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.runtime.logs.begin", lambda *_: None)  # of this process
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # commands set one of their own
    try:
        with closing(listen("127.0.0.1", 0)) as listener, pytest.raises(KeyboardInterrupt):
            run(settings, listener, until=Asked())  # type: ignore[arg-type]
    finally:
        signal.signal(signal.SIGINT, before)
