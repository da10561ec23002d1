"""Colour spaces that a file declares by numbers instead of by an ICC profile, as profiles.

Sources: "Portable Network Graphics, third edition", W3C, 2025, sections 4.3 and 11.3.2; ITU-T H.273, 2021;
CIPA DC-008-2023 (Exif 3.0) and DCF 2.0, 2010 (R03); "TIFF Revision 6.0", Aldus, 1992, section 20.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import UnsupportedFormatError
from lensmodel.photo.colour import declared_profile, named_profile

Curve = float | NDArray[np.float64] | None
"""As `declared_profile` takes it."""

USUAL_GAMMA: Final = 1.0 / 0.45455
"""By which files approximate the curve of sRGB."""


@dataclass(frozen=True, slots=True)
class ColourSpace:
    """Chromaticities x, y of white, and of red, green and blue."""

    white: tuple[float, float]
    primaries: tuple[float, ...]

    @classmethod
    def of(cls, white: Sequence[float], primaries: Sequence[float]) -> ColourSpace | None:
        """Return it where the primaries span a triangle around the white."""
        if len(white) != 2 or len(primaries) != 6 or not np.isfinite([*white, *primaries]).all():
            return None
        corners = np.reshape(primaries, (3, 2)) - np.asarray(white)
        following = np.roll(corners, -1, axis=0)
        areas = corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]
        spans = white[1] > 0.01 and (areas.min() > 1e-3 or areas.max() < -1e-3)
        return cls((white[0], white[1]), tuple(primaries)) if spans else None

    def profile(self, curve: Curve) -> bytes | None:
        """Profile of the space with a curve; None where it is sRGB, or its usual approximation."""
        pairs = zip((*self.white, *self.primaries), (*BT709.white, *BT709.primaries), strict=True)
        usual = curve is None or (isinstance(curve, float) and abs(curve - USUAL_GAMMA) < 0.02)
        if usual and max(abs(a - b) for a, b in pairs) < 0.002:  # files round them
            return None
        return declared_profile(self.white, self.primaries, curve)


def _bt709(codes: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(codes < 0.081, codes / 4.5, ((codes + 0.099) / 1.099) ** (1.0 / 0.45))


_D65: Final = (0.3127, 0.329)
BT709: Final = ColourSpace(_D65, (0.64, 0.33, 0.30, 0.60, 0.15, 0.06))
_PRIMARIES: Final[Mapping[int, ColourSpace]] = {
    1: BT709,
    9: ColourSpace(_D65, (0.708, 0.292, 0.170, 0.797, 0.131, 0.046)),  # BT.2020
    12: ColourSpace(_D65, (0.680, 0.320, 0.265, 0.690, 0.150, 0.060)),  # Display P3
}
_TELEVISION: Final = _bt709(np.linspace(0.0, 1.0, 4096))
_CURVES: Final[Mapping[int, Curve]] = {
    **dict.fromkeys((1, 6, 14, 15), _TELEVISION),
    4: 2.2,
    5: 2.8,
    8: 1.0,
    13: None,
}


def by_chunks(icc: bytes | None, chunks: Mapping[bytes, bytes]) -> bytes | None:
    """Profile of a PNG by its chunks, in their order of precedence; None is sRGB."""
    if len(coded := chunks.get(b"cICP", b"")) == 4:
        primaries, curve, matrix, full = coded
        if primaries not in _PRIMARIES or curve not in _CURVES or matrix != 0 or full != 1:
            hdr = {16: ", PQ", 18: ", HLG"}.get(curve, "")
            raise UnsupportedFormatError(
                f"the PNG's colours are coded as {primaries}/{curve}/{matrix}/{full} (ITU-T H.273{hdr}), "
                "which is not read; convert it to sRGB or Display P3"
            )
        return _PRIMARIES[primaries].profile(_CURVES[curve])
    if icc is not None or b"sRGB" in chunks:
        return icc
    space, gamma = BT709, USUAL_GAMMA
    if len(inverse := chunks.get(b"gAMA", b"")) == 4 and any(inverse):
        gamma = 100_000.0 / struct.unpack(">I", inverse)[0]
    if len(places := chunks.get(b"cHRM", b"")) == 32:
        numbers = [place / 100_000.0 for place in struct.unpack(">8I", places)]
        space = ColourSpace.of(numbers[:2], numbers[2:]) or BT709
    return space.profile(gamma) if 0.1 < gamma < 10.0 else None


def by_tags(
    colour_space: int | None,
    interoperability: str | None,
    white: Sequence[float],
    primaries: Sequence[float],
    gamma: float | None,
    transfer: Sequence[float],
) -> bytes | None:
    """Profile of a TIFF or JPEG by its tags; None is sRGB, or nothing that can be used."""
    if colour_space == 1:
        return None
    if interoperability == "R03" or colour_space == 2:
        return named_profile("adobergb")
    curve: Curve = gamma if gamma is not None and 0.1 < gamma < 10.0 else None
    if len(transfer) in {256, 768, 65536, 196608}:
        table = np.reshape(transfer, (-1, 256 if len(transfer) < 1000 else 65536)) / 65535.0
        curve = np.stack([row[np.rint(np.linspace(0, len(row) - 1, 4096)).astype(int)] for row in table])
        curve = curve if len(curve) == 3 else curve[0]
    space = ColourSpace.of(white, primaries) if len(white) or len(primaries) else BT709
    return None if space is None else space.profile(curve)
