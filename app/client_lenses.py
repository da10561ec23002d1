"""The calls of the client that are about lenses."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from app import schemas as s
from app.client_connection import Connection, Query, read, require_success, said
from lensmodel.core.types import Channel


class LensCalls(Connection):
    """Asks for lenses, and changes them."""

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
        params = said({"r": r, "phi": phi, **query})
        answer = require_success(self._http.get(f"/v1/lenses/{lens_id}/psf.npy", params=params))
        kernel: NDArray[np.float32] = np.load(io.BytesIO(answer.content), allow_pickle=False)
        return kernel

    def field_png(self, /, lens_id: str, **query: str | float | None) -> bytes:
        """Return the map of PSFs over the field as a PNG; the parameters are those of the endpoint."""
        params = {name: value for name, value in query.items() if value is not None}
        return require_success(self._http.get(f"/v1/lenses/{lens_id}/field.png", params=params)).content

    def delete_lens(self, lens_id: str) -> None:
        """Delete a lens with all that was learned of it."""
        require_success(self._http.delete(f"/v1/lenses/{lens_id}"))

    def rename_lens(self, lens_id: str, label: str | None) -> s.LensOut:
        """Call a lens by a name of its owner's; None takes the name away."""
        return self._change_lens(lens_id, {"label": label})

    def choose_model(self, lens_id: str, model: s.PsfModel) -> s.LensOut:
        """Learn a lens by default or the paper's own way; its photos are estimated anew in the background.

        It answers with `answering_model` until they are, and from then on with `psf_model`.
        """
        return self._change_lens(lens_id, {"model": model})

    def merge_lens(self, lens_id: str, into: str) -> s.LensOut:
        """Let a lens become a part of another, which is returned; it is forgotten itself."""
        return self._change_lens(lens_id, {"merge_into": into})

    def go_back(self, lens_id: str, version: int) -> s.LensOut:
        """Leave out the photos that joined a lens after a version of `calibrations`."""
        return self._change_lens(lens_id, {"back_to": version})

    def save_profile(self, lens_id: str, path: str | Path) -> Path:
        """Save what was learned of a lens as a `.lensprofile`."""
        return self._save(f"/v1/lenses/{lens_id}/profile", Path(path))

    def create_lens(self, label: str) -> s.LensOut:
        """Create a lens, to add a profile to."""
        return read(s.LensOut, self._http.post("/v1/lenses", json={"label": label}))

    def add_profile(self, lens_id: str, path: str | Path, *, any_lens: bool = False) -> s.LensOut:
        """Let what a `.lensprofile` knows join a lens; the same file a second time changes nothing.

        One that seems to be of another lens is refused without `any_lens`. Returns the lens as it is before
        where a worker has yet to read the file.
        """
        headers = {"Content-Type": "application/zip"}
        address = f"/v1/lenses/{lens_id}/profile{'?any_lens=true' if any_lens else ''}"
        return read(s.LensOut, self._http.put(address, content=Path(path).read_bytes(), headers=headers))

    def save_report(
        self,
        lens_id: str,
        path: str | Path,
        *,
        form: Literal["json", "csv", "html", "pdf"] | None = None,
        against: str | None = None,
        aperture: float | None = None,
        against_aperture: float | None = None,
        channel: Channel = "g",
    ) -> Path:
        """Save the test report of a lens, in the form that the ending of `path` names unless `form` does.

        With `against`, another lens, or `against_aperture` it is a comparison.

        Raises
        ------
        ServiceProblemError
            With the code `not_ready` while a worker has yet to make it.
        """
        target = Path(path)
        query: Query = {
            "against": against,
            "aperture": aperture,
            "against_aperture": against_aperture,
            "channel": channel,
        }
        kind = form or target.suffix.lower().removeprefix(".")
        return self._save(f"/v1/lenses/{lens_id}/report.{kind}", target, query)

    def _change_lens(self, lens_id: str, change: dict[str, str | int | None]) -> s.LensOut:
        return read(s.LensOut, self._http.patch(f"/v1/lenses/{lens_id}", json=change))
