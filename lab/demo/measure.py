"""Figures of the demo, all against a truth that the service never saw."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from app.client import Client
from lab.demo import camera
from lensmodel import quality
from lensmodel.core.geometry import zone_of
from lensmodel.core.psf import distance
from lensmodel.core.types import ZONES, FieldPosition, Planes, Zone
from lensmodel.photo import develop


@dataclass(frozen=True, slots=True)
class Sharpness:
    """Slanted edges of one zone: MTF50 in cycles/pixel, and the highest value of the MTF."""

    mtf50: float
    mtf_max: float
    overshoot: float


def positions() -> list[FieldPosition]:
    """Where the PSF is asked for: rings from the centre to the corner, not where patches lie."""
    rings = ((0.05, 1), (0.2, 3), (0.45, 4), (0.6, 4), (0.85, 4))
    return [
        FieldPosition(r, 2 * math.pi * (i + 0.3) / count - math.pi)
        for r, count in rings
        for i in range(count)
    ]


def psf_error(client: Client, lens_id: str, version: int) -> dict[Zone, float]:
    """Median relative L2 error of the served green PSFs in each zone, after sub-pixel alignment."""
    lens, settings = camera.demo_lens(), camera.demo_settings()
    errors: dict[Zone, list[float]] = {zone: [] for zone in ZONES}
    for place in positions():
        kernel = client.kernel(
            lens_id, r=place.r, phi=place.phi, aperture=settings.aperture, size=55, version=version
        )
        truth = lens.kernel(place, settings, 55, pitch_um=camera.demo_camera().pitch_um)
        errors[zone_of(place.r)].append(distance(kernel.astype(np.float64), truth).rel_l2)
    return {zone: float(np.median(values)) for zone, values in errors.items()}


def developed(shot: camera.DemoShot) -> Planes:
    """Return the photo as it was, developed in the same way as the service does."""
    return develop(shot.path).planes


def psnr(planes: Planes, shot: camera.DemoShot) -> dict[Zone, float]:
    """PSNR in dB of the sRGB-encoded, white-balanced picture in each zone, registered block by block."""
    gains = np.asarray(camera.demo_camera().white_balance, dtype=np.float32)[:, None, None]
    return quality.registered_zone_psnr(
        planes * gains, shot.sharp() * gains, camera.demo_camera().frame, srgb=True
    )


def sharpness(planes: Planes) -> dict[Zone, Sharpness]:
    """MTF50 and maximum of the MTF on the green edges of the chart, by zone."""
    boxes = [edge.box for edge in camera.chart_edges()]
    by_zone = quality.by_zone(quality.measure_edges(planes[1], boxes))
    return {zone: Sharpness(row.mtf50, row.mtf_max, row.overshoot) for zone, row in by_zone.items()}


def improved(before: dict[Zone, float], after: dict[Zone, float], zones: Sequence[Zone]) -> bool:
    """Whether every one of the zones has become better."""
    return all(after[zone] > before[zone] for zone in zones)
