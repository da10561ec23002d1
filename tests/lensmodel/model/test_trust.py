"""What the regression says of itself: reference sums, outliers, errors, profiles."""

from __future__ import annotations

import contextlib
import json
import math
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import chain
from pathlib import Path

import numpy as np
import pytest

from lab.model.exact import PaperModel, all_pairs, factorised
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import PsfSample, distance, gaussian
from lensmodel.core.types import FieldPosition, Kernel, LensSettings
from lensmodel.model import LensModel, LensProfile, ModelSettings, load_profile, save_profile

SIZE = 21
GREEN = LensSettings(aperture=2.0)
WIDTHS = {
    "r": 0.1,
    "phi": 0.5,
    "aperture_stops": 0.5,
    "wavelength_nm": 20.0,
    "focal_octaves": 0.25,
    "focus_dioptres": 0.5,
}


@cache
def truth(position: FieldPosition, size: int = SIZE) -> Kernel:
    c, s = math.cos(position.phi), math.sin(position.phi)
    u, v = np.array([-s, c]), np.array([-c, -s])
    along, across = 0.8 + 1.0 * position.r**2, 1.0 + 1.4 * position.r**2
    return gaussian(size, along**2 * np.outer(u, u) + across**2 * np.outer(v, v))


def places(count: int, seed: int) -> list[FieldPosition]:
    rng = np.random.default_rng(seed)
    r = np.sqrt(rng.uniform(0.0, 0.9, count))
    angles = rng.uniform(-math.pi, math.pi, count)
    return [FieldPosition(float(a), float(p)) for a, p in zip(r, angles, strict=True)]


@cache
def photo(
    name: str, seed: int, *, noise: float = 0.0, blur: float = 0.0, count: int = 16
) -> tuple[PsfSample, ...]:
    """Samples of one photo; `blur` adds variance along the rows, `noise` is relative at the peak."""
    rng = np.random.default_rng([seed, 1])
    found = []
    for where in places(count, seed):
        kernel = np.array(truth(where))
        if blur:
            shake = np.array(gaussian(SIZE, [[blur, 0.0], [0.0, 1e-3]]))
            kernel = np.fft.ifft2(np.fft.fft2(kernel) * np.fft.fft2(np.fft.ifftshift(shake))).real
        kernel = np.maximum(kernel, 0.0)
        # noise that leaves the empty surroundings empty: clipped there, it would be a bias, not noise
        kernel = np.maximum(
            kernel + rng.normal(0.0, noise, kernel.shape) * np.sqrt(kernel * kernel.max()), 0.0
        )
        found.append(PsfSample(kernel, where, GREEN, photo=name))
    return tuple(found)


def merged(photos: Sequence[Sequence[PsfSample]]) -> list[PsfSample]:
    return list(chain.from_iterable(photos))


def error(model: LensModel, seed: int = 99) -> float:
    return float(
        np.mean([distance(model.query(p, GREEN, SIZE).kernel, truth(p)).rel_l2 for p in places(12, seed)])
    )


@pytest.fixture(scope="module")
def good() -> list[tuple[PsfSample, ...]]:
    return [photo(f"p{i}", i, noise=0.01) for i in range(9)]


def test_factorised_sum_equals_the_sum_over_all_pairs() -> None:
    rng = np.random.default_rng(0)
    samples = [
        PsfSample(rng.random((9, 9)), p, GREEN, weight=float(w))
        for p, w in zip(places(5, 4), rng.random(5), strict=True)
    ]
    for where in places(3, 8):
        flat = all_pairs(samples, where, GREEN, 9, pixel=0.6, widths=WIDTHS)
        fast = factorised(samples, where, GREEN, 9, pixel=0.6, widths=WIDTHS)
        assert np.abs(flat - fast).max() <= 1e-12 * flat.max()


def test_canonical_path_is_within_two_hundredths_of_the_exact_sum() -> None:
    samples = photo("a", 0)
    fixed = ModelSettings(r=0.1, phi=0.5, stops=0.5, mode="paper")
    model = LensModel.fit(samples, fixed)
    for where in places(4, 5):
        exact = factorised(samples, where, GREEN, SIZE, pixel=0.3, widths=WIDTHS)
        exact /= exact.sum()
        fast = model.query(where, GREEN, SIZE).kernel
        # the exact sum smooths by h_u^2 = 0.09 px^2 and by the pixel grid; the spline does not
        assert np.abs(fast - exact).max() <= 0.08 * exact.max()


