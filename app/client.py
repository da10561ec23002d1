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
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self, TypeAlias, TypeVar

import httpx2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from app import schemas as s
from app.client_retries import RETRIES, Retrying
from app.runtime.settings import CLIENT_KEY
from app.schemas.account import AccountOut
from lensmodel.core.errors import LensModelError
from lensmodel.core.types import Channel

M = TypeVar("M", bound=BaseModel)
Query: TypeAlias = Mapping[str, str | int | float | bool | None]

DEFAULT_URL: Final = "http://127.0.0.1:8000"
LONG_POLL_SECONDS: Final = 20
PAUSE_SECONDS: Final = 0.1
ANSWER_SECONDS: Final = 60.0
FINAL: Final = {"succeeded", "failed", "cancelled"}


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
    retries : int
        How often a request is sent again, after a pause, where the service cannot be reached or says that it
        is busy; only requests that do no harm twice. Not of a connection that is given as `http`.
    """

    def __init__(
        self,
        url: str = DEFAULT_URL,
        *,
        http: httpx2.Client | None = None,
        key: str | None = None,
        retries: int = RETRIES,
    ) -> None:
        if http is None:
            shown = os.environ.get(CLIENT_KEY, "") if key is None else key
            headers = {"Authorization": f"Bearer {shown}"} if shown else {}
            http = httpx2.Client(
                base_url=url, timeout=ANSWER_SECONDS, headers=headers, transport=Retrying(retries)
            )
        self._http = http

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the connections."""
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def upload(
        self,
        path: str | Path,
        *,
        calibrate: bool = True,
        lens_id: str | None = None,
        lens_serial: str | None = None,
        lens_model: str | None = None,
        lens_maker: str | None = None,
        aperture: float | None = None,
        focal_length_mm: float | None = None,
        focus_distance_m: float | None = None,
        pixel_pitch_um: float | None = None,
        kind: s.MeasurementKind | None = None,
        reference_id: str | None = None,
        on_progress: Callable[[int, int], None] | None = None,
    ) -> s.PhotoOut:
        """Send a photo, streamed from its file; the same bytes give the photo that is there already.

        `on_progress(sent, total)` is called in bytes after each mebibyte.

        With `kind` it was made to measure the lens; of a pair it is the open photo, and `reference_id` is the
        closed one, sent before with `calibrate=False`.

        Raises
        ------
        ServiceProblemError
            If the service refuses it.
        OSError
            If the file cannot be read.
        """
        said: Query = {
            "filename": Path(path).name,
            "calibrate": str(calibrate).lower(),
            "lens_id": lens_id,
            "lens_serial": lens_serial,
            "lens_model": lens_model,
            "lens_maker": lens_maker,
            "aperture": aperture,
            "focal_length_mm": focal_length_mm,
            "focus_distance_m": focus_distance_m,
            "pixel_pitch_um": pixel_pitch_um,
            "kind": kind,
            "reference_id": reference_id,
        }
        with Path(path).open("rb") as file:
            answer = self._http.post(
                "/v1/photos",
                params=_said(said),
                content=_pieces(file, on_progress),
                headers={"Content-Type": "application/octet-stream"},
            )
        return _read(s.PhotoOut, answer)

    def photo(self, photo_id: str) -> s.PhotoOut:
        """Return one photo."""
        return self._get(s.PhotoOut, f"/v1/photos/{photo_id}")

    def photos(self, *, lens_id: str | None = None, state: s.PhotoState | None = None) -> list[s.PhotoOut]:
        """Return all photos, newest first."""
        return list(self._pages(s.PhotoPage, "/v1/photos", {"lens_id": lens_id, "state": state}))

    def change_photo(self, /, photo_id: str, **changes: object) -> s.PhotoOut:
        """Name the lens of a photo, correct its settings, or exclude it: fields of `PhotoChange`."""
        body = s.PhotoChange.model_validate(changes).model_dump(exclude_unset=True)
        return _read(s.PhotoOut, self._http.patch(f"/v1/photos/{photo_id}", json=body))

    def delete_photo(self, photo_id: str) -> None:
        """Delete a photo with all that was made of it."""
        _check(self._http.delete(f"/v1/photos/{photo_id}"))

    def job(self, job_id: str) -> s.JobOut:
        """Return one job."""
        return self._get(s.JobOut, f"/v1/jobs/{job_id}")

    def cancel(self, job_id: str) -> s.JobOut:
        """Cancel a job."""
        return _read(s.JobOut, self._http.post(f"/v1/jobs/{job_id}/cancel"))

    def delete_lens(self, lens_id: str) -> None:
        """Delete a lens with all that was learned of it."""
        _check(self._http.delete(f"/v1/lenses/{lens_id}"))

    def retry(self, job_id: str) -> s.JobOut:
        """Start a failed or cancelled job anew."""
        return _read(s.JobOut, self._http.post(f"/v1/jobs/{job_id}/retry"))

    def retry_all(self, code: str = "outage") -> int:
        """Start anew all jobs that failed with a code; return how many."""
        again = 0
        while True:
            answer = self._http.post("/v1/jobs/retry", params={"code": code})
            retried = _read(s.RetriedOut, answer).retried
            again += retried
            if retried == 0:
                return again

    def wait(
        self,
        work: s.PhotoOut | s.CorrectionOut | s.JobOut | str,
        *,
        timeout: float | None = None,
        on_change: Callable[[s.JobOut], None] | None = None,
    ) -> s.JobOut:
        """Wait until the work on a photo or a correction has succeeded.

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
        until = None if timeout is None else time.monotonic() + timeout
        tag: str | None = None
        while True:
            left = LONG_POLL_SECONDS if until is None else max(until - time.monotonic(), 0.0)
            job, tag = self.poll(job_id, tag, 0.0 if tag is None else min(left, LONG_POLL_SECONDS))
            if job is not None and ended(job, on_change):
                return job
            if until is not None and time.monotonic() >= until:
                raise JobPatienceError(
                    f"job {job_id} did not end within {timeout:g} s: wait longer or cancel it"
                )
            time.sleep(PAUSE_SECONDS)  # a service may be set to answer at once

    def poll(self, job_id: str, tag: str | None, seconds: float) -> tuple[s.JobOut | None, str | None]:
        """Ask once for a job, waiting so many seconds for a change since `tag`; None where there was none."""
        headers = {} if tag is None else {"If-None-Match": tag}
        answer = self._http.get(f"/v1/jobs/{job_id}", params={"wait": seconds}, headers=headers)
        if answer.status_code == httpx2.codes.NOT_MODIFIED:
            return None, tag
        return _read(s.JobOut, answer), answer.headers.get("ETag")

    def lenses(self, *, model: str | None = None, serial: str | None = None) -> list[s.LensOut]:
        """Return all lenses, newest first, optionally of one model or serial."""
        return list(self._pages(s.LensPage, "/v1/lenses", {"model": model, "serial": serial}))

    def lens(self, lens_id: str) -> s.LensOut:
        """Return one lens."""
        return self._get(s.LensOut, f"/v1/lenses/{lens_id}")

    def calibrations(self, lens_id: str) -> list[s.CalibrationOut]:
        """Return the history of a lens, oldest first."""
        return list(self._pages(s.CalibrationPage, f"/v1/lenses/{lens_id}/calibrations"))

    def lateral_colour(self, lens_id: str) -> s.LateralOut:
        """Return the lateral colour shift of a lens."""
        return self._get(s.LateralOut, f"/v1/lenses/{lens_id}/lateral-colour")

    def psf(
        self,
        /,
        lens_id: str,
        *,
        r: float,
        phi: float = 0.0,
        aperture: float | None = None,
        channel: Channel = "g",
        size: int = 55,
        **more: float | bool | None,
    ) -> s.PsfOut:
        """Return the PSF of a lens at one place and setting, with what it rests on."""
        query: Query = {"r": r, "phi": phi, "aperture": aperture, "channel": channel, "size": size, **more}
        return self._get(s.PsfOut, f"/v1/lenses/{lens_id}/psf.json", query)

    def kernel(
        self, /, lens_id: str, *, r: float, phi: float = 0.0, **query: str | float | None
    ) -> NDArray[np.float32]:
        """Return only the kernel, shape (size, size), float32; the parameters are those of `psf`."""
        params = _said({"r": r, "phi": phi, **query})
        answer = _check(self._http.get(f"/v1/lenses/{lens_id}/psf.npy", params=params))
        kernel: NDArray[np.float32] = np.load(io.BytesIO(answer.content), allow_pickle=False)
        return kernel

    def field_png(self, /, lens_id: str, **query: str | float | None) -> bytes:
        """Return the map of PSFs over the field as a PNG; the parameters are those of the endpoint."""
        params = {name: value for name, value in query.items() if value is not None}
        return _check(self._http.get(f"/v1/lenses/{lens_id}/field.png", params=params)).content

    def correct(self, /, photo_id: str, **wish: object) -> s.CorrectionOut:
        """Ask for a correction: fields of `CorrectionIn`."""
        body = s.CorrectionIn.model_validate({"photo_id": photo_id, **wish}).model_dump(mode="json")
        return _read(s.CorrectionOut, self._http.post("/v1/corrections", json=body))

    def correction(self, correction_id: str) -> s.CorrectionOut:
        """Return one correction."""
        return self._get(s.CorrectionOut, f"/v1/corrections/{correction_id}")

    def account(self) -> AccountOut:
        """Return who asks, what he has and what he may have."""
        return self._get(AccountOut, "/v1/account")

    def export_account(self, path: str | Path) -> Path:
        """Save all that the service keeps of this owner as a ZIP file."""
        return self._save("/v1/account/export", Path(path))

    def erase_account(self) -> None:
        """Erase all that the service keeps of this owner, its keys too. There is no way back."""
        _check(self._http.delete("/v1/account"))

    def download(self, correction_id: str, path: str | Path) -> Path:
        """Save the corrected photo; the file appears under its name only when it is complete."""
        return self._save(f"/v1/corrections/{correction_id}/result", Path(path))

    def _save(self, address: str, target: Path) -> Path:
        with self._http.stream("GET", address) as answer:
            if answer.is_error:
                answer.read()
            _check(answer)
            with tempfile.NamedTemporaryFile(dir=target.parent, suffix=".part", delete=False) as part:
                try:
                    for piece in answer.iter_bytes():
                        part.write(piece)
                except BaseException:
                    Path(part.name).unlink()
                    raise
        Path(part.name).replace(target)
        return target

    def _get(self, answer: type[M], path: str, query: Query | None = None) -> M:
        # None and not {}: empty parameters would cut off the query that an address carries already
        return _read(answer, self._http.get(path, params=_said(query) if query else None))

    def _pages(self, answer: type[M], path: str, query: Query | None = None) -> Iterator[Any]:
        page: Any = self._get(answer, path, query)
        yield from page.items
        while page.next is not None:
            page = self._get(answer, page.next)
            yield from page.items


def ended(job: s.JobOut, on_change: Callable[[s.JobOut], None] | None) -> bool:
    """Tell a caller of a change; say whether the job has succeeded.

    Raises
    ------
    JobEndedError
        If it ended in another way, or cannot go on before its owner names the lens.
    """
    if on_change is not None:
        on_change(job)
    if job.state in {"failed", "cancelled", "waiting"}:
        raise JobEndedError(job)
    return job.state == "succeeded"


def _said(query: Query) -> dict[str, str | int | float | bool]:
    return {name: value for name, value in query.items() if value is not None}


def _pieces(file: io.BufferedReader, on_progress: Callable[[int, int], None] | None) -> Iterator[bytes]:
    total = os.fstat(file.fileno()).st_size
    while piece := file.read(1 << 20):
        yield piece
        if on_progress is not None:
            on_progress(file.tell(), total)


def _check(answer: httpx2.Response) -> httpx2.Response:
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
    return model.model_validate_json(_check(answer).content)
