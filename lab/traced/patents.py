"""Prescriptions of patents, in millimetres at f of about 50, 35, 50 and 58 mm.

Numbers as public transcriptions of the patents give them, compared between at least two where there are
two; that they belong together is tested by focal length and by the image that they form. Clear apertures
are not taken over: copies choose theirs.
"""

from __future__ import annotations

import math
from typing import Final

from lab.traced.prescription import Design, Surface

_FLAT: Final = math.inf


def _stop(thickness: float) -> Surface:
    return Surface(_FLAT, thickness, stop=True)


TRONNIER: Final = Design(
    "tronnier",
    "A. W. Tronnier, US 2,673,491 (1954): double Gauss f/2, scaled to 50 mm; "
    "W. J. Smith, Modern Lens Design, 1992, p. 312",
    (
        Surface(29.475, 3.76, (1.67, 47.1)),
        Surface(84.83, 0.12),
        Surface(19.275, 4.025, (1.67, 47.1)),
        Surface(40.77, 3.275, (1.699, 30.1)),
        Surface(12.75, 5.705),
        _stop(4.5),
        Surface(-14.495, 1.18, (1.603, 38.0)),
        Surface(40.77, 6.065, (1.658, 57.3)),
        Surface(-20.385, 0.19),
        Surface(437.065, 3.22, (1.717, 48.0)),
        Surface(-39.73, 36.114),
    ),
    2.0,
    22.0,
)

RETROFOCUS: Final = Design(
    "retrofocus",
    "JP H04-15611 (1992), example 1: retrofocus wide angle 35 mm f/2",
    (
        Surface(28.25, 1.5, (1.58913, 61.2)),
        Surface(15.79, 15.28),
        Surface(37.84, 10.54, (1.8061, 40.9)),
        Surface(-19.77, 1.53, (1.64769, 33.8)),
        Surface(-142.05, 3.09),
        _stop(3.54),
        Surface(-27.54, 1.94, (1.6727, 32.1)),
        Surface(45.81, 2.0),
        Surface(-46.16, 1.1, (1.78472, 25.7)),
        Surface(276.83, 3.58, (1.7725, 49.6)),
        Surface(-24.15, 0.1),
        Surface(134.67, 3.2, (1.7725, 49.6)),
        Surface(-46.19, 37.83),
    ),
    2.0,
    28.5,
)

ASPHERIC: Final = Design(
    "aspheric",
    "US 2021/0263286, example 1: double Gauss 50 mm f/1.8 with a plastic aspheric element",
    (
        Surface(28.621, 4.2, (1.83481, 42.7)),
        Surface(68.136, 0.18),
        Surface(17.772, 6.7, (1.79952, 42.2)),
        Surface(59.525, 1.1, (1.80518, 25.4)),
        Surface(11.427, 5.27),
        _stop(6.2),
        Surface(-16.726, 0.9, (1.6727, 32.1)),
        Surface(-29.829, 0.83),
        Surface(
            -25.0,
            2.95,
            (1.5311, 55.9),
            asphere=(-4.12032e-05, -2.90015e-07, -4.67119e-09, 7.90646e-11, -9.2847e-13),
        ),
        Surface(
            -18.373,
            0.98,
            asphere=(-2.41619e-05, -3.29146e-07, 1.91098e-10, -9.28593e-13, -2.29193e-13),
        ),
        Surface(280.004, 4.6, (1.734, 51.5)),
        Surface(-34.002, 25.6244),
    ),
    1.84,
    21.5,
)

NOCT: Final = Design(
    "noct",
    "WO 2019/229849, example 1: 58 mm f/0.98 with three aspheric surfaces",
    (
        Surface(
            108.488,
            7.65,
            (1.90265, 35.77),
            asphere=(-3.82177e-07, -6.06486e-11, -3.80172e-15, -1.32266e-18),
        ),
        Surface(-848.55, 2.8, (1.55298, 55.07)),
        Surface(50.252, 18.12),
        Surface(-60.72, 2.8, (1.61266, 44.46)),
        Surface(2497.5, 9.15, (1.59319, 67.9)),
        Surface(-77.239, 0.4),
        Surface(113.763, 10.95, (1.8485, 43.79)),
        Surface(-178.06, 0.4),
        Surface(70.659, 9.74, (1.59319, 67.9)),
        Surface(-1968.5, 0.2),
        Surface(289.687, 8.0, (1.59319, 67.9)),
        Surface(-97.087, 2.8, (1.738, 32.33)),
        Surface(47.074, 8.7),
        _stop(5.29),
        Surface(-95.23, 2.2, (1.61266, 44.46)),
        Surface(41.204, 11.55, (1.49782, 82.57)),
        Surface(-273.092, 0.2),
        Surface(76.173, 9.5, (1.883, 40.69)),
        Surface(-101.575, 0.2),
        Surface(
            176.128,
            7.45,
            (1.95375, 32.33),
            asphere=(-1.15028e-06, -4.51771e-10, 2.7267e-13, -7.66812e-17),
        ),
        Surface(-67.221, 1.8, (1.738, 32.33)),
        Surface(55.51, 2.68),
        Surface(71.413, 6.35, (1.883, 40.69)),
        Surface(-115.025, 1.81, (1.69895, 30.13)),
        Surface(46.943, 0.8),
        Surface(55.281, 9.11, (1.883, 40.69)),
        Surface(-144.041, 3.0, (1.76554, 46.76)),
        Surface(
            52.858,
            14.5,
            asphere=(3.18645e-06, -1.14718e-08, 7.74567e-11, -2.24225e-13, 3.3479e-16, -1.7047e-19),
        ),
        Surface(_FLAT, 1.6, (1.5168, 64.14)),
        Surface(_FLAT, 1.0),
    ),
    0.98,
    18.0,
)

PATENTS: Final = (TRONNIER, RETROFOCUS, ASPHERIC, NOCT)