def test_bandwidth_of_the_paper_taken_literally_widens_the_psf() -> None:
    samples = [s for i in range(3) for s in photo(f"p{i}", i)]
    where = FieldPosition(0.5, 0.4)
    literal = PaperModel.fit(samples).kernel_at_settings(where, GREEN, SIZE)
    ours = LensModel.fit(samples).query(where, GREEN, SIZE).kernel

    assert distance(literal, truth(where)).rel_l2 > 3 * distance(ours, truth(where)).rel_l2


def test_bandwidths_are_those_of_green_in_whatever_order_channels_come(
    good: list[tuple[PsfSample, ...]],
) -> None:
    green = merged(good[:3])
    noisy = merged([photo(f"p{i}", i, noise=0.5) for i in range(3)])
    blue = [replace(s, settings=s.settings.with_channel("b")) for s in noisy]
    plain = ModelSettings(mode="paper")
    of_green = LensModel.fit(green, plain).bandwidth

    for samples in ([*green, *blue], [*blue, *green]):
        assert LensModel.fit(samples, plain).bandwidth == of_green


class TestOutliers:
    def test_one_bad_photo_moves_the_field_by_less_than_a_tenth_of_a_plain_mean(
        self, good: list[tuple[PsfSample, ...]]
    ) -> None:
        clean, bad = merged(good), photo("shaken", 50, blur=16.0)
        fixed = {"r": 0.12, "phi": 0.5}

        def moved(mode: str) -> float:
            settings = ModelSettings(mode=mode, **fixed)  # type: ignore[arg-type] # values of one dict
            before, after = LensModel.fit(clean, settings), LensModel.fit([*clean, *bad], settings)
            return float(
                np.mean(
                    [
                        np.linalg.norm(
                            before.query(p, GREEN, SIZE).kernel - after.query(p, GREEN, SIZE).kernel
                        )
                        for p in places(15, 77)
                    ]
                )
            )

        assert moved("default") < 0.1 * moved("paper")

    def test_excluded_photo_stays_and_has_no_weight(self, good: list[tuple[PsfSample, ...]]) -> None:
        without = LensModel.fit(merged(good[:3]), ModelSettings(excluded=("p1",)))
        where = FieldPosition(0.5, 0.5)

        assert without.query(where, GREEN, SIZE).photos == 2
        assert len(without.samples) == len(merged(good[:3]))


class TestHonesty:
    def test_error_falls_with_the_number_of_photos(self) -> None:
        noisy = [photo(f"p{i}", i, noise=0.3) for i in range(10)]

        assert error(LensModel.fit(merged(noisy))) < 0.75 * error(LensModel.fit(noisy[0]))

    def test_predicted_error_is_of_the_size_of_the_true_one(self) -> None:
        model = LensModel.fit(merged([photo(f"p{i}", i, noise=0.2) for i in range(6)]))
        ratios = []
        for where in places(20, 31):
            answer = model.query(where, GREEN, SIZE)
            ratios.append(answer.predicted_error / distance(answer.kernel, truth(where)).rel_l2)

        assert 0.5 < float(np.median(ratios)) < 4.0

    def test_corner_without_samples_is_called_extrapolated(self) -> None:
        inner = [s for i in range(3) for s in photo(f"p{i}", i) if s.position.r < 0.5]
        model = LensModel.fit(inner)

        assert "place" in model.query(FieldPosition(1.0, 0.2), GREEN, SIZE).beyond
        assert not model.query(FieldPosition(0.3, 0.2), GREEN, SIZE).extrapolated

    def test_zones_expect_more_where_there_are_no_samples(self) -> None:
        inner = [s for i in range(3) for s in photo(f"p{i}", i, noise=0.1) if s.position.r < 0.5]
        errors = LensModel.fit(inner).expected_errors()

        assert errors["center"] < errors["mid"] < errors["corner"] <= 1.0

    def test_what_estimators_expect_does_not_fall_with_the_number_of_photos(self) -> None:
        where = FieldPosition(0.5, 0.3)
        few, many = (
            LensModel.fit(
                [replace(s, error=0.3) for i in range(n) for s in photo(f"p{i}", i, noise=0.1)]
            ).query(where, GREEN, SIZE)
            for n in (2, 8)
        )

        assert few.predicted_error >= many.predicted_error > 0.2

    @pytest.mark.parametrize("bad", [-0.1, math.nan, math.inf])
    def test_impossible_expectations_are_refused(self, bad: float) -> None:
        with pytest.raises(InvalidInputError, match="expected error"):
            replace(photo("a", 0)[0], error=bad)


