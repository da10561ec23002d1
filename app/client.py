"""A typed client of the service, for scripts and notebooks; docs/topics/client.md has examples."""

from __future__ import annotations

import io
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Final, TypeVar

import httpx2
from pydantic import BaseModel, ValidationError

from app import schemas as s
from app.runtime.settings import CLIENT_KEY
from lensmodel.core.errors import LensModelError
from lensmodel.core.files import atomic

M = TypeVar("M", bound=BaseModel)

ANSWER_SECONDS: Final = 60.0  # longest wait for a response (chosen): longer than a long poll
# Attempts to connect (chosen): with the pauses of httpx, seven seconds bridge the restart of a service
CONNECTS: Final = 5
LONG_POLL_SECONDS: Final = 20  # longest wait of one request for a job: as the service allows
# Pause between two requests for a job (chosen): a service may be set to answer at once
PAUSE_SECONDS: Final = 0.1
# Pause of `wait` while the service is away or busy (chosen): it restarts in a few seconds
AWAY_SECONDS: Final = 2.0
_AWAY: Final = frozenset({429, 502, 503, 504})


class ServiceProblemError(LensModelError):
    """The service said no; `problem` says why."""

    def __init__(self, problem: s.Problem) -> None:
        super().__init__(f"{problem.detail or problem.title} ({problem.code}, status {problem.status})")
        self.problem = problem


class JobEndedError(LensModelError):
    """A job did not succeed; `job` says why."""

    def __init__(self, job: s.JobOut) -> None:
        reason = "" if job.error is None else f": {job.error.detail} ({job.error.code})"
        super().__init__(f"{job.kind} job {job.id} {job.state}{reason}")
        self.job = job


class JobPatienceError(LensModelError):
    """A job took longer than its caller would wait."""


