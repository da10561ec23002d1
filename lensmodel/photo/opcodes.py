"""Opcode lists of a DNG: what raw converters are to do with its image, kept for a demosaiced one.

Source: Adobe, "Digital Negative (DNG) Specification" 1.6, 2021, chapter 7.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from lensmodel.core.types import BayerPattern

_NAMES: Final = (
    *("", "WarpRectilinear", "WarpFisheye", "FixVignetteRadial", "FixBadPixelsConstant", "FixBadPixelsList"),
    *("TrimBounds", "MapTable", "MapPolynomial", "GainMap", "DeltaPerRow", "DeltaPerColumn", "ScalePerRow"),
    *("ScalePerColumn", "WarpRectilinear2"),
)
_GAIN_MAP: Final = 9
_GAIN_HEAD: Final = struct.Struct(">10I4dI")
_MOST: Final = 64  # opcodes of a list (chosen): cameras write below ten


@dataclass(frozen=True, slots=True)
class Opcode:
    """One step: its number, the DNG version it asks for, flags, and parameters."""

    number: int
    version: int
    flags: int
    data: bytes

    @property
    def name(self) -> str:
        """Name by the specification."""
        return _NAMES[self.number] if 0 < self.number < len(_NAMES) else f"opcode {self.number}"


def read(block: bytes) -> list[Opcode]:
    """Take a list apart; one that is damaged gives what came before the damage."""
    steps, at = list[Opcode](), 4
    for _ in range(min(int.from_bytes(block[:4], "big"), _MOST)):
        head, start = block[at : at + 16], at + 16
        number, version, flags, size = struct.unpack(">4I", head.ljust(16, b"\xff"))
        at = start + size
        if at > len(block):
            break
        steps.append(Opcode(number, version, flags, block[start:at]))
    return steps


def written(steps: list[Opcode]) -> bytes:
    """Put a list together; nothing for no step."""
    body = b"".join(struct.pack(">4I", s.number, s.version, s.flags, len(s.data)) + s.data for s in steps)
    return struct.pack(">I", len(steps)) + body if steps else b""


def demosaiced(steps: list[Opcode], cfa: BayerPattern | None) -> tuple[list[Opcode], list[Opcode]]:
    """Rewrite the steps of OpcodeList2, which are for a mosaic, for an image of three colours.

    A gain map of every second pixel of a mosaic is that of a colour; of the two greens the mean is taken.
    """
    kept, lost, green = list[Opcode](), list[Opcode](), -1
    for step in steps:
        mapped = _gain_of_colours(step, cfa) if step.number == _GAIN_MAP else None
        if mapped is None:
            lost.append(step)
            continue
        colour, whole = mapped
        if colour == 1 and green >= 0 and len(kept[green].data) == len(whole.data):
            kept[green] = _mean(kept[green], whole)
            continue
        green = len(kept) if colour == 1 else green
        kept.append(whole)
    return kept, lost


def _gain_of_colours(step: Opcode, cfa: BayerPattern | None) -> tuple[int | None, Opcode] | None:
    """Return the colour that a gain map of a mosaic is for, None for all, and the map for planes."""
    if len(step.data) < _GAIN_HEAD.size:
        return None
    top, left, bottom, right, _, _, *pitch, across, down = _GAIN_HEAD.unpack_from(step.data)[:10]
    colour = cfa[top % 2][left % 2] if pitch == [2, 2] and cfa is not None else None
    if colour is None and pitch != [1, 1]:
        return None
    if colour is not None:  # the two rows and columns between whose pixels the others stood
        top, left, bottom, right = top - top % 2, left - left % 2, bottom + bottom % 2, right + right % 2
    planes = (0, 3) if colour is None else (colour, 1)
    area = struct.pack(">10I", top, left, bottom, right, *planes, 1, 1, across, down)
    return colour, replace(step, data=area + step.data[len(area) :])


def _mean(one: Opcode, other: Opcode) -> Opcode:
    first, second = (
        np.frombuffer(step.data, ">f4", offset=_GAIN_HEAD.size).astype(np.float64) for step in (one, other)
    )
    middle = ((first + second) / 2.0).astype(">f4").tobytes()
    return replace(one, data=one.data[: _GAIN_HEAD.size] + middle)
