"""Kernels as JSON, PNG, NumPy and TIFF; the field as a picture."""

from __future__ import annotations

import io
import math
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Final, Literal

import numpy as np
import tifffile
from PIL import Image

from app.http.model_cache import Fitted
from app.schemas import KernelOut, PsfOut, PsfQuery, QueryOut, Support, Units
from lensmodel.core.geometry import Frame
from lensmodel.core.types import FieldPosition, Kernel
from lensmodel.model import PsfAnswer
from lensmodel.report.lens_report import UNKNOWN

SIDE: Final = 1000  # height of the frame of a map in pixels (chosen): only its aspect ratio matters
DIGITS: Final = 10  # decimals of kernels, whose sum is 1, in JSON (chosen): float32 resolves no more of 0.001
SCALE: Final = "X-PSF-Scale"
ANSWERED_BY: Final = "X-PSF-Answered-By"
# What headers say of pictures and arrays, which have no other room for it
HEADERS: Final = {
    SCALE: "of one PSF as PNG: the value of white, and the gamma",
    ANSWERED_BY: "what made the answer, as `support.answered_by` of the JSON, which has no such header; of a "
    "map all that took part, those of most places first, with semicolons between",
}
GAP_PX: Final = 2  # pixels between the kernels of a map (chosen for looks)
HATCH_PX: Final = 7  # pixels between the strokes over a cell that is not known (chosen for looks)


def describe(
    lens_id: str, fitted: Fitted, at: PsfQuery, answer: PsfAnswer, pixel_pitch_um: float | None
) -> PsfOut:
    """Describe an answer and its support, without the kernel, which most formats carry themselves."""
    error = float(answer.predicted_error)
    phi = at.phi if -math.pi < at.phi <= math.pi else FieldPosition(at.r, at.phi).phi
    question = QueryOut.model_validate(at.model_dump(include=set(QueryOut.model_fields)) | {"phi": phi})
    return PsfOut(
        lens_id=lens_id,
        version=fitted.state.version,
        query=question,
        psf=KernelOut(shape=(at.size, at.size), dtype="float32", data=[]),
        support=Support(
            effective_samples=float(answer.effective_samples),
            photos=answer.photos,
            extrapolated=answer.extrapolated,
            beyond=list(answer.beyond),
            predicted_error=error if np.isfinite(error) else None,
            answered_by=answer.answered_by,
            weights=answer.weights,
            nearest=answer.nearest,
        ),
        bandwidth=fitted.model.bandwidth,
        units=Units(pixel_pitch_um=pixel_pitch_um),
    )


def psf(
    form: Literal["json", "png", "npy", "tiff"], kernel: Kernel, described: PsfOut
) -> tuple[bytes, Mapping[str, str]]:
    """Encode a kernel; return the bytes and the headers that describe them."""
    if form == "json":
        values = np.round(kernel, DIGITS).tolist()
        full = described.model_copy(update={"psf": described.psf.model_copy(update={"data": values})})
        return full.model_dump_json().encode(), {}
    at, headers, buffer = described.query, {ANSWERED_BY: described.support.answered_by}, io.BytesIO()
    aperture = "" if at.aperture is None else f"-f{at.aperture:g}"
    name = f"psf-v{described.version}-r{at.r:.3f}-phi{at.phi:.3f}{aperture}-{at.channel}.{form}"
    headers["Content-Disposition"] = f'inline; filename="{name}"'
    if form == "npy":
        np.save(buffer, kernel.astype("<f4"), allow_pickle=False)
    elif form == "tiff":
        text = described.model_dump_json(exclude={"psf"})  # tifffile would interpret a "shape" in it
        pixels = kernel.astype(np.float32)
        tifffile.imwrite(buffer, pixels, photometric="minisblack", description=text, metadata=None)
    else:
        peak = float(kernel.max())
        headers[SCALE] = f"max={peak:.9g}; gamma=1"
        Image.fromarray(np.round(kernel / peak * 65535).astype(np.uint16)).save(buffer, "PNG")
    return buffer.getvalue(), headers


def field_map(
    ask: Callable[[FieldPosition], PsfAnswer],
    *,
    columns: int,
    rows: int,
    size: int,
    aspect: float,
) -> tuple[bytes, Mapping[str, str]]:
    """Draw kernels of side `size` on a grid over the field as an 8-bit PNG, each scaled to its own peak."""
    # Where too little is known the cell is hatched, as in reports.
    frame = Frame(SIDE, round(SIDE * aspect))
    pitch = size + GAP_PX
    sheet = np.full((rows * pitch + GAP_PX, columns * pitch + GAP_PX), 40, dtype=np.uint8)
    hatched = np.where(np.add.outer(np.arange(size), np.arange(size)) % HATCH_PX < 2, 110, 40)
    made: Counter[str] = Counter()
    for row, column in np.ndindex(rows, columns):
        down, across = (row + 0.5) / rows, (column + 0.5) / columns
        answer = ask(frame.position(down * (frame.height - 1), across * (frame.width - 1)))
        made[answer.answered_by] += 1
        top, left = row * pitch + GAP_PX, column * pitch + GAP_PX
        known = answer.predicted_error < UNKNOWN and not answer.extrapolated
        bright = np.round(np.sqrt(answer.kernel / answer.kernel.max()) * 255)
        sheet[top : top + size, left : left + size] = bright if known else hatched
    buffer = io.BytesIO()
    Image.fromarray(sheet).save(buffer, "PNG")
    return buffer.getvalue(), {ANSWERED_BY: "; ".join(name for name, _ in made.most_common())}
