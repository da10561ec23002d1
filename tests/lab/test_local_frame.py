"""The local frame: u points outwards, v is u turned by +90 degrees."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.model.exact import local_to_pixel, pixel_to_local
from lensmodel.core.geometry import Frame
from lensmodel.core.types import FieldPosition

angles = st.floats(-10, 10)


@given(angles)
def test_u_points_outwards(phi: float) -> None:
    frame = Frame(300, 400)
    near = np.array(frame.pixel(FieldPosition(0.3, phi)))
    far = np.array(frame.pixel(FieldPosition(0.3 + 1 / frame.half_diagonal, phi)))

    u, v = pixel_to_local(*(far - near), phi)

    assert (float(u), float(v)) == (pytest.approx(1.0), pytest.approx(0.0, abs=1e-9))


@given(angles, st.floats(-5, 5), st.floats(-5, 5))
def test_local_frame_round_trip(phi: float, u: float, v: float) -> None:
    back = pixel_to_local(*local_to_pixel(u, v, phi), phi)

    assert np.allclose(np.array(back), (u, v))
