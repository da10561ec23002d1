"""The development set by name: four of `optiland`'s samples and those of `patents`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Final

from lab.traced.patents import PATENTS
from lab.traced.prescription import Design, Glass, surfaces_of
from lensmodel.core.registry import Registry

_LLF6: Final[Glass] = "E-LLF6"


def _sample(
    sample: str, name: str, source: str, glasses: tuple[Glass, ...], f_number: float, half_field_deg: float
) -> Callable[[], Design]:
    @cache
    def make() -> Design:
        from optiland.samples import objectives

        surfaces = surfaces_of(getattr(objectives, sample)(), glasses)
        return Design(name, source, surfaces, f_number, half_field_deg)

    return make


designs: Final[Registry[Design]] = Registry(
    "design",
    {
        "heliar": _sample(
            "HeliarLens",
            "heliar",
            "M. Laikin, Lens Design, 4th ed., 2007, p. 63",
            ("N-SK16", _LLF6, None, _LLF6, None, None, _LLF6, "N-SK16", None),
            5.0,
            10.0,
        ),
        "telephoto": _sample(
            "Telephoto",
            "telephoto",
            "M. Laikin, Lens Design, 4th ed., 2007, p. 91",
            ("N-BK7", "N-BASF2", None, None, "N-ZK7", "N-LAF33", None, ("SF1", "schott"), None),
            5.6,
            10.0,
        ),
        "reverse-telephoto": _sample(
            "ReverseTelephoto",
            "reverse-telephoto",
            "sample ReverseTelephoto of optiland",
            (
                "N-SK10",
                None,
                "SK15",
                None,
                "BASF2",
                None,
                "FK3",
                None,
                None,
                ("SF15", "hikari"),
                None,
                "N-LAK12",
                None,
            ),
            6.7,
            30.0,
        ),
        "field-corrector": _sample(
            "LensWithFieldCorrector",
            "field-corrector",
            "M. Laikin, Lens Design, 4th ed., 2007, p. 66",
            ("N-SK16", None, None, ("F5", "schott"), None, "N-SK16", None, "N-SK16", None, "N-SK4", None),
            3.5,
            9.65,
        ),
        **{design.name: partial(replace, design) for design in PATENTS},
    },
)
"""Designs by name. Those of the samples need the tracer, also to be read."""
