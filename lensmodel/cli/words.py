"""Words that command line, pages and reports share."""

from __future__ import annotations

from typing import Final

NYQUIST: Final = 0.5
"""Cycles/pixel: the Nyquist frequency, the finest detail that a grid of pixels can hold."""


def mtf50_words(frequency: float) -> str:
    """Write an MTF50 in cycles/pixel: a lower bound where contrast has not halved at the pixels' limit."""
    return f"at least {NYQUIST:g}" if frequency >= NYQUIST else f"{frequency:.3f}"


def gain_words(gain: float | None) -> str:
    """Say what gain is expected, in decibels; None is not known."""
    if gain is None:
        return "not known"
    return f"{gain:+.1f} dB" if abs(gain) >= 0.05 else "no change"
