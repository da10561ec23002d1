r"""What phase and gain between two colours of a mosaic tell of a lens, free of the scene.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.model.cross_spectra --seeds 0 1 3 --grids GRID.npz ... \
        [--photos 2]

Lenses take photos as in `lensmodel.lab.chain.blind_gain`. In the patches that would be learned from, the
mosaic's own samples of two colours are compared: the phase of the mean of F_B conj(F_G) over tiles, in the
rings and sectors of `PatchSpectrum` below a quarter of the sampling rate, each after the shift that suits it
best (lateral colour). Behind a lens it is that of H_B conj(H_G), which is computed from the true kernels.

Printed are, by ring: the coherence of blue and red with green, the scatter of the phase about the true one
(its robust standard deviation, and over what noise and incoherence explain), and the size of the true phase
(root mean square of its sine: only that changes sign when the lens is turned by 180 degrees). Then, for each
lens: by how many standard deviations of its noise the phase tells the true lens from the turned one, for a
patch (median) and for a photo, as it should by what is known of the noise and as it did; the same for the
lens whose coma is negated (third order only); and the vote of the tails (`joint_kernels.tail_vote`) of the
same patches at the true kernels. A vote above zero is right.

Then, by ring, how far the gain is off: ln |H_C / H_G| by the cross spectrum over green's power, by the root
of the ratio of powers and by their mean, and that root in the demosaiced planes, each less the true one; the
level of each patch, the colour of its scene, is taken off first. Bias is the median, scatter the robust
standard deviation of bins, slope that of the patches' slopes over ln f. Some ten seconds a photo.

Source of the first: J. S. Bendat, A. G. Piersol, "Random Data", 4th ed., 2010, ch. 6, where the transfer
function of a system is the cross spectrum of what leaves and enters it over the power of what enters.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from lensmodel import photo
from lensmodel.core.cross_phase import (
    MIDDLES,
    coherence,
    cross_phase,
    log_likelihood,
    mean_in_bins,
    noise_in_bins,
    spectra_in_bins,
    unshifted,
)
from lensmodel.core.errors import NoUsablePatchesError
from lensmodel.core.psf import PsfSample, delta, rms_width
from lensmodel.core.spectrum import (
    FIRST_PHASE_RING,
    PHASE_RINGS,
    SECTORS,
    CrossPhase,
    PatchSpectrum,
    binned_spectrum,
    tail_of,
)
from lensmodel.core.types import CHANNELS, BayerPattern, Channel, FieldPosition, Kernel, NoiseModel, Planes
from lensmodel.lab.chain.blind_gain import CAMERA, KnownLens, lenses, shot, written
from lensmodel.lab.traced import GridLens
from lensmodel.model.wavefront.joint_kernels import tail_vote
from lensmodel.simulate import SimulatedLens
from lensmodel.workflow import pipeline

_SIDE: Final = 55  # pixels of a true kernel: what the grids hold
OTHERS: Final[tuple[Channel, ...]] = ("b", "r")
"""Channels that are compared with green."""

GAINS: Final = ("cross over green", "powers", "their mean", "powers, demosaiced")
"""Ways to measure a gain."""

_LEAST_SIGNAL = 0.05  # of the power: what is left of it at least when the noise is taken off (chosen)
_TINY = 1e-30  # keeps logarithms finite, far below any power

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredPatch:
    """One patch: what was measured of it, and what is true there.

    Parameters
    ----------
    lens, photo : str, int
    measured : dict
        Phase of blue and red against green.
    coherence : dict
        Modulus of their normalised cross spectra in the bins.
    true : dict
        The phases behind the lens.
    mirrored : dict or None
        Those with its coma negated.
    gain_errors : dict
        Of blue and red, by each of `GAINS`: measured gain less the true one, shape (PHASE_BINS,).
    sample : PsfSample
        Its tail, in green.
    kernel : Kernel
        The true one in green.
    """

    lens: str
    photo: int
    measured: dict[Channel, CrossPhase]
    coherence: dict[Channel, Floats]
    true: dict[Channel, Floats]
    mirrored: dict[Channel, Floats] | None
    gain_errors: dict[Channel, tuple[Floats, ...]]
    sample: PsfSample
    kernel: Kernel

    @property
    def gained(self) -> tuple[float, float]:
        """Log likelihood of the true lens over the turned one: expected, and as it was."""
        return self._over({c: -phase for c, phase in self.true.items()})

    @property
    def gained_over_mirrored(self) -> tuple[float, float]:
        """The same over the lens whose coma is negated."""
        return (0.0, 0.0) if self.mirrored is None else self._over(self.mirrored)

    def _over(self, other: dict[Channel, Floats]) -> tuple[float, float]:
        expected = seen = 0.0
        for channel, measured in self.measured.items():
            phase = self.true[channel]
            true = replace(measured, phase=phase.astype(np.float32))
            expected += log_likelihood(true, phase) - log_likelihood(true, other[channel])
            seen += log_likelihood(measured, phase) - log_likelihood(measured, other[channel])
        return expected, seen


def phases_of(
    lens: KnownLens, truth: SimulatedLens | GridLens, place: FieldPosition
) -> dict[Channel, Floats]:
    """Phases of H_C conj(H_G) in the bins at a place, of blue and red."""
    field = truth.field(lens.settings)
    waves = {c: transfer_of(field.kernel_at(place, c, _SIDE)) for c in CHANNELS}
    return {c: np.angle(mean_in_bins(waves[c] * waves["g"].conj())) for c in OTHERS}


def gain_errors_of(
    lens: KnownLens, place: FieldPosition, planes: Planes, cfa: BayerPattern, noise: Sequence[float]
) -> dict[Channel, tuple[Floats, ...]]:
    """Gains of a patch by each of `GAINS` less the true ones, see `MeasuredPatch`.

    Parameters
    ----------
    planes : Planes, shape (3, h, w)
        Developed, the samples of the mosaic at their own sites.
    cfa : BayerPattern
        Of the patch's top left 2 x 2 pixels.
    noise : sequence of float
        Variance of the noise of r, g and b.
    """
    field = lens.lens.field(lens.settings)
    true = {
        c: np.log(mean_in_bins(np.abs(transfer_of(field.kernel_at(place, c, _SIDE))) ** 2).real + _TINY)
        for c in CHANNELS
    }
    demosaiced = {}
    for number, c in enumerate(CHANNELS):
        power, floor = binned_spectrum(np.ascontiguousarray(planes[number]), NoiseModel(0.0, noise[number]))
        rings = power[FIRST_PHASE_RING : FIRST_PHASE_RING + PHASE_RINGS].ravel().astype(np.float64)
        demosaiced[c] = np.log(np.maximum(rings - floor, _LEAST_SIGNAL * rings))
    errors: dict[Channel, tuple[Floats, ...]] = {}
    for channel in OTHERS:
        cross, own, green = spectra_in_bins(planes, cfa, channel)
        own, green = (
            np.maximum(power - noise[CHANNELS.index(c)] * noise_in_bins(cfa, c), _LEAST_SIGNAL * power)
            for c, power in ((channel, own), ("g", green))
        )
        logs = [np.log(np.maximum(part, _TINY)) for part in (np.abs(cross), own, green)]
        both = logs[0] - logs[2], 0.5 * (logs[1] - logs[2])
        known = 0.5 * (true[channel] - true["g"])
        ways = (*both, np.mean(both, axis=0), 0.5 * (demosaiced[channel] - demosaiced["g"]))
        errors[channel] = tuple(np.asarray(way - known) for way in ways)
    return errors


def patches_of(lens: KnownLens, number: int, folder: Path) -> Iterator[MeasuredPatch]:
    """Measure the patches of one photo."""
    path = written(folder / "photo.dng", shot(lens, number), tiff=False)
    developed = photo.develop(path)
    assert developed.cfa is not None, "a Bayer file"
    turned = _mirrored(lens.lens)
    for patch in pipeline.find_patches(developed).patches:
        cut = np.s_[:, patch.row : patch.row + patch.size, patch.col : patch.col + patch.size]
        planes, cfa = (
            developed.planes[cut],
            np.roll(developed.cfa, (-patch.row, -patch.col), axis=(0, 1)).tolist(),
        )
        measured = {c: cross_phase(planes, cfa, c) for c in OTHERS}
        green = np.ascontiguousarray(planes[1])
        kernel = lens.lens.field(lens.settings).kernel_at(patch.position, "g", _SIDE)
        spectrum = PatchSpectrum(
            *binned_spectrum(green, developed.noise[1]), tail_of(green, rms_width(kernel))
        )
        noise = [
            float(model.sigma_at(float(plane.mean())) ** 2)
            for model, plane in zip(developed.noise, planes, strict=True)
        ]
        yield MeasuredPatch(
            lens.name,
            number,
            measured,
            {c: coherence(planes, cfa, c) for c in OTHERS},
            phases_of(lens, lens.lens, patch.position),
            None if turned is None else phases_of(lens, turned, patch.position),
            gain_errors_of(lens, patch.position, planes, cfa, noise),
            PsfSample(delta(3), patch.position, lens.settings, photo=str(number), spectrum=spectrum),
            kernel,
        )


def _mirrored(lens: SimulatedLens | GridLens) -> SimulatedLens | None:
    """Return the lens with its coma negated; None for a traced one."""
    if not isinstance(lens, SimulatedLens):
        return None
    optics = [
        replace(o, coma=-o.coma, uniform_coma=(-o.uniform_coma[0], -o.uniform_coma[1])) for o in lens.optics
    ]
    return replace(lens, optics=tuple(optics))


def transfer_of(kernel: Kernel) -> NDArray[np.complex128]:
    """Transfer function of a kernel on the grid of a tile."""
    grid = np.zeros((64, 64))
    grid[: len(kernel), : len(kernel)] = kernel
    half = len(kernel) // 2
    return np.fft.fft2(np.roll(grid, (-half, -half), axis=(0, 1)))


def residuals(patch: MeasuredPatch, channel: Channel) -> Floats:
    """Measured less true phase in the bins, after the shift that suits best."""
    return unshifted(patch.measured[channel], patch.true[channel])


def report_rings(patches: Sequence[MeasuredPatch]) -> None:
    """Print coherence, scatter and signal by ring."""
    print(
        "\n| ring, cycles/pixel | channel | coherence | scatter, rad | over expected | sine of true phase |"
    )
    print("|---|---|---|---|---|---|")
    for channel in OTHERS:
        rest = _by_ring([residuals(p, channel) for p in patches])
        signal = _by_ring([np.sin(p.true[channel]) for p in patches])
        coherent = _by_ring([p.coherence[channel] for p in patches])
        precision = _by_ring([p.measured[channel].precision.astype(np.float64) for p in patches])
        for ring in range(PHASE_RINGS):
            used = precision[ring] > 0
            values = rest[ring][used]
            scatter = 1.4826 * float(np.median(np.abs(values)))
            over = 1.4826 * float(np.median(np.abs(values) * np.sqrt(precision[ring][used])))
            middle = float(np.median(np.hypot(*MIDDLES.reshape(PHASE_RINGS, SECTORS, 2)[ring].T)))
            print(
                f"| {middle:.3f} | {channel} | {np.median(coherent[ring][used]):.2f} | {scatter:.3f} "
                f"| {over:.2f} | {math.sqrt(np.mean(signal[ring][used] ** 2)):.3f} |"
            )


def report_gains(patches: Sequence[MeasuredPatch]) -> None:
    """Print bias and scatter of each way to measure a gain, by ring."""
    rings = np.hypot(*MIDDLES.reshape(PHASE_RINGS, SECTORS, 2).transpose(2, 0, 1))
    used = rings > 0
    middle = [float(np.median(ring[here])) for ring, here in zip(rings, used, strict=True)]
    print("\n| channel, way | " + " | ".join(f"{f:.2f}" for f in middle) + " | slope |")
    print("|---" * (PHASE_RINGS + 2) + "|")
    slopes = np.log(np.where(used, rings, 1.0)).ravel()
    inside = used.ravel()
    for channel in OTHERS:
        for number, way in enumerate(GAINS):
            off = np.stack([p.gain_errors[channel][number] for p in patches])
            off = off - np.median(off[:, inside], axis=1, keepdims=True)
            slope = [np.polyfit(slopes[inside], row[inside], 1)[0] for row in off]
            cells = []
            for ring in range(PHASE_RINGS):
                values = off.reshape(-1, PHASE_RINGS, SECTORS)[:, ring, used[ring]].ravel()
                scatter = stats.median_abs_deviation(values, scale="normal")
                cells.append(f"{np.median(values):+.2f}, {scatter:.2f}")
            scatter = stats.median_abs_deviation(slope, scale="normal")
            print(f"| {channel}, {way} | {' | '.join(cells)} | {np.median(slope):+.2f}, {scatter:.2f} |")


def _by_ring(values: Sequence[Floats]) -> Floats:
    """Values of patches in bins as (PHASE_RINGS, n)."""
    return np.stack(values).reshape(-1, PHASE_RINGS, SECTORS).transpose(1, 0, 2).reshape(PHASE_RINGS, -1)


def deviations(gains: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Standard deviations between two lenses by independent patches: expected, and as it was.

    A mean gain of e in log likelihood has the variance 2 e.
    """
    expected, seen = np.sum(gains, axis=0) if gains else (0.0, 0.0)
    scale = math.sqrt(2.0 * max(expected, 1e-12))
    return expected / scale, seen / scale


