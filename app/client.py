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
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Final

import httpx2

from app import schemas as s
from app.client_connection import DEFAULT_URL, Query, ServiceProblemError, read, require_success, said
from app.client_lenses import LensCalls
from app.schemas.account import AccountOut
from lensmodel.core.errors import LensModelError

__all__ = [
    "DEFAULT_URL",
    "Client",
    "JobEndedError",
    "JobPatienceError",
    "ServiceProblemError",
    "ended",
]

LONG_POLL_SECONDS: Final = 20
"""Longest wait of one request for a job: the default of LENS_LONG_POLL_SECONDS."""

PAUSE_SECONDS: Final = 0.1
"""Pause between two requests for a job (chosen): a service may be set to answer at once."""


class JobEndedError(LensModelError):
    """A job did not succeed; `job` says why."""

    def __init__(self, job: s.JobOut) -> None:
        reason = "" if job.error is None else f": {job.error.detail} ({job.error.code})"
        super().__init__(f"{job.kind} job {job.id} {job.state}{reason}")
        self.job = job


class JobPatienceError(LensModelError):
    """A job took longer than its caller would wait."""


class Client(LensCalls):
    """Speaks with one service; see `app.client_connection.Connection` for where and how."""

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
        model: s.PsfModel | None = None,
        selector: str | None = None,
        kind: s.MeasurementKind | None = None,
        reference_id: str | None = None,
        on_progress: Callable[[int, int], None] | None = None,
    ) -> s.PhotoOut:
        """Send a photo, streamed from its file; the same bytes give the photo that is there already.

        `on_progress(sent, total)` is called in bytes after each mebibyte. With `model` the photo founds a
        lens that is learned so; of a lens that is there and has another it is refused, see `choose_model`.
        `selector` chooses its patches instead of the service's own. Settings are those of a file that does
        not say its own; `change_photo` corrects one that says them wrongly.

        With `kind` it was made to measure the lens; of a pair it is the open photo, and `reference_id` is the
        closed one, sent before with `calibrate=False`.

        Raises
        ------
        ServiceProblemError
            If the service refuses it.
        OSError
            If the file cannot be read.
        """
        fields: Query = {
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
            "model": model,
            "selector": selector,
            "kind": kind,
            "reference_id": reference_id,
        }
        with Path(path).open("rb") as file:
            answer = self._http.post(
                "/v1/photos",
                params=said(fields),
                content=_pieces(file, on_progress),
                headers={"Content-Type": "application/octet-stream"},
            )
        return read(s.PhotoOut, answer)

    def photo(self, photo_id: str) -> s.PhotoOut:
        """Return one photo."""
        return self._get(s.PhotoOut, f"/v1/photos/{photo_id}")

    def photos(self, *, lens_id: str | None = None, state: s.PhotoState | None = None) -> list[s.PhotoOut]:
        """Return all photos, newest first."""
        return list(self._pages(s.PhotoPage, "/v1/photos", {"lens_id": lens_id, "state": state}))

    def change_photo(self, /, photo_id: str, **changes: object) -> s.PhotoOut:
        """Name the lens of a photo, correct its settings, or exclude it: fields of `PhotoChange`."""
        body = s.PhotoChange.model_validate(changes).model_dump(exclude_unset=True)
        return read(s.PhotoOut, self._http.patch(f"/v1/photos/{photo_id}", json=body))

    def change_photos(self, /, photo_ids: Iterable[str], **changes: object) -> list[s.PhotoOut]:
        """Name the lens of several photos at once, or correct their settings: fields of `PhotosChange`."""
        body = s.PhotosChange.model_validate({"photo_ids": list(photo_ids), **changes})
        sent = body.model_dump(exclude_unset=True)
        return read(s.PhotoPage, self._http.patch("/v1/photos", json=sent)).items

    def patches(self, photo_id: str) -> list[s.PatchOut]:
        """Return where a photo was learned from, and where not and why."""
        return self._get(s.PatchPage, f"/v1/photos/{photo_id}/patches").items

    def delete_photo(self, photo_id: str) -> None:
        """Delete a photo with all that was made of it."""
        require_success(self._http.delete(f"/v1/photos/{photo_id}"))

    def job(self, job_id: str) -> s.JobOut:
        """Return one job."""
        return self._get(s.JobOut, f"/v1/jobs/{job_id}")

    def jobs(self) -> list[s.JobOut]:
        """Return the jobs of all photos and corrections, newest first."""
        return list(self._pages(s.JobPage, "/v1/jobs"))

    def cancel(self, job_id: str) -> s.JobOut:
        """Cancel a job."""
        return read(s.JobOut, self._http.post(f"/v1/jobs/{job_id}/cancel"))

    def retry(self, job_id: str) -> s.JobOut:
        """Start a failed or cancelled job anew."""
        return read(s.JobOut, self._http.post(f"/v1/jobs/{job_id}/retry"))

    def retry_all(self, code: str = "outage") -> int:
        """Start anew all jobs that failed with a code; return how many."""
        again = 0
        while True:
            answer = self._http.post("/v1/jobs/retry", params={"code": code})
            retried = read(s.RetriedOut, answer).retried
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
        return read(s.JobOut, answer), answer.headers.get("ETag")

    def correct(self, /, photo_id: str, **options: object) -> s.CorrectionOut:
        """Ask for a correction: fields of `CorrectionIn`."""
        body = s.CorrectionIn.model_validate({"photo_id": photo_id, **options}).model_dump(mode="json")
        return read(s.CorrectionOut, self._http.post("/v1/corrections", json=body))

    def correction(self, correction_id: str) -> s.CorrectionOut:
        """Return one correction."""
        return self._get(s.CorrectionOut, f"/v1/corrections/{correction_id}")

    def corrections(self, *, photo_id: str | None = None) -> list[s.CorrectionOut]:
        """Return all corrections, newest first, optionally those of one photo."""
        return list(self._pages(s.CorrectionPage, "/v1/corrections", {"photo_id": photo_id}))

    def delete_correction(self, correction_id: str) -> None:
        """Delete a correction with its file; one that runs stops."""
        require_success(self._http.delete(f"/v1/corrections/{correction_id}"))

    def account(self) -> AccountOut:
        """Return who asks, what he has and what he may have."""
        return self._get(AccountOut, "/v1/account")

    def export_account(self, path: str | Path) -> Path:
        """Save all that the service keeps of this owner as a ZIP file."""
        return self._save("/v1/account/export", Path(path))

    def erase_account(self) -> None:
        """Erase all that the service keeps of this owner, its keys too. There is no way back."""
        require_success(self._http.delete("/v1/account"))

    def download(self, correction_id: str, path: str | Path) -> Path:
        """Save the corrected photo; the file appears under its name only when it is complete."""
        return self._save(f"/v1/corrections/{correction_id}/result", Path(path))


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


def _pieces(file: io.BufferedReader, on_progress: Callable[[int, int], None] | None) -> Iterator[bytes]:
    total = os.fstat(file.fileno()).st_size
    while piece := file.read(1 << 20):
        yield piece
        if on_progress is not None:
            on_progress(file.tell(), total)
