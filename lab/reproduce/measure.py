"""What is measured of a lens model and its corrections, all against a truth that it never saw."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, Final, TypeAlias

import numpy as np

from lab.images import blocks, by_zone, fidelity, measure_edges
from lab.kernels import distance
from lab.model_benchmark import asked_places
from lab.reproduce.cases import Case, Shots, guard_of
from lensmodel.core.psf import PsfField
from lensmodel.core.types import CHANNELS, ZONES, Channel, FieldPosition, Frame, Kernel, Planes, Zone, zone_of
from lensmodel.simulate import edge_chart

Place: TypeAlias = tuple[FieldPosition, Channel]
Roi: TypeAlias = tuple[int, int, int, int]  # row, column, height and width of a part of a frame

PSF_SIZE: Final = 55  # pixels of a kernel: the largest of the paper, and what the grids hold
NEAR: Final = 1.5  # a predicted error within this factor of the true one counts as right
PART: Final = 256  # pixels of a side (chosen): four blocks and their borders
_EDGES: Final = 6  # of the chart, in its order


def places() -> list[Place]:
    """Where PSFs are asked for, in every channel: not where patches lie."""
    return [(place, channel) for channel in CHANNELS for place in asked_places()]


def psf_errors(answers: Sequence[tuple[Kernel, float]], truth: PsfField) -> dict[str, Any]:
    """Compare kernels at `places()`, and the errors expected of them, with the truth after alignment."""
    errors: dict[str, dict[str, list[float]]] = {c: {z: [] for z in ZONES} for c in CHANNELS}
    right = []
    for (place, channel), (kernel, expected) in zip(places(), answers, strict=True):
        error = distance(kernel, truth.kernel_at(place, channel, PSF_SIZE)).rel_l2
        errors[channel][zone_of(place.r)].append(error)
        right.append(1.0 / NEAR <= expected / max(error, 1e-9) <= NEAR)
    medians = {c: {z: float(np.median(v)) for z, v in zones.items()} for c, zones in errors.items()}
    return {"rel_l2": medians, "predicted_right": float(np.mean(right))}


def parts(frame: Frame) -> list[Roi]:
    """The parts of a frame that are corrected and compared: centre, two half way out, the four corners."""
    side = min(PART, frame.height // 3 // 2 * 2, frame.width // 3 // 2 * 2)
    bottom, right = frame.height - side, frame.width - side
    inner = [(bottom // 2, right // 2), (bottom // 4, right // 4), (3 * bottom // 4, 3 * right // 4)]
    corners = [(row, col) for row in (0, bottom) for col in (0, right)]
    return [(row // 2 * 2, col // 2 * 2, side, side) for row, col in inner + corners]


def chart_parts(case: Case) -> list[Roi]:
    """The edges of the chart that are corrected and measured: two in the centre, four towards one corner."""
    return [(row // 2 * 2, col // 2 * 2, height // 2 * 2 + 2, width // 2 * 2 + 2)
            for row, col, height, width in _edge_boxes(case)]  # fmt: skip


def _edge_boxes(case: Case) -> list[Roi]:
    return [edge.box for edge in edge_chart(case.camera.frame, guard=guard_of(case)).edges[:_EDGES]]


def edges(chart: Planes, case: Case) -> dict[Zone, dict[str, Any]]:
    """Measure the green slanted edges of the chart by zone; MTF50 in LP/PH."""
    found = {zone: asdict(row) for zone, row in by_zone(measure_edges(chart[1], _edge_boxes(case))).items()}
    for row in found.values():
        for name in ("mtf50", "tangential_mtf50", "sagittal_mtf50"):
            row[name] = None if math.isnan(row[name]) else row[name] * case.height
    return found


def picture(photo: Planes, shots: Shots, case: Case, *, raw: bool = True) -> dict[Zone, float]:
    """PSNR of the held-out photo against the sharp scene in `parts`; `raw` ones are white-balanced for it."""
    gains = np.asarray(case.camera.white_balance, dtype=np.float32)[:, None, None]
    seen = photo * gains if raw else photo
    return fidelity(seen, shots.truth() * gains, case.camera.frame, corners=_blocks(case))


def _blocks(case: Case) -> list[tuple[int, int]]:
    places = parts(case.camera.frame)
    return [(row + r, col + c) for row, col, *size in places for r, c in blocks(Frame(*size))]


def light(photo: Planes, shots: Shots, case: Case) -> dict[Zone, float]:
    """PSNR in dB of linear light by zone of the held-out photo of the raw path, camera's colours."""
    return fidelity(photo, shots.truth(), case.camera.frame, srgb=False, corners=_blocks(case))


def forecast(
    before: Mapping[str, float], after: Mapping[Zone, float], expected: Mapping[str, float | None]
) -> dict[str, dict[str, float | None]]:
    """Gain in PSNR of linear light that a correction expected of itself in each zone, beside the true one."""
    return {
        zone: {"expected": expected[zone], "true": db - before[zone]}
        for zone, db in after.items()
        if zone in expected
    }


def state(
    chart: Planes | None, photo: Planes, shots: Shots, case: Case, *, raw: bool = True
) -> dict[str, Any]:
    """Everything about one version of the chart, if there is one, and of the held-out photo."""
    found = {} if chart is None else edges(chart, case)
    return {"edges": found, "psnr": picture(photo, shots, case, raw=raw)}
