"""Names of cameras and lenses: how they are written, and what is compared of them."""

from __future__ import annotations

import re
from typing import Final

_COMPANY: Final = re.compile(
    r"(ag|cameras?|co|company|computer|corp|corporation|eastman|electronics|gmbh|imaging|inc|kk|ltd|optical)"
)
"""Words of a maker that nobody says (chosen from the makers that files of cameras name)."""

_KIND: Final = re.compile(r"camera|digital|still|zoom")
"""Words at the end of a camera's name that only say what it is."""


def full_name(maker: str | None, model: str | None) -> str:
    """Join a maker and a model that may begin with it; empty where neither is known."""
    maker, model = (maker or "").strip(), (model or "").strip()
    return model if name_key(model).startswith(name_key(maker)) else f"{maker} {model}".strip()


def camera_name(maker: str | None, model: str | None) -> str:
    """Name a camera as people do: "Kodak Z612" for KODAK Z612 ZOOM DIGITAL CAMERA of EASTMAN KODAK."""
    said = [word for word in re.findall(r"[^\s,]+", maker or "") if not _COMPANY.fullmatch(name_key(word))]
    words = (model or "").split()
    while len(words) > 1 and _KIND.fullmatch(name_key(words[-1])):
        words.pop()
    shouted = [word for word in said if len(word) > 3 and (word.isupper() or word.islower())]
    brands = {name_key(word): word.capitalize() if word in shouted else word for word in said}
    if any(name_key(word) in brands for word in words):
        brands = {key: brand for key, brand in brands.items() if key in map(name_key, words)}
        return " ".join(brands.get(name_key(word), word) for word in words)
    return " ".join([*brands.values(), *words])


def name_key(text: str | None) -> str:
    """Return what is compared of a maker or a model: programs differ in case, punctuation and blanks."""
    return re.sub(r"[\W_]+", "", (text or "").casefold())


def serial_key(text: str | None) -> str:
    """Return what is compared of a serial: with its punctuation, which may be all that tells copies apart."""
    return (text or "").strip().casefold()
