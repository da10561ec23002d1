"""Words that command line, pages and reports share."""

from __future__ import annotations


def gain_words(gain: float | None) -> str:
    """Say what gain is expected, in decibels; None is not known."""
    if gain is None:
        return "not known"
    return f"{gain:+.1f} dB" if abs(gain) >= 0.05 else "no change"
