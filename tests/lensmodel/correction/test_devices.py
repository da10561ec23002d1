"""The same numbers by the array API as by the compiled loops."""

import numpy as np
import pytest
from scipy import ndimage

from lab.kernels import gaussian
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import NoiseModel
from lensmodel.correction import Sensor, SparseGradient
from lensmodel.correction.blur import Drift, UniformBlur
from lensmodel.correction.devices import VARIABLE, Device, device_of
from lensmodel.correction.limit import limited

LIBRARIES = ["numpy", "array_api_strict", "torch:cpu", "torch:cuda", "cupy"]


@pytest.fixture(params=LIBRARIES)
def library(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    if name != "numpy":  # NumPy itself keeps to the standard: the paths are always compared
        package = pytest.importorskip(name.split(":", maxsplit=1)[0])
        if name in {"torch:cuda", "cupy"} and not package.cuda.is_available():
            pytest.skip("no graphics card here")
    return name


def tile(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    blocks = rng.uniform(0.1, 0.8, (3, 12, 13)).repeat(8, axis=1).repeat(8, axis=2)[:, :91, :100]
    soft = ndimage.gaussian_filter(blocks, (0, 1.2, 1.2))
    return (soft + 0.004 * rng.standard_normal(soft.shape)).astype(np.float32)


def kernels() -> list[UniformBlur]:
    made = [UniformBlur(gaussian(9, np.eye(2) * width)) for width in (1.2, 1.4, 1.7)]
    return [
        UniformBlur(blur.kernel, drift=Drift((made[0], blur, 300.0), (blur, made[2], 300.0), (45.0, 50.0)))
        for blur in made
    ]


@pytest.mark.parametrize("mosaic", [False, True])
@pytest.mark.parametrize("surrounded", [False, True])
def test_solution_is_that_of_the_compiled_steps(
    library: str, mosaic: bool, surrounded: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen, noise = tile(), NoiseModel(2e-5, 1e-6)
    rows, cols = np.mgrid[: seen.shape[1], : seen.shape[2]]
    colour = rows % 2 + cols % 2
    sensors = [
        Sensor(noise, measured=colour == c if mosaic else None, surrounded=surrounded) for c in range(3)
    ]

    compiled = SparseGradient().deconvolve_planes(seen, kernels(), sensors)
    monkeypatch.setenv(VARIABLE, library)
    made = SparseGradient().deconvolve_planes(seen, kernels(), sensors)

    assert np.abs(compiled.planes - seen).max() > 0.05
    np.testing.assert_allclose(made.planes, compiled.planes, atol=2e-4)
    assert made.unexplained is not None
    assert compiled.unexplained is not None
    np.testing.assert_allclose(made.unexplained, compiled.unexplained, atol=2e-4)


@pytest.mark.parametrize("error", [0.05, 0.3])
def test_limit_is_that_of_the_compiled_loops(
    library: str, error: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = tile(1)
    rng = np.random.default_rng(2)
    result = (seen * rng.uniform(0.2, 2.0, seen.shape)).astype(np.float32)
    result[:, 40:42] = 0.0
    sensors = [Sensor(NoiseModel(2e-5, 1e-6), clip=1.0)] * 3

    compiled = limited(seen, result, kernels(), sensors, [error] * 3)
    monkeypatch.setenv(VARIABLE, library)
    made = limited(seen, result, kernels(), sensors, [error] * 3)

    assert np.abs(compiled - result).max() > 0.1
    np.testing.assert_allclose(made, compiled, atol=2e-5)


def test_device_is_named_by_library_and_unset_means_the_compiled_loops() -> None:
    assert device_of("") is None
    assert device_of("numpy") == Device(np)
    with pytest.raises(InvalidInputError, match="must begin with one of torch"):
        device_of("abacus:1")


def test_library_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lensmodel.correction.devices._MODULES", {"torch": "no_such_library"})
    with pytest.raises(InvalidInputError, match=r"no_such_library is missing; install lensmodel\[gpu\]"):
        device_of("torch:missing")
