"""The local frame: u points outwards, v is u turned by +90 degrees."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.model_benchmark import pixel_to_local
from lensmodel.core.types import FieldPosition, Frame

angles = st.floats(-10, 10)


@given(angles)
def test_u_points_outwards_and_v_is_u_turned_towards_growing_phi(phi: float) -> None:
    frame = Frame(300, 400)
    near = np.array(frame.pixel(FieldPosition(0.3, phi)))
    far = np.array(frame.pixel(FieldPosition(0.3 + 1 / frame.half_diagonal, phi)))
    middle = np.array(frame.pixel(FieldPosition(0.0, 0.0)))
    beside = np.array(frame.pixel(FieldPosition(1 / frame.half_diagonal, phi + math.pi / 2)))

    assert pixel_to_local(*(far - near), phi) == pytest.approx((1.0, 0.0), abs=1e-9)
    assert pixel_to_local(*(beside - middle), phi) == pytest.approx((0.0, 1.0), abs=1e-9)
