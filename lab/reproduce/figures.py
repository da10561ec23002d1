"""Fig. 2 (interpolation against regression) and Fig. 4 (from edges to the field)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from lab.images import as_shown
from lab.kernels import distance
from lab.reproduce import fields
from lab.reproduce.cases import Case, Reproduction
from lab.reproduce.shots import take
from lensmodel.blind import sampling
from lensmodel.core.errors import LensModelError
from lensmodel.core.geometry import Frame
from lensmodel.core.psf import PsfField, rms_width
from lensmodel.core.types import FieldPosition, Kernel
from lensmodel.model import LensModel
from lensmodel.patches import r_map
from lensmodel.photo import develop

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


def _fig2(cases: Sequence[Case], path: Path) -> dict[str, Any]:
    """True PSFs of as many patches as one photo has; asked in between: error of each way, and a picture."""
    families = {c.family: [one for one in cases if one.family == c.family] for c in cases}
    # the lens whose corner is worst is the one where it matters
    worst = max(cases, key=lambda one: rms_width(one.truth().kernel_at(_SHOWN[-1], "g", _SIZE)))
    truth = [worst.truth().kernel_at(place, "g", _SIZE) for place in _SHOWN]
    ways = {name: [ask(place) for place in _SHOWN] for name, ask in fields.predictors(worst).items()}
    figure = Figure(figsize=(2 * len(_SHOWN), 2 * len(ways) + 2), layout="constrained")
    rows = figure.subplots(1 + len(ways), len(_SHOWN))
    for row, (name, kernels) in zip(rows, {"truth": truth, **ways}.items(), strict=True):
        for ax, place, kernel in zip(row, _SHOWN, kernels, strict=True):
            ax.imshow(shown(kernel), cmap="gray")
            ax.set(
                xticks=[], yticks=[], title=f"r = {place.r:g}, phi = {place.phi:g}" if name == "truth" else ""
            )
        row[0].set_ylabel(name, fontsize=8)
    figure.savefig(path)
    return {
        "picture": path.name,
        "lens": worst.title,
        "errors": {
            name: [distance(a, b).rel_l2 for a, b in zip(kernels, truth, strict=True)]
            for name, kernels in ways.items()
        },
        "table": [
            {"family": family, "lenses": len(lenses), **row}
            for family, lenses in families.items()
            for row in fields.compared(lenses)
        ],
    }


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
    _kernels(axes[3], developed.frame, _asked(LensModel.fit(samples).field(case.settings), developed.frame))
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
