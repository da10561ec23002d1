r"""Whether colours alone, compared with each other, tell how wide a lens blurs.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.model.chromatic_diversity --seeds 3 20 \
        [--grids GRID.npz ...] [--photos 1] [--exact]

Where focus differs between the colours (axial colour), two channels are two images of one unknown scene, of
which one is more out of focus, as in phase diversity. Their ratio |H_B|^2 / |H_G|^2, up to a constant, and
the phase of H_B conj(H_G), up to a shift, hold no scene. A wavefront is fitted to these alone, without any
prior of lens or scene, and from beginnings that are the true one (fitted to the true kernels) with all its
terms times 0.5, 0.75, 1, 1.25, 1.5. Printed for each beginning: the cost there and after the fit (chi^2 over
the number of bins), the relative L2 of green against the true kernels (center / mid / corner), and the width
of its kernels over the true ones. If all ends are alike and near 1, the width is determined; if their cost
hardly differs, it is not.

With `--exact` the ratios and phases are computed from the true kernels instead of measured in photos, at the
same places. Some minutes a lens.

Sources: R. A. Gonsalves, "Phase retrieval and diversity in adaptive optics", Optical Engineering 21, 1982;
R. G. Paxman, T. J. Schulz and J. R. Fienup, JOSA A 9, 1992.
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

from lensmodel import photo
from lensmodel.core.cross_phase import binned, cross_phase, cross_spectra, mean_in_bins
from lensmodel.core.psf import PsfSample, distance, rms_width
from lensmodel.core.spectrum import PHASE_BINS, RINGS, SECTORS, PatchSpectrum
from lensmodel.core.types import CHANNELS, Channel
from lensmodel.lab.chain.blind_gain import CAMERA, PLACES, KnownLens, lenses, shot, written
from lensmodel.lab.model.cross_spectra import OTHERS, transfer_of
from lensmodel.model.wavefront.from_kernels import fit_wavefront
from lensmodel.model.wavefront.from_spectra import PatchView, expected, open_eye, phase_terms
from lensmodel.model.wavefront.scene_view import SceneView
from lensmodel.optics.wavefront import NAMES, Wavefront
from lensmodel.workflow import pipeline

FACTORS: Final = (0.5, 0.75, 1.0, 1.25, 1.5)  # on the terms of the true wavefront (chosen)
_SIDE: Final = 41  # pixels of a true kernel (chosen)
_SCATTER: Final = 0.2
"""Of ln of the ratio in a bin, between patches: `docs/lab/accuracy.md`, about the middle of its bands."""
_ROUNDS, _TRIES, _STRIDE_PX = 25, 5, 1.0  # of the descent, its tries each, its longest step (chosen)
_LIMIT: Final = 1.0  # of a residual of ln ratio: near zeros of a transfer function it counts no more (chosen)
_ZONES: Final = (slice(0, 4), slice(4, 12), slice(12, 16))  # of the places: center, mid field, corner

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ColourRelations:
    """What the colours of one patch say of each other: phases in the view, ln of ratios here."""

    view: PatchView
    ratios: dict[Channel, Floats]


def true_wavefront(lens: KnownLens) -> Wavefront:
    """Wavefront fitted to the true kernels of three colours."""
    truth = lens.lens.field(lens.settings)
    samples = [
        PsfSample(
            truth.kernel_at(place, channel, _SIDE),
            place,
            lens.settings.with_channel(channel),
            pixel_pitch_um=lens.camera.pitch_um,
        )
        for place in PLACES
        for channel in CHANNELS
    ]
    front = fit_wavefront(samples)
    assert front is not None, "48 samples are enough"
    return front


def seen(lens: KnownLens, number: int, folder: Path, *, exact: bool) -> Iterator[ColourRelations]:
    """Relative information of the patches of one photo, measured or computed from the true kernels."""
    developed = photo.develop(written(folder / "photo.dng", shot(lens, number), tiff=False))
    assert developed.cfa is not None, "a Bayer file"
    truth = lens.lens.field(lens.settings)
    for patch in pipeline.find_patches(developed).patches:
        phases, ratios = {}, {}
        cut = np.s_[:, patch.row : patch.row + patch.size, patch.col : patch.col + patch.size]
        cfa = np.roll(developed.cfa, (-patch.row, -patch.col), axis=(0, 1)).tolist()
        waves = {c: transfer_of(truth.kernel_at(patch.position, c, _SIDE)) for c in CHANNELS}
        for channel in OTHERS:
            phases[channel] = cross_phase(developed.planes[cut], cfa, channel)
            _, own, green = (binned(v).real for v in cross_spectra(developed.planes[cut], cfa, channel))
            if exact:
                cross = mean_in_bins(waves[channel] * waves["g"].conj())
                phases[channel] = replace(phases[channel], phase=np.angle(cross).astype(np.float32))
                own, green = (mean_in_bins(np.abs(waves[c]) ** 2).real for c in (channel, "g"))
            ratios[channel] = np.log(np.maximum(own, 1e-12) / np.maximum(green, 1e-12))
        flat = PatchSpectrum(np.ones((RINGS, SECTORS), np.float32), 0.0)  # its scene takes no part
        scene = SceneView.of({"g": flat, "r": flat, "b": flat})
        yield ColourRelations(PatchView(patch.position, lens.settings, str(number), scene, phases), ratios)


def terms_of(
    patches: Sequence[ColourRelations], begin: Wavefront, lens: Floats
) -> tuple[float, Floats, Floats]:
    """Cost of a lens, its normal equations and gradient; chi^2 of ratios and phases."""
    cost, normal, gradient = 0.0, np.zeros((lens.size, lens.size)), np.zeros(lens.size)
    for patch in patches:
        power, by_lens, phases = expected(begin, lens, patch.view)
        channels = patch.view.scene.channels
        green = channels.index("g")
        for channel, (phase, by_phase) in phases.items():
            k, measured = channels.index(channel), patch.view.phases[channel]
            own_cost, own_normal, own_gradient = phase_terms(measured, phase, by_phase, temper=1.0)
            cost, normal, gradient = cost + own_cost, normal + own_normal, gradient + own_gradient
            here = measured.precision > 0
            ratio = np.log(power[:PHASE_BINS, k] / power[:PHASE_BINS, green])[here]
            by_ratio = (by_lens[:PHASE_BINS, k] - by_lens[:PHASE_BINS, green])[here]
            left = patch.ratios[channel][here] - ratio
            left = np.clip(left - np.median(left), -_LIMIT, _LIMIT)
            by_ratio = by_ratio - by_ratio.mean(axis=0)
            cost += float(left @ left) / _SCATTER**2
            normal += by_ratio.T @ by_ratio / _SCATTER**2
            gradient += by_ratio.T @ left / _SCATTER**2
    return cost, normal, gradient


def fitted(patches: Sequence[ColourRelations], begin: Wavefront) -> tuple[Wavefront, float, float]:
    """Fit by Levenberg-Marquardt; the lens with the cost before and after."""
    lens = np.concatenate([begin.terms, begin.eye])
    state, damping = terms_of(patches, begin, lens), 1e-2
    first = state[0]
    for _ in range(_ROUNDS):
        for _ in range(_TRIES):
            step = np.linalg.solve(state[1] + np.diag(damping * np.diag(state[1]) + 1e-3), state[2])
            step *= min(1.0, _STRIDE_PX / max(float(np.abs(step[: len(NAMES)]).max()), 1e-9))
            moved = lens + step
            moved[-2:] = open_eye(moved[-2:])
            after = terms_of(patches, begin, moved)
            if after[0] < state[0]:
                break
            damping *= 6.0
        else:
            break
        gain = state[0] - after[0]
        lens, state, damping = moved, after, damping / 4.0
        if gain < 1e-4 * state[0]:
            break
    front = replace(begin, terms=lens[: len(NAMES)], eye=(float(lens[-2]), float(lens[-1])))
    return front, first, state[0]


def report(lens: KnownLens, patches: Sequence[ColourRelations]) -> None:
    """Fit from all beginnings and print."""
    truth, green = lens.lens.field(lens.settings), lens.settings.with_channel("g")
    true = true_wavefront(lens)
    exact = [truth.kernel_at(place, "g", 55) for place in PLACES]
    bins = sum(2.0 * float((p.precision > 0).sum()) for patch in patches for p in patch.view.phases.values())
    print(f"\n{lens.name}: {len(patches)} patches, the true wavefront has an error of {true.error:.2f}")
    print("| beginning | cost there | after the fit | L2 center / mid / corner | width over the true one |")
    print("|---|---|---|---|---|")
    for factor in FACTORS:
        front, first, last = fitted(patches, replace(true, terms=factor * true.terms))
        kernels = [front.kernel(place, green, 55) for place in PLACES]
        errors = [distance(k, e).rel_l2 for k, e in zip(kernels, exact, strict=True)]
        zones = " / ".join(f"{np.median(errors[zone]):.2f}" for zone in _ZONES)
        widths = [math.log(rms_width(k) / rms_width(e)) for k, e in zip(kernels, exact, strict=True)]
        print(
            f"| {factor:g} | {first / bins:.2f} | {last / bins:.2f} | {zones} "
            f"| {math.exp(float(np.median(widths))):.2f} |",
            flush=True,
        )


def main() -> None:
    """Fit the lenses and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="*", default=[])
    parser.add_argument("--grids", type=Path, nargs="*", default=[])
    parser.add_argument("--photos", type=int, default=1)
    parser.add_argument("--exact", action="store_true", help="from the true kernels, without photos' noise")
    wanted = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        for lens in lenses(wanted.seeds, wanted.grids, CAMERA.full_well_electrons):
            patches: list[ColourRelations] = []
            for number in range(wanted.photos):
                patches += seen(lens, number, Path(name), exact=wanted.exact)
            report(lens, patches)


if __name__ == "__main__":
    main()
