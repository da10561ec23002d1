"""A typed client of the service, for scripts and notebooks.

with Client("http://127.0.0.1:8000") as client:
    photo = client.upload("p1.dng")
    client.wait(photo)
    lens = client.lenses()[0]
    psf = client.psf(lens.id, r=0.9, phi=0.6, aperture=1.4)
    correction = client.correct(photo.id)
    client.wait(correction)
    client.download(correction.id, "p1-corrected.tif")
"""

from __future__ import annotations

import io
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, Self, TypeAlias, TypeVar

import httpx2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from app import schemas as s
from app.runtime.settings import CLIENT_KEY
from lensmodel.core.errors import LensModelError
from lensmodel.core.files import atomic

M = TypeVar("M", bound=BaseModel)
Query: TypeAlias = Mapping[str, str | int | float | bool | None]

DEFAULT_URL: Final = "http://127.0.0.1:8000"
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


class Client:
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
        self, url: str = DEFAULT_URL, *, http: httpx2.Client | None = None, key: str | None = None
    ) -> None:
        if http is None:
            shown = os.environ.get(CLIENT_KEY, "") if key is None else key
            headers = {"Authorization": f"Bearer {shown}"} if shown else {}
            transport = httpx2.HTTPTransport(retries=CONNECTS)
            http = httpx2.Client(base_url=url, timeout=ANSWER_SECONDS, headers=headers, transport=transport)
        self._http = http

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the connections."""
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    # --- photos -----------------------------------------------------------------------------------

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
            answer = self._http.post(
                "/v1/photos",
                params=_present({"filename": Path(path).name, **given}),
                content=_pieces(file, on_progress),
                headers={"Content-Type": "application/octet-stream"},
            )
        return _read(s.PhotoOut, answer)

    def photo(self, photo_id: str) -> s.PhotoOut:
        """Return one photo."""
        return self._get(s.PhotoOut, f"/v1/photos/{photo_id}")

    def photos(self, *, lens_id: str | None = None, state: s.PhotoState | None = None) -> list[s.PhotoOut]:
        """Return all photos, newest first."""
        return list(self._pages(s.Page[s.PhotoOut], "/v1/photos", {"lens_id": lens_id, "state": state}))

    def change_photo(self, /, photo_id: str, **changes: object) -> s.PhotoOut:
        """Name the lens of a photo, correct its settings, or exclude it: fields of `PhotoChange`."""
        body = s.PhotoChange.model_validate(changes).model_dump(exclude_unset=True)
        return self._send(s.PhotoOut, "PATCH", f"/v1/photos/{photo_id}", body)

    def delete(self, what: s.PhotoOut | s.LensOut | s.CorrectionOut) -> None:
        """Delete a photo with all that was made of it, a lens, or a correction, which stops if it runs."""
        _require_success(self._http.delete(str(what.links["self"])))

    # --- jobs -------------------------------------------------------------------------------------

    def job(self, job_id: str) -> s.JobOut:
        """Return one job."""
        return self._get(s.JobOut, f"/v1/jobs/{job_id}")

    def cancel(self, job_id: str) -> s.JobOut:
        """Cancel a job."""
        return self._send(s.JobOut, "POST", f"/v1/jobs/{job_id}/cancel")

    def retry(self, job_id: str) -> s.JobOut:
        """Start a failed or cancelled job anew."""
        return self._send(s.JobOut, "POST", f"/v1/jobs/{job_id}/retry")

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
            pause = PAUSE_SECONDS
            try:
                answer = self._http.get(
                    f"/v1/jobs/{job_id}", params={"wait": left}, headers={"If-None-Match": tag} if tag else {}
                )
                if answer.status_code != httpx2.codes.NOT_MODIFIED:
                    job, tag = _read(s.JobOut, answer), answer.headers.get("ETag", "")
                    if _ended(job, on_change):
                        return job
            except (httpx2.TransportError, ServiceProblemError) as error:
                away = not isinstance(error, ServiceProblemError) or error.problem.status in _AWAY
                if not (tag and away):
                    raise
                pause = AWAY_SECONDS
            if time.monotonic() >= until:
                raise JobPatienceError(
                    f"job {job_id} did not end within {timeout:g} s: wait longer or cancel it"
                )
            time.sleep(pause)

    # --- corrections ------------------------------------------------------------------------------

    def correct(self, /, photo_id: str, **options: object) -> s.CorrectionOut:
        """Ask for a correction: fields of `CorrectionIn`."""
        body = s.CorrectionIn.model_validate({"photo_id": photo_id, **options}).model_dump(mode="json")
        return self._send(s.CorrectionOut, "POST", "/v1/corrections", body)

    def correction(self, correction_id: str) -> s.CorrectionOut:
        """Return one correction."""
        return self._get(s.CorrectionOut, f"/v1/corrections/{correction_id}")

    def download(self, correction_id: str, path: str | Path) -> Path:
        """Save the corrected photo; the file appears under its name only when it is complete."""
        return self._save(f"/v1/corrections/{correction_id}/result", Path(path))

    # --- lenses -----------------------------------------------------------------------------------

    def lenses(self, *, model: str | None = None, serial: str | None = None) -> list[s.LensOut]:
        """Return all lenses, newest first, optionally of one model or serial."""
        return list(self._pages(s.Page[s.LensOut], "/v1/lenses", {"model": model, "serial": serial}))

    def lens(self, lens_id: str) -> s.LensOut:
        """Return one lens."""
        return self._get(s.LensOut, f"/v1/lenses/{lens_id}")

    def psf(self, /, lens_id: str, **query: str | float | None) -> s.PsfOut:
        """Return the PSF of a lens at one place and setting, with what it rests on: fields of `PsfQuery`."""
        return self._get(s.PsfOut, f"/v1/lenses/{lens_id}/psf.json", query)

    def kernel(self, /, lens_id: str, **query: str | float | None) -> NDArray[np.float32]:
        """Return only the kernel, shape (size, size), float32; the parameters are those of `psf`."""
        answer = _require_success(self._http.get(f"/v1/lenses/{lens_id}/psf.npy", params=_present(query)))
        kernel: NDArray[np.float32] = np.load(io.BytesIO(answer.content), allow_pickle=False)
        return kernel

    def change_lens(self, /, lens_id: str, **change: object) -> s.LensOut:
        """Rename a lens by `label`, or let it become a part of another by `merge_into`, which is returned.

        Two that seem to be different lenses are merged only with `any_lens=True`.
        """
        return self._send(s.LensOut, "PATCH", f"/v1/lenses/{lens_id}", change)

    def save_profile(self, lens_id: str, path: str | Path) -> Path:
        """Save what was learned of a lens as a `.lensprofile`."""
        return self._save(f"/v1/lenses/{lens_id}/profile", Path(path))

    def add_profile(self, lens_id: str, path: str | Path, *, any_lens: bool = False) -> s.LensOut:
        """Let what a `.lensprofile` knows join a lens; the same file a second time changes nothing.

        One that seems to be of another lens is refused without `any_lens`.
        """
        headers = {"Content-Type": "application/zip"}
        address = f"/v1/lenses/{lens_id}/profile{'?any_lens=true' if any_lens else ''}"
        answer = self._http.put(address, content=Path(path).read_bytes(), headers=headers)
        lens = _read(s.LensOut, answer)
        if answer.status_code != httpx2.codes.ACCEPTED:
            return lens
        try:
            self.wait(answer.headers["Location"].rpartition("/")[2])  # a worker is still reading it
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
        return _require_success(self._http.get(path, params=_present(query))).json()

    # --- requests ---------------------------------------------------------------------------------

    def _save(self, address: str, target: Path) -> Path:
        with self._http.stream("GET", address) as answer:
            if answer.is_error:
                answer.read()
            _require_success(answer)
            with atomic(target) as file:
                for piece in answer.iter_bytes():
                    file.write(piece)
        return target

    def _send(self, answer: type[M], method: str, path: str, body: Mapping[str, object] | None = None) -> M:
        return _read(answer, self._http.request(method, path, json=body))

    def _get(self, answer: type[M], path: str, query: Query | None = None) -> M:
        # None and not {}: empty parameters would cut off the query that an address carries already
        return _read(answer, self._http.get(path, params=_present(query) if query else None))

    def _pages(self, answer: type[M], path: str, query: Query | None = None) -> Iterator[Any]:
        page: Any = self._get(answer, path, query)
        yield from page.items
        while page.next is not None:
            page = self._get(answer, page.next)
            yield from page.items


def _ended(job: s.JobOut, on_change: Callable[[s.JobOut], None] | None) -> bool:
    """Tell a caller of a change; say whether the job has succeeded."""
    if on_change is not None:
        on_change(job)
    if job.state in {"failed", "cancelled", "waiting"}:
        raise JobEndedError(job)
    return job.state == "succeeded"


def _pieces(file: io.BufferedReader, on_progress: Callable[[int, int], None] | None) -> Iterator[bytes]:
    total = os.fstat(file.fileno()).st_size
    while piece := file.read(1 << 20):
        yield piece
        if on_progress is not None:
            on_progress(file.tell(), total)


def _present(query: Query) -> dict[str, str | int | float | bool]:
    """Return a query without what is left open."""
    return {name: value for name, value in query.items() if value is not None}


def _require_success(answer: httpx2.Response) -> httpx2.Response:
    if not answer.is_error:
        return answer
    try:
        problem = s.Problem.model_validate_json(answer.content)
    except ValidationError:  # a proxy between us and the service
        text = answer.text[:200]
        problem = s.Problem(
            title=answer.reason_phrase, status=answer.status_code, detail=text, code="no_problem"
        )
    raise ServiceProblemError(problem)


def _read(model: type[M], answer: httpx2.Response) -> M:
    return model.model_validate_json(_require_success(answer).content)