class Client(AbstractContextManager["Client"]):
    """Speaks with one service.

    Parameters
    ----------
    url : str
        Where the service listens.
    http : httpx2.Client, optional
        A connection to use instead of an own one, for instance with other time limits.
    key : str, optional
        What `lensmodel keys create` printed, where the service asks for it; by default LENS_API_KEY of the
        environment. It is not sent over a connection that is given as `http`.
    """

    def __init__(
        self, url: str = "http://127.0.0.1:8000", *, http: httpx2.Client | None = None, key: str | None = None
    ) -> None:
        if http is None:
            shown = os.environ.get(CLIENT_KEY, "") if key is None else key
            headers = {"Authorization": f"Bearer {shown}"} if shown else {}
            transport = httpx2.HTTPTransport(retries=CONNECTS)
            http = httpx2.Client(base_url=url, timeout=ANSWER_SECONDS, headers=headers, transport=transport)
        self._http = http

    def __exit__(self, *_: object) -> None:
        """Close the connections."""
        self._http.close()

    def upload(
        self,
        path: str | Path,
        *,
        on_progress: Callable[[int, int], None] | None = None,
        **fields: str | float | None,
    ) -> s.PhotoOut:
        """Send a photo, streamed from its file; the same bytes give the photo that is there already.

        `fields` are those of `UploadFields`, such as `calibrate`, `lens_id` or `aperture`; `on_progress(sent,
        total)` is called in bytes after each mebibyte. Settings are those of a file that does not say its
        own: `change_photo` corrects one that says them wrongly. With `kind` it was made to measure the lens;
        of a pair it is the open photo, and `reference_id` is the closed one, sent before with
        `calibrate=False`.

        Raises
        ------
        ServiceProblemError
            If the service refuses it.
        OSError
            If the file cannot be read.
        """
        given = s.UploadFields.model_validate(fields).model_dump(mode="json", exclude_unset=True)
        with Path(path).open("rb") as file:
            answer = self._ask(
                "POST",
                "/v1/photos",
                {"filename": Path(path).name, **given},
                content=_pieces(file, on_progress),
                headers={"Content-Type": "application/octet-stream"},
            )
        return _read(s.PhotoOut, answer)

    def photo(self, photo_id: str) -> s.PhotoOut:
        """Return one photo."""
        return _read(s.PhotoOut, self._ask("GET", f"/v1/photos/{photo_id}"))

    def photos(self, *, lens_id: str | None = None, state: s.PhotoState | None = None) -> list[s.PhotoOut]:
        """Return all photos, newest first."""
        return self._listed(s.PhotoOut, "/v1/photos", {"lens_id": lens_id, "state": state})

    def change_photo(self, /, photo_id: str, **changes: object) -> s.PhotoOut:
        """Name the lens of a photo, correct its settings, or exclude it: fields of `PhotoChange`."""
        body = s.PhotoChange.model_validate(changes).model_dump(exclude_unset=True)
        return _read(s.PhotoOut, self._ask("PATCH", f"/v1/photos/{photo_id}", json=body))

    def delete(self, what: s.PhotoOut | s.LensOut | s.CorrectionOut) -> None:
        """Delete a photo with all that was made of it, a lens, or a correction, which stops if it runs."""
        self._ask("DELETE", str(what.links["self"]))

    def cancel(self, job_id: str) -> s.JobOut:
        """Cancel a job."""
        return _read(s.JobOut, self._ask("POST", f"/v1/jobs/{job_id}/cancel"))

    def retry(self, job_id: str) -> s.JobOut:
        """Start a failed or cancelled job anew."""
        return _read(s.JobOut, self._ask("POST", f"/v1/jobs/{job_id}/retry"))

    def wait(
        self,
        work: s.PhotoOut | s.CorrectionOut | s.JobOut | str,
        *,
        timeout: float | None = None,
        on_change: Callable[[s.JobOut], None] | None = None,
    ) -> s.JobOut:
        """Wait until the work on a photo or a correction has succeeded, also while the service restarts.

        Parameters
        ----------
        work : PhotoOut, CorrectionOut, JobOut or str
            What to wait for; a str is the id.
        timeout : float, optional
            Seconds to wait at most.
        on_change : callable, optional
            Called with the job at each change.

        Raises
        ------
        JobEndedError
            If it failed or was cancelled, or cannot go on before its owner names the lens.
        JobPatienceError
            If it took longer than `timeout`.
        """
        job_id = work if isinstance(work, str) else work.id
        until = math.inf if timeout is None else time.monotonic() + timeout
        tag = ""
        while True:
            left = min(max(until - time.monotonic(), 0.0), LONG_POLL_SECONDS) if tag else 0.0
            known, pause = {"If-None-Match": tag} if tag else {}, PAUSE_SECONDS
            try:
                answer = self._ask("GET", f"/v1/jobs/{job_id}", {"wait": left}, headers=known)
            except (httpx2.TransportError, ServiceProblemError) as error:
                away = not isinstance(error, ServiceProblemError) or error.problem.status in _AWAY
                if not (tag and away):
                    raise
                pause = AWAY_SECONDS
            else:
                if answer.status_code != httpx2.codes.NOT_MODIFIED:
                    job, tag = _read(s.JobOut, answer), answer.headers.get("ETag", "")
                    if on_change is not None:
                        on_change(job)
                    if job.state in {"failed", "cancelled", "waiting"}:
                        raise JobEndedError(job)
                    if job.state == "succeeded":
                        return job
            if time.monotonic() >= until:
                text = f"job {job_id} did not end within {timeout:g} s: wait longer or cancel it"
                raise JobPatienceError(text)
            time.sleep(pause)

    def correct(self, /, photo_id: str, **options: object) -> s.CorrectionOut:
        """Ask for a correction: fields of `CorrectionIn`."""
        body = s.CorrectionIn.model_validate({"photo_id": photo_id, **options}).model_dump(mode="json")
        return _read(s.CorrectionOut, self._ask("POST", "/v1/corrections", json=body))

    def correction(self, correction_id: str) -> s.CorrectionOut:
        """Return one correction."""
        return _read(s.CorrectionOut, self._ask("GET", f"/v1/corrections/{correction_id}"))

    def download(self, correction_id: str, path: str | Path) -> Path:
        """Save the corrected photo; the file appears under its name only when it is complete."""
        return self._save(f"/v1/corrections/{correction_id}/result", Path(path))

    def lenses(self, *, model: str | None = None, serial: str | None = None) -> list[s.LensOut]:
        """Return all lenses, newest first, optionally of one model or serial."""
        return self._listed(s.LensOut, "/v1/lenses", {"model": model, "serial": serial})

    def lens(self, lens_id: str) -> s.LensOut:
        """Return one lens."""
        return _read(s.LensOut, self._ask("GET", f"/v1/lenses/{lens_id}"))

    def psf(self, /, lens_id: str, **query: str | float | None) -> s.PsfOut:
        """Return the PSF of a lens at one place and setting, with what it rests on: fields of `PsfQuery`."""
        return _read(s.PsfOut, self._ask("GET", f"/v1/lenses/{lens_id}/psf.json", query))

    def change_lens(self, /, lens_id: str, **change: object) -> s.LensOut:
        """Rename a lens by `label`, or let it become a part of another by `merge_into`, which is returned.

        Two that seem to be different lenses are merged only with `any_lens=True`.
        """
        return _read(s.LensOut, self._ask("PATCH", f"/v1/lenses/{lens_id}", json=change))

    def save_profile(self, lens_id: str, path: str | Path) -> Path:
        """Save what was learned of a lens as a `.lensprofile`."""
        return self._save(f"/v1/lenses/{lens_id}/profile", Path(path))

    def add_profile(self, lens_id: str, path: str | Path, *, any_lens: bool = False) -> s.LensOut:
        """Let what a `.lensprofile` knows join a lens; the same file a second time changes nothing.

        One that seems to be of another lens is refused without `any_lens`.
        """
        answer = self._ask(
            "PUT",
            f"/v1/lenses/{lens_id}/profile",
            {"any_lens": any_lens or None},
            content=Path(path).read_bytes(),
            headers={"Content-Type": "application/zip"},
        )
        try:
            self.wait(_read(s.JobOut, answer))  # a worker reads it
        except JobEndedError as ended:
            raise (ServiceProblemError(ended.job.error) if ended.job.error else ended) from ended
        return self.lens(lens_id)

    def save_report(self, lens_id: str, path: str | Path) -> Path:
        """Save the test report of a lens in the form that `path` ends with: `.json`, `.csv` or `.pdf`.

        Raises
        ------
        ServiceProblemError
            With the code `not_ready` while a worker has yet to make it.
        """
        target = Path(path)
        return self._save(f"/v1/lenses/{lens_id}/report{target.suffix.lower()}", target)

    def get(self, path: str, **query: str | float | bool | None) -> Any:  # noqa: ANN401 - JSON of any shape
        """Return the JSON of any other address of the service, such as `/v1/account`."""
        return self._ask("GET", path, query).json()

    def _ask(
        self,
        method: str,
        path: str,
        query: Mapping[str, Any] | None = None,
        **more: Any,  # noqa: ANN401 - of httpx
    ) -> httpx2.Response:
        """Return the answer to a request, without what its query leaves open; refusals are errors."""
        # None and not {}: empty parameters would cut off the query that an address carries already
        given = {name: value for name, value in (query or {}).items() if value is not None} or None
        return _accepted(self._http.request(method, path, params=given, **more))

    def _save(self, address: str, target: Path) -> Path:
        with self._http.stream("GET", address) as answer:
            if answer.is_error:
                answer.read()
            _accepted(answer)
            with atomic(target) as file:
                for piece in answer.iter_bytes():
                    file.write(piece)
        return target

    def _listed(self, kind: type[M], path: str, query: Mapping[str, Any]) -> list[M]:
        page = self._ask("GET", path, query).json()
        items = page["items"]
        while page["next"] is not None:
            page = self._ask("GET", page["next"]).json()
            items += page["items"]
        return [kind.model_validate(item) for item in items]


def _pieces(file: io.BufferedReader, on_progress: Callable[[int, int], None] | None) -> Iterator[bytes]:
    total = os.fstat(file.fileno()).st_size
    while piece := file.read(1 << 20):
        yield piece
        if on_progress is not None:
            on_progress(file.tell(), total)


def _accepted(answer: httpx2.Response) -> httpx2.Response:
    if not answer.is_error:
        return answer
    try:
        problem = s.Problem.model_validate_json(answer.content)
    except ValidationError:  # a proxy between us and the service
        title, text = answer.reason_phrase, answer.text[:200]
        problem = s.Problem(title=title, status=answer.status_code, detail=text, code="no_problem")
    raise ServiceProblemError(problem)


def _read(model: type[M], answer: httpx2.Response) -> M:
    return model.model_validate_json(answer.content)
