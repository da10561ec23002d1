"""`lensmodel reproduce` through the service: uploaded, calibrated and corrected as by any other user."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from app.client import Client, JobEndedError
from app.demo.own_service import own_service
from app.demo.service_tasks import corrected, follow, planes_of
from app.schemas import PhotoOut
from lensmodel.core.errors import NoSamplesError
from lensmodel.core.psf import as_kernel
from lensmodel.core.types import LensSettings
from lensmodel.lab.reproduce import Answer, Case, CorrectedPhoto, Place
from lensmodel.simulate import CameraLens

log = logging.getLogger(__name__)

_PATIENCE = 4 * 3600.0  # seconds for all photos of a case (chosen): a service that hangs ends the run

CODE = tuple(Path(__file__).parents[1] / name for name in ("jobs", "sandbox"))
"""Code of the service on which the figures depend."""


class ServiceRoute:
    """One lens in a running service.

    Parameters
    ----------
    client : Client
    work : Path
        Folder for downloads; each is removed as soon as it has been read.
    lens : CameraLens or None
        Which lens it is, said with photos that do not say it themselves.
    """

    def __init__(self, client: Client, work: Path, lens: CameraLens | None = None) -> None:
        self._client, self._work, self._lens = client, work, lens
        self._lens_id: str | None = None

    def learn(self, photo: Path) -> str:
        """Upload a photo and wait until the lens has learned from it; see `Route`."""
        uploaded = self._upload(photo, calibrate=True)
        try:
            follow(self._client, uploaded, log.info, patience=_PATIENCE)
        except JobEndedError as error:
            return str(error)
        self._lens_id = self._client.photo(uploaded.id).lens_id
        return ""

    def answers(self, places: Sequence[Place], settings: LensSettings, size: int) -> list[Answer]:
        """Ask for the PSFs at some places; see `Route`."""
        lens_id, answers = self._known(), []
        for place, channel in places:
            psf = self._client.psf(
                lens_id,
                r=place.r,
                phi=place.phi,
                aperture=settings.aperture,
                focal_length_mm=settings.focal_mm,
                channel=channel,
                size=size,
            )
            error = psf.support.predicted_error
            answers.append(Answer(as_kernel(psf.psf.data), np.nan if error is None else error))
        return answers

    def corrected(self, photo: Path, method: str) -> CorrectedPhoto:
        """Have a photo corrected that the lens does not learn from; see `Route`."""
        uploaded = self._upload(photo, calibrate=False)
        follow(self._client, uploaded, log.info)
        path = corrected(
            self._client,
            uploaded,
            self._work,
            log.info,
            output={"color_space": "camera-linear"},
            method=method,
            lens_id=self._known(),
        )
        planes = planes_of(path)
        report = self._client.correction(path.stem).report or {}
        path.unlink()
        return CorrectedPhoto(
            planes,
            {zone: row.get("expected_gain_db") for zone, row in report.get("zones", {}).items()},
            bool(report.get("nothing_to_correct")),
        )

    def _upload(self, photo: Path, *, calibrate: bool) -> PhotoOut:
        """Send a photo; a TIFF or JPEG has no lens serial, so its lens is named as its owner would."""
        lens = None if photo.suffix == ".dng" else self._lens
        return self._client.upload(
            photo,
            calibrate=calibrate,
            lens_maker=None if lens is None else lens.maker,
            lens_model=None if lens is None else lens.model,
            lens_serial=None if lens is None else lens.serial,
        )

    def _known(self) -> str:
        if self._lens_id is None:
            raise NoSamplesError("no photo has counted yet: learn from one with fine detail in focus")
        return self._lens_id


class ServiceRoutes:
    """Opens a service of its own for each case, so that no lens knows of another.

    Its data stay in the case's folder: a run that was stopped goes on with the photos that are
    there already.
    """

    def __init__(self, estimator: str) -> None:
        self._settings = {"LENS_ESTIMATOR": estimator}

    @contextmanager
    def __call__(self, case: Case, folder: Path) -> Iterator[ServiceRoute]:
        """Open the route of one case; see `OpenRoute`."""
        log.info("starting a service for %s", case.title)
        downloads = folder / "downloads"
        downloads.mkdir(parents=True, exist_ok=True)
        with own_service(folder / "service", folder / "service.log", self._settings) as client:
            yield ServiceRoute(client, downloads, case.lens)