class TestProfile:
    @staticmethod
    @cache
    def profile() -> LensProfile:
        samples = merged([photo(f"p{i}", i, noise=0.02) for i in range(3)])
        settings = ModelSettings(excluded=("p1",), phi=0.4)
        return LensProfile(LensModel.fit(samples, settings), {"serial": "1"}, {"p0": "a.dng"})

    def test_comes_back_with_the_same_answers(self, tmp_path: Path) -> None:
        before = self.profile()
        save_profile(tmp_path / "a.lensprofile", before)
        after = load_profile(tmp_path / "a.lensprofile")

        assert after.lens == before.lens
        assert after.photos == before.photos
        assert after.model.settings == before.model.settings
        for where in places(5, 1):
            a, b = before.model.query(where, GREEN, SIZE), after.model.query(where, GREEN, SIZE)
            assert np.abs(a.kernel - b.kernel).max() <= 1e-6
            assert a.predicted_error == pytest.approx(b.predicted_error, rel=1e-4)

    @pytest.mark.parametrize("content", [b"", b"PK\x03\x04 nonsense", b"\x80\x04pickle"])
    def test_other_bytes_are_refused(self, content: bytes, tmp_path: Path) -> None:
        (tmp_path / "a.lensprofile").write_bytes(content)

        with pytest.raises(InvalidInputError, match="no lens profile"):
            load_profile(tmp_path / "a.lensprofile")

    @pytest.mark.parametrize(
        "change",
        [
            {"format": 99},
            {"model": {"mode": "magic"}},
            {"model": {"unknown": 1}},
            {"samples": []},
            {"lens": 7},
            {"samples": [{"r": "far"}] * 48},
            {"samples": [{"r": 10**400}] * 48},
        ],
    )
    def test_tampered_document_is_refused(self, change: dict[str, object], tmp_path: Path) -> None:
        path = tmp_path / "a.lensprofile"
        save_profile(path, self.profile())
        with zipfile.ZipFile(path) as archive:
            parts = {name: archive.read(name) for name in archive.namelist()}
        parts["profile.json"] = json.dumps({**json.loads(parts["profile.json"]), **change}).encode()
        with zipfile.ZipFile(path, "w") as archive:
            for name, data in parts.items():
                archive.writestr(name, data)

        with pytest.raises(InvalidInputError):
            load_profile(path)

    def test_what_could_not_be_opened_is_not_written(self, tmp_path: Path) -> None:
        kernel = np.zeros((257, 257))
        kernel[128, 128] = 1.0
        model = LensModel.fit([PsfSample(kernel, FieldPosition(0.1, 0.0))])

        with pytest.raises(InvalidInputError, match="side 255"):
            save_profile(tmp_path / "a.lensprofile", LensProfile(model))
        assert not list(tmp_path.iterdir())

    def test_every_truncation_and_flipped_byte_is_refused_or_harmless(self, tmp_path: Path) -> None:
        path = tmp_path / "a.lensprofile"
        save_profile(path, LensProfile(LensModel.fit(photo("a", 0, count=3))))
        whole, rng = path.read_bytes(), np.random.default_rng(0)
        damaged = [whole[: int(n)] for n in rng.integers(0, len(whole), 10)]
        for at in rng.integers(0, len(whole), 30):
            changed = bytearray(whole)
            changed[at] ^= 0xFF
            damaged.append(bytes(changed))
        for data in damaged:
            path.write_bytes(data)
            with contextlib.suppress(InvalidInputError):  # anything else fails the test
                assert len(load_profile(path).model.samples) == 3

    def test_an_earlier_format_is_to_be_calibrated_again(self, tmp_path: Path) -> None:
        path = tmp_path / "a.lensprofile"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("profile.json", json.dumps({"format": 1, "samples": []}))

        with pytest.raises(InvalidInputError, match="calibrate again"):
            load_profile(path)
