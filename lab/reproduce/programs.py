"""What people use instead, on the same chart and photo: programs run from outside, where they are installed.

Each gets the developed photo and the best of its settings, chosen against the truth by PSNR; the
chart is corrected with that setting too.
"""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import Final

import numpy as np

from lab import peers
from lab.code_version import version_of
from lab.images import psnr, to_srgb
from lensmodel.core.types import Planes
from lensmodel.photo.colour import srgb_to_linear

_NAMES: Final = ("G'MIC Richardson-Lucy", "RawTherapee capture sharpening")
_DARK: Final = 1e-3  # light added to both sides of a ratio, full scale is 1 (chosen): dark places have none
_MOST: Final = 5.0  # largest ratio, and its inverse the least (chosen)

Gains = tuple[float, float, float]


def installed() -> tuple[str, ...]:
    """Names of the programs that take part here."""
    return tuple(peer.name for peer in peers.PEERS if peer.name in _NAMES and peer.installed)


def named(name: str) -> peers.Peer:
    """Return the program of a name."""
    return next(peer for peer in peers.PEERS if peer.name == name)


def label_of(name: str) -> str:
    """Return the name as part of a file's name."""
    return re.sub(r"[^a-z]+", "-", name.lower().replace("'", ""))


def version() -> str:
    """Hash of the code: what a program made by another version is made again."""
    return version_of("lab.reproduce.programs")[:8]


def best_setting(peer: peers.Peer, photo: Planes, truth: Planes, gains: Gains) -> tuple[float, Planes]:
    """Try every setting of a program on a photo.

    Returns
    -------
    setting : float
        The one with the highest PSNR of the sRGB picture.
    corrected : Planes
        Linear light of the sensor.
    """
    balance = np.asarray(gains, dtype=np.float32)[:, None, None]
    made = [(setting, corrected_by(peer, photo, setting, gains)) for setting in peer.settings]
    return max(made, key=lambda one: psnr(one[1] * balance, truth * balance, srgb=True))


def corrected_by(peer: peers.Peer, planes: Planes, setting: float, gains: Gains) -> Planes:
    """Correct planes with a program.

    One that develops a mosaic is run with its correction and without; the ratio of the two is what
    its correction does to the light, whatever else it does to colours.
    """
    balance = np.asarray(gains, dtype=np.float32)[:, None, None]
    light = np.clip(planes * balance, 0.0, 1.0).astype(np.float32)
    if not peer.raw:
        return (_run(peer, to_srgb(light).astype(np.float32), setting, light) / balance).astype(np.float32)
    after, before = (_run(peer, light, one, light) for one in (setting, 0.0))
    ratio = np.clip((after + _DARK) / (before + _DARK), 1.0 / _MOST, _MOST)
    return (light * ratio / balance).astype(np.float32)


def _run(peer: peers.Peer, shown: Planes, setting: float, like: Planes) -> Planes:
    """Linear light of what a program makes of a picture; a border that it cuts off is repeated."""
    with tempfile.TemporaryDirectory(prefix="lensmodel-program-") as name:
        source = Path(name) / ("in.dng" if peer.raw else "in.tif")
        peer.write_input(np.moveaxis(shown, 0, -1), source)
        made = np.moveaxis(peers.read_picture(peer.run(source, Path(name), setting)[0]), -1, 0)
    lost = [(n - m, (n - m) // 2) for n, m in zip(like.shape[1:], made.shape[1:], strict=True)]
    padded = np.pad(made, ((0, 0), *((before, total - before) for total, before in lost)), mode="edge")
    return np.asarray(srgb_to_linear(padded), dtype=np.float32)
