"""Samples as JSON and arrays."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lensmodel.core.cross_phase import CrossPhase
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import PsfSample, delta, gaussian
from lensmodel.core.spectrum import PHASE_BINS, RINGS, SECTORS, PatchSpectrum
from lensmodel.core.types import CHANNELS, FieldPosition, LensSettings
from lensmodel.model.sample_codec import PackedSamples, pack_samples, unpack_samples

finite = {"allow_nan": False, "allow_infinity": False}


@st.composite
def spectra(draw: st.DrawFn) -> PatchSpectrum:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    tail = (draw(st.floats(-9, 9, width=32)), draw(st.floats(-9, 9, width=32)))
    numbers = [rng.random(PHASE_BINS, dtype=np.float32) for _ in range(2)]
    cross = CrossPhase(*numbers) if draw(st.booleans()) else None
    return PatchSpectrum(
        rng.random((RINGS, SECTORS), dtype=np.float32), draw(st.floats(0, 1, width=32)), tail, cross
    )


@st.composite
def samples(draw: st.DrawFn) -> PsfSample:
    side = draw(st.sampled_from((1, 3, 7)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    taken = LensSettings(
        draw(st.none() | st.floats(0.5, 128.0)),
        draw(st.none() | st.floats(0.1, 20000.0)),
        draw(st.none() | st.just(math.inf) | st.floats(0.01, 1e4)),
        draw(st.sampled_from(CHANNELS)),
    )
    return PsfSample(
        kernel=rng.random((side, side)) + 1e-3,
        position=FieldPosition(draw(st.floats(0.0, 1.0)), draw(st.floats(-3.1, 3.1))),
        settings=taken,
        weight=draw(st.floats(0.0, 1.0)),
        photo=draw(st.text(max_size=5)),
        pixel_pitch_um=draw(st.none() | st.floats(0.5, 20.0)),
        estimator=draw(st.text(max_size=5)),
        spectrum=draw(st.none() | spectra()),
        error=draw(st.none() | st.floats(0.0, 1.0)),
        half_diagonal_px=draw(st.none() | st.floats(10.0, 1e5)),
    )


def through_files(packed: PackedSamples) -> PackedSamples:
    """The entries as JSON, which has no infinity."""
    return replace(packed, entries=json.loads(json.dumps(packed.entries, allow_nan=False)))


@settings(max_examples=40, deadline=None)
@given(st.lists(samples(), min_size=1, max_size=4))
def test_samples_come_back_as_they_were(given_samples: list[PsfSample]) -> None:
    back = unpack_samples(through_files(pack_samples(given_samples)))

    assert len(back) == len(given_samples)
    for one, other in zip(given_samples, back, strict=True):
        assert one.kernel.shape == other.kernel.shape
        np.testing.assert_allclose(other.kernel, one.kernel, rtol=1e-6)
        for name in PsfSample.__dataclass_fields__.keys() - {"kernel", "spectrum"}:
            assert getattr(other, name) == getattr(one, name), name
        assert (one.spectrum is None) == (other.spectrum is None)
        if one.spectrum is not None and other.spectrum is not None:
            assert one.spectrum.to_bytes() == other.spectrum.to_bytes()


def test_entries_of_earlier_profiles_have_kernels_as_large_as_the_array() -> None:
    packed = pack_samples([PsfSample(gaussian(5, np.eye(2)), FieldPosition(0.5, 0.0))])
    old = [{k: v for k, v in packed.entries[0].items() if k not in {"size", "error", "half_diagonal_px"}}]

    (sample,) = unpack_samples(replace(packed, entries=old))

    assert sample.kernel.shape == (5, 5)
    assert (sample.error, sample.half_diagonal_px, sample.spectrum) == (None, None, None)


@pytest.mark.parametrize("size", [0, 2, 7, -3])
def test_a_side_that_does_not_fit_is_refused(size: int) -> None:
    packed = pack_samples([PsfSample(delta(5), FieldPosition(0.5, 0.0))])

    with pytest.raises(ValueError, match="kernels of side"):
        unpack_samples(replace(packed, entries=[{**packed.entries[0], "size": size}]))


def test_spectra_of_another_shape_are_refused() -> None:
    packed = pack_samples([PsfSample(delta(5), FieldPosition(0.5, 0.0))])

    with pytest.raises(ValueError, match="spectra of shape"):
        unpack_samples(replace(packed, spectra=np.zeros((1, 3), dtype=np.float32)))


def test_values_out_of_range_are_refused() -> None:
    packed = pack_samples([PsfSample(delta(5), FieldPosition(0.5, 0.0))])

    with pytest.raises(InvalidInputError, match="weight"):
        unpack_samples(replace(packed, entries=[{**packed.entries[0], "weight": 2.0}]))
