"""Fig. 2 (interpolation against regression) and Fig. 4 (from edges to the field)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from lab.correction.filter_flow import EfficientFilterFlow
from lab.images import as_shown
from lab.model_benchmark import FITS, PATCHES, Fit, compared, samples_of
from lab.reproduce.cases import Case, Reproduction, take
from lensmodel.blind import sampling
from lensmodel.core.errors import LensModelError
from lensmodel.core.psf import PsfField, as_kernel, rms_width
from lensmodel.core.types import FieldPosition, Frame, Kernel
from lensmodel.model import LensModel, ModelField
from lensmodel.patches import r_map
from lensmodel.photo import develop

FRAME: Final = Frame(288, 432)  # of the flow: its weights depend on the place in the field alone

# Layout (chosen): places that are shown, pixels of a kernel, PSFs down and across.
_SHOWN: Final = (FieldPosition(0.5, 2.5), FieldPosition(0.8, 0.55), FieldPosition(0.95, -2.6))
_SIZE: Final = 31
_GRID: Final = (6, 9)


def draw(plan: Reproduction, photos: Path, folder: Path, name: str, *, workers: int = 1) -> dict[str, Any]:
    """Draw both figures into a folder, the second of the first case; return what the page says of them."""
    return {
        "fig2": _fig2(plan.cases, folder / f"{name}-fig2.png"),
        "fig4": _fig4(plan, photos, folder / f"{name}-fig4.png", workers),
    }


# The flow's PSFs stand on a regular grid of 4 x 6 windows with half overlap and Bartlett-Hann slopes, as the
# paper has it; the regressions see as many, one at a random place of each window.


class Flow:
    """The PSF that efficient filter flow applies at a place, from the PSFs at the centres of its windows."""

    def __init__(self, field: PsfField, frame: Frame = FRAME, size: int = _SIZE) -> None:
        self._frame, self._size = frame, size
        pitch = round(frame.height / PATCHES[0])
        self._flow = EfficientFilterFlow.of_field(field, frame, "g", pitch=pitch, size=size)

    def __call__(self, place: FieldPosition) -> Kernel:
        """Blur a point of light at the pixel that is nearest to a place, and cut out what becomes of it."""
        row, col = (round(x) for x in self._frame.pixel(place))
        reach = self._size // 2
        latent = np.zeros(self._flow.latent_shape, dtype=np.float32)
        latent[row + reach, col + reach] = 1.0
        answer = np.pad(self._flow.forward(latent), reach)
        return as_kernel(np.maximum(answer[row : row + self._size, col : col + self._size], 0.0))


WAYS: Final[Mapping[str, Fit]] = {
    "efficient filter flow": lambda truth, _: Flow(truth),
    "the paper's regression": FITS["paper"],
    "regression of today's default": FITS["mode-default"],
}


def _fig2(cases: Sequence[Case], path: Path) -> dict[str, Any]:
    """True PSFs of as many patches as one photo has; asked in between: a picture, and errors by family."""
    # the lens whose corner is worst is the one where it matters
    worst = max(cases, key=lambda one: rms_width(one.truth().kernel_at(_SHOWN[-1], "g", _SIZE)))
    true, samples = worst.truth(), samples_of(worst.truth(), worst.seed, photos=1)
    ways = {"truth": [true.kernel_at(place, "g", _SIZE) for place in _SHOWN]}
    ways |= {name: [*map(fit(true, samples), _SHOWN)] for name, fit in WAYS.items()}
    figure = Figure(figsize=(2 * len(_SHOWN), 2 * len(ways)), layout="constrained")
    rows = figure.subplots(len(ways), len(_SHOWN))
    for row, (name, kernels) in zip(rows, ways.items(), strict=True):
        for ax, place, kernel in zip(row, _SHOWN, kernels, strict=True):
            ax.imshow(shown(kernel), cmap="gray")
            ax.set(xticks=[], yticks=[], title=_place(place) if name == "truth" else "")
        row[0].set_ylabel(name, fontsize=8)
    figure.savefig(path)
    families = {c.family: [one for one in cases if one.family == c.family] for c in cases}
    table = [
        {"family": family, "lenses": len(lenses), **row}
        for family, lenses in families.items()
        for row in compared([(one.seed, one.truth()) for one in lenses], WAYS)
    ]
    return {"picture": path.name, "lens": worst.title, "table": table}


def _place(place: FieldPosition) -> str:
    return f"r = {place.r:g}, phi = {place.phi:g}"


def _fig4(plan: Reproduction, photos: Path, path: Path, workers: int) -> dict[str, Any]:
    """Confidence map with the patches, the PSF of each patch, and the regressed field."""
    case = plan.cases[0]
    shots = take(case, plan.files(), photos, photos=1)
    developed = develop(shots.learn[0])
    chosen = sampling.find_patches(developed, count=sampling.PRESETS["default"].patches).patches
    try:
        samples = sampling.samples_of_photo(shots.learn[0], workers=workers)
    except LensModelError as error:
        return {"failed": str(error)}
    green = [s for s in samples if s.settings.channel == "g"]
    figure = Figure(figsize=(15, 8), layout="constrained")
    axes = figure.subplots(2, 3).ravel()
    confidence = np.sqrt(np.clip(r_map(developed.planes[1]), 0.0, None))
    axes[0].imshow(confidence, cmap="gray", vmax=float(np.percentile(confidence, 99.0)))
    axes[1].imshow(as_shown(developed.planes, case.camera.white_balance))
    for p in chosen:
        axes[1].add_patch(Rectangle((p.col, p.row), p.size, p.size, fill=False, edgecolor="#ffb300"))
    _kernels(axes[2], developed.frame, [(s.position, s.kernel) for s in green])
    _kernels(
        axes[3], developed.frame, _asked(ModelField(LensModel.fit(samples), case.settings), developed.frame)
    )
    _kernels(axes[4], developed.frame, _asked(case.truth(), developed.frame))
    titles = ("Confidence map", f"{len(chosen)} patches", "Their PSFs", "Regressed field", "The truth", "")
    for ax, title in zip(axes, titles, strict=True):
        ax.set(title=title, xticks=[], yticks=[])
    axes[5].set_axis_off()
    figure.savefig(path)
    return {"lens": case.title, "patches": len(chosen), "samples": len(green), "picture": path.name}


def _asked(field: PsfField, frame: Frame) -> list[tuple[FieldPosition, Kernel]]:
    """Kernels of a field on a regular grid."""
    rows, cols = ((np.arange(n) + 0.5) / n for n in _GRID)
    places = [frame.position(row * frame.height, col * frame.width) for row in rows for col in cols]
    return [(place, field.kernel_at(place, "g", _SIZE)) for place in places]


def _kernels(ax: Axes, frame: Frame, kernels: Iterable[tuple[FieldPosition, Kernel]]) -> None:
    """Draw kernels enlarged where they belong in a frame."""
    half = 0.45 * frame.width / _GRID[1]
    for place, kernel in kernels:
        row, col = frame.pixel(place)
        ax.imshow(shown(kernel), cmap="gray", extent=(col - half, col + half, row + half, row - half))
    ax.set(xlim=(0, frame.width), ylim=(frame.height, 0), facecolor="#1e1e1e")


def shown(kernel: Kernel) -> Kernel:
    """Scale a kernel to its peak, with gamma 0.5 as in the paper's figures."""
    return np.sqrt(kernel / kernel.max())
