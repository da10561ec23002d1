"""The colours of maps: from soft to sharp, told apart by lightness too."""

from __future__ import annotations

from typing import Final

from lensmodel.report.drawing import INK

Colour = tuple[int, int, int]

# sRGB; chosen so that lightness rises and falls once, for the colour-blind and for print.
_SOFT: Final[Colour] = (127, 29, 29)
_MIDDLE: Final[Colour] = (253, 246, 227)
_SHARP: Final[Colour] = (11, 110, 153)


def colour(share: float) -> Colour:
    """Dark red for 0 through pale to blue for 1: it also tells apart by lightness and to the colour-blind."""
    ends = (_SOFT, _MIDDLE) if share < 0.5 else (_MIDDLE, _SHARP)
    t = 2.0 * share - (share >= 0.5)
    red, green, blue = (round(a + (b - a) * t) for a, b in zip(*ends, strict=True))
    return red, green, blue


def rgb(value: Colour) -> str:
    """Write a colour as HTML does."""
    return "#" + "".join(f"{part:02x}" for part in value)


def ink(value: Colour) -> str:
    """Black or white, whichever has more contrast (WCAG 2.2, relative luminance)."""
    linear = [(v / 255.0 + 0.055) ** 2.4 / 1.055**2.4 if v > 10 else v / 3294.6 for v in value]
    luminance = 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
    return "#ffffff" if luminance < 0.18 else INK