def report_lenses(patches: Sequence[MeasuredPatch]) -> None:
    """Print what tells each lens from its twins, and how often each vote is right."""
    print(
        "\n| lens, photo | turned: a patch, the photo, as it was | coma negated: photo, as it was | tails |"
    )
    print("|---|---|---|---|")
    votes = []
    for key in dict.fromkeys((p.lens, p.photo) for p in patches):
        own = [p for p in patches if (p.lens, p.photo) == key]
        turned = [p.gained for p in own]
        alone = float(np.median([deviations([g])[0] for g in turned]))
        expected, seen = deviations(turned)
        mirrored, seen_mirrored = deviations([p.gained_over_mirrored for p in own])
        tails = tail_vote([p.kernel for p in own], [p.sample for p in own])
        votes.append((expected, seen, mirrored, seen_mirrored, tails))
        print(
            f"| {key[0]}, {key[1]} | {alone:.2f}, {expected:.2f}, {seen:+.2f} "
            f"| {mirrored:.2f}, {seen_mirrored:+.2f} | {tails:+.2f} |"
        )
    expected, seen, mirrored, seen_mirrored, tails = np.array(votes).T
    for least in (0.0, 0.5, 1.0, 2.0):
        strong = expected >= least
        strong_mirrored = mirrored >= max(least, 1e-3)
        print(
            f"phase expected to tell by {least:g} or more: {strong.sum()} photos, right in "
            f"{(seen[strong] > 0).sum()}, tails right in {(tails[strong] > 0).sum()}; coma negated: "
            f"{strong_mirrored.sum()}, right in {(seen_mirrored[strong_mirrored] > 0).sum()}"
        )
    both = np.sign(seen) * seen**2 + np.sign(tails) * tails**2
    print(f"tails right in {(tails > 0).sum()} of {len(tails)}, tails and phase in {(both > 0).sum()}")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="*", default=[])
    parser.add_argument("--grids", type=Path, nargs="*", default=[])
    parser.add_argument("--photos", type=int, default=2, help="photos of each lens")
    wanted = parser.parse_args()
    patches: list[MeasuredPatch] = []
    with tempfile.TemporaryDirectory() as name:
        for lens in lenses(wanted.seeds, wanted.grids, CAMERA.full_well_electrons):
            for number in range(wanted.photos):
                try:
                    patches += list(patches_of(lens, number, Path(name)))
                except NoUsablePatchesError as error:
                    print(f"{lens.name}, photo {number}: {error}")
                    continue
                print(f"{lens.name}, photo {number}: {len(patches)} patches so far", flush=True)
    report_rings(patches)
    report_lenses(patches)
    report_gains(patches)


if __name__ == "__main__":
    main()
