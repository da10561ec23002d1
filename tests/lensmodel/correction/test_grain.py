"""What the prior takes of a mosaic comes back as detail of its colour and as grain of none."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from lensmodel.correction.compiled.common import smooth
from lensmodel.correction.compiled.grain import spread_grain

LIGHT = np.array([0.3, 0.4, 0.2], dtype=np.float32)
NOISE = np.array([[1e-4, 1e-6]] * 3, dtype=np.float32)
CLIP = np.ones(3, dtype=np.float32)


def sites(shape: tuple[int, int]) -> np.ndarray:
    """Where each colour of a mosaic was measured, `(3, rows, cols)`."""
    colours = np.tile(((0, 1), (1, 2)), (shape[0] // 2, shape[1] // 2))
    return np.stack([colours == c for c in range(3)])


def demosaiced(mosaic: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Green between its neighbours, the others by their difference from it, as usual."""
    taps = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4.0

    def between(plane: np.ndarray, at: np.ndarray) -> np.ndarray:
        total, count = (ndimage.convolve(p * at, taps, mode="mirror") for p in (plane, np.ones_like(plane)))
        return np.where(at, plane, total / count)

    green = between(mosaic[1], known[1])
    return np.stack([green + between(mosaic[c] - green, known[c]) if c != 1 else green for c in range(3)])


def returned(left: np.ndarray, photo: np.ndarray) -> np.ndarray:
    known, out = sites(photo.shape[1:]), np.empty_like(photo)
    spread_grain(photo, demosaiced(left, known).astype(np.float32), known, CLIP, NOISE, LIGHT, out)
    return out


def flat(shape: tuple[int, int] = (64, 80)) -> np.ndarray:
    return np.ascontiguousarray(np.broadcast_to(LIGHT[:, None, None], (3, *shape)), dtype=np.float32)


def test_fine_grain_has_no_colour_and_its_own_strength() -> None:
    photo = flat()
    sigma = np.sqrt(NOISE[:, 0] * LIGHT + NOISE[:, 1])[:, None, None]
    left = sigma * np.random.default_rng(0).standard_normal(photo.shape)

    out = returned(left, photo)

    fine = out - np.stack([ndimage.gaussian_filter(plane, 2.0) for plane in out])
    relative = (fine / LIGHT[:, None, None]).reshape(3, -1)
    assert np.corrcoef(relative).min() > 0.6
    seen = [np.tensordot([0.25, 0.6, 0.15], p, 1) for p in (out, demosaiced(left, sites(photo.shape[1:])))]
    for high in (1.0, 2.0):
        kept, before = (np.var(p - ndimage.gaussian_filter(p, high)) for p in seen)
        assert 0.8 < kept / before < 1.1


def test_coarse_grain_has_less_colour_than_it_had() -> None:
    photo = flat()
    sigma = np.sqrt(NOISE[:, 0] * LIGHT + NOISE[:, 1])[:, None, None]
    left = sigma * np.random.default_rng(3).standard_normal(photo.shape)

    colours = [
        np.var(ndimage.gaussian_filter((p / LIGHT[:, None, None])[0] - (p / LIGHT[:, None, None])[2], 2.0))
        for p in (returned(left, photo), demosaiced(left, sites(photo.shape[1:])))
    ]

    assert colours[0] < 0.6 * colours[1]


def test_detail_that_demosaicing_made_does_not_come_back() -> None:
    photo, left = flat(), np.zeros((3, 64, 80))
    left[:, :, 40::2] = 0.05  # columns that no noise explains
    left[sites((64, 80))] = 0.0
    known, out = sites(photo.shape[1:]), np.empty_like(photo)

    spread_grain(photo, left.astype(np.float32), known, CLIP, NOISE, LIGHT, out)

    assert np.abs(out[:, 8:-8, 48:-8]).max() < 0.002


def test_detail_of_one_colour_stays_in_it() -> None:
    left = np.zeros((3, 64, 80))
    left[2, 20:44, 20:60] = 0.01

    out = returned(left, flat())

    assert out[2, 26:38, 26:54].mean() > 0.009
    assert np.abs(out[:2]).max() < 0.004  # at its edges


def test_what_no_noise_explains_is_not_spread_to_other_colours() -> None:
    left = np.zeros((3, 64, 80))
    left[0, 32, 40] = 0.5  # an error of the kernel beside an edge

    assert np.abs(returned(left, flat())[1:]).max() < 0.03


def test_nothing_is_added_where_the_photo_is_clipped() -> None:
    photo = flat()
    photo[:, 10:20, 10:20] = 1.0
    left = 0.01 * np.random.default_rng(1).standard_normal(photo.shape)

    assert not returned(left, photo)[:, 10:20, 10:20].any()


def test_filters_are_those_of_scipy() -> None:
    plane = np.random.default_rng(2).random((30, 41), dtype=np.float32)
    weights = np.array([0.1, 0.2, 0.4, 0.2, 0.1], dtype=np.float32)
    for wrapped, mode in ((True, "wrap"), (False, "constant")):
        out = np.empty_like(plane)
        smooth(plane, weights, out, wrapped=wrapped)
        expected = ndimage.correlate1d(
            ndimage.correlate1d(plane, weights, axis=0, mode=mode), weights, axis=1, mode=mode
        )
        np.testing.assert_allclose(out, expected, atol=1e-6)
