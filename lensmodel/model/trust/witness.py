"""What patches say of the kernels of a model, place by place.

A global fit does not know where it does not fit, and a regression of kernels does not know what all of
them have wrong. Kernels that are too wide ruin a photo. So two opinions are weighed at each place, the
kernels of the regression and those of the lens's wavefront, each as it is, narrower, and mixed with a point;
the patches of the lens and of the photo to be corrected say which of them makes their spectra likely
(`likelihood.surprise`). With c_ia the negative log likelihood of patch i behind alternative a, bounded so
that no patch speaks for all,

    M_a(x) = sum_i w_i(x) c_ia / max(sum_i w_i(x), n)        q_a(x) ~ p_a exp(-t M_a(x))

where w falls off with the distance in the field and in the settings: a mean over patches, since neighbouring
bins and patches of one motif err alike, and less than a mean below n patches. All patches of a photo may show
a scene that is soft itself, so that t = 2 m / (m + 2) grows with the number m of photos that speak. What
is thought of the PSF is the mixture of all alternatives under q: its mean, and its variance at each frequency
(`Belief`).

Power spectra are blind to a kernel turned by 180 degrees: where no patch tells on which side a wavefront's
tails lie (`Physics.turned`), the turned kernel is an alternative too. Where patches cannot tell kernels apart
(blur of less than half a pixel) the prior p stays, and the variance says so.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.belief import Belief, Narrowing
from lensmodel.core.files import fitted
from lensmodel.core.psf import PsfField, PsfSample, as_kernel
from lensmodel.core.types import Channel, FieldPosition, Kernel, LensSettings
from lensmodel.model import variables as va
from lensmodel.model.field.kriging import field_vector, settings_gap
from lensmodel.model.lens_model import LensModel
from lensmodel.model.trust.support import USUAL_ERROR, measured_share
from lensmodel.model.wavefront.likelihood import surprise

NARROWINGS: Final = (Narrowing(), Narrowing(width=0.7), Narrowing(width=0.55), Narrowing(share=0.45))
"""What may have become of a kernel that is not the true one (chosen: as blind kernels are off, and a sharp
core in wide wings). Wider ones do no harm where they are missed."""

_FITTED: Final = fitted("model")["witness"]
OF_BOTH: Final = (tuple(_FITTED["kernels"]), tuple(_FITTED["wavefront"]))
"""p of kernels and of the wavefront, see `data/README.md`.

Chosen on lenses of development (third order 0 to 3 and 6, and three ray-traced designs; one, two and five
photos each) for the error that a linear filter by such a belief would leave. Surer ones gain 0.1 to 0.8 dB
more on most of them, and in a real photograph of a tree corners out of focus
get ragged lights and dots. So these stay.
"""
SPREAD_OF_BOTH: Final = float(_FITTED["spread"])
"""Factor on the variance: the true kernel is none of the alternatives."""
TEMPER, HALF = float(_FITTED["temper"]), float(_FITTED["half"])
"""t of many photos, and how many photos halve it."""

_OF_UNKNOWN: Final = ((0.20, 0.10, 0.10, 0.05), (0.15, 0.15, 0.15, 0.10))
"""p where aperture or pixels are not known (chosen: a wavefront cannot tell narrow blur from diffraction)."""
_OF_ONE: Final = ((0.1, 0.3, 0.3, 0.3),)
"""p where the samples have no wavefront (chosen: kernels that are too wide are what ruins a photo)."""
_SPREAD_OF_ONE: Final = 3.0
"""The factor on the variance there (chosen: one opinion covers less than two)."""
_AGAINST, _FOR = 12.0, 6.0
"""Bounds of what one patch says, from the first alternative on (chosen: no patch speaks for all)."""
_RADIUS: Final = 0.3  # half-diagonals (chosen: a mean over several patches, so that one overrules nothing)
_FEWEST: Final = 5.0  # patches whose mean counts in full (chosen: one alone overrules nothing)
_FEWEST_VOTES: Final = 0.5
"""Patches: with fewer near a place the witness says nothing, since none of them is close (chosen)."""
_MOST: Final = 96  # patches of a model that are asked (chosen: each costs some milliseconds)
_TINY: Final = 1e-12  # keeps a division finite where no patch speaks
_ALIKE: Final = 0.05  # least weight by settings (chosen: patches of others say little of these)


@dataclass(frozen=True, slots=True, eq=False)
class Witness:
    """The patches that speak about a lens model at some settings.

    Parameters
    ----------
    places : ndarray, shape (n, 2)
        Field vectors.
    votes : ndarray, shape (n,)
        How much each counts, at most 1.
    photos : ndarray of int, shape (n,)
        Which photo each is of.
    costs : ndarray, shape (n, opinions, len(NARROWINGS))
        Negative log likelihood of each patch behind each alternative, beyond that behind the first.
    prior : tuple of tuple of float
        Probabilities of the alternatives before any patch speaks.
    """

    places: NDArray[np.float64]
    votes: NDArray[np.float64]
    photos: NDArray[np.intp]
    costs: NDArray[np.float64]
    prior: tuple[tuple[float, ...], ...] = OF_BOTH

    @classmethod
    def of(
        cls, opinions: Sequence[LensModel], settings: LensSettings, patches: Sequence[PsfSample]
    ) -> Witness:
        """Hear a model's own patches at such settings, and others.

        Parameters
        ----------
        opinions : sequence of LensModel
            Of the same samples: `opinions_of` a model.
        settings : LensSettings
            Those of the photo that is to be corrected.
        patches : sequence of PsfSample
            Of that photo; only place, settings, pixels and spectrum count. Those without a spectrum, of JPEG
            files, say nothing.
        """
        voters = [*_own(opinions[0], settings), *((p, 1.0) for p in patches if p.spectrum is not None)]
        costs = [[_costs(patch, model.kernel_of(patch)) for model in opinions] for patch, _ in voters]
        table = np.array(costs).reshape(-1, len(opinions), len(NARROWINGS))
        return cls(
            np.array([field_vector(patch.position) for patch, _ in voters]).reshape(-1, 2),
            np.array([vote for _, vote in voters]),
            np.unique([patch.photo for patch, _ in voters], return_inverse=True)[1].astype(np.intp),
            np.clip(table - table[:, :1, :1], -_AGAINST, _FOR),
            _prior(opinions),
        )

    def votes_at(self, position: FieldPosition) -> float:
        """Sum of the weights of the patches near a place."""
        return float(self._weights(position).sum())

    def evidence(self, position: FieldPosition) -> tuple[NDArray[np.float64], float]:
        """Mean costs M of the alternatives at a place, and how many photos speak there.

        The costs have the shape (opinions, len(NARROWINGS)).
        """
        weights = self._weights(position)
        total = float(weights.sum())
        mean = np.tensordot(weights, self.costs, axes=1) / max(total, _FEWEST)
        by_photo = np.bincount(self.photos, weights)
        return mean, total**2 / max(float(by_photo @ by_photo), _TINY)

    def shares(self, position: FieldPosition, error: float = 1.0) -> NDArray[np.float64]:
        """Probabilities of the alternatives at a place, shape (opinions, len(NARROWINGS)), of sum 1.

        `error` is what the kernels of the regression expect of themselves there.
        """
        mean, photos = self.evidence(position)
        prior = np.array(self.prior)
        measured = float(measured_share(error))
        shares = prior * np.exp(-TEMPER * photos / (photos + HALF) * (mean - mean.min()))
        shares *= (1.0 - measured) / shares.sum()
        shares[0, 0] += measured
        return np.asarray(shares)

    def _weights(self, position: FieldPosition) -> NDArray[np.float64]:
        gaps = ((self.places - field_vector(position)) ** 2).sum(axis=1)
        return np.asarray(self.votes * np.exp(-0.5 * gaps / _RADIUS**2))


@dataclass(frozen=True, slots=True, eq=False)
class WitnessedField:
    """The PSF field of a model as patches leave it; an `UncertainField`.

    Parameters
    ----------
    opinions : sequence of LensModel
        As the witness weighed them.
    fields : sequence of PsfField
        Theirs, for the photo that is to be corrected.
    witness : Witness
    settings : LensSettings
    pixels : dict
        Pixel pitch and half diagonal of that photo, as `LensModel.query` takes them.
    """

    opinions: Sequence[LensModel]
    fields: Sequence[PsfField]
    witness: Witness
    settings: LensSettings
    pixels: dict[str, float | None]

    @classmethod
    def of(
        cls,
        model: LensModel,
        settings: LensSettings,
        patches: Sequence[PsfSample] = (),
        *,
        pitch_um: float | None = None,
        half_diagonal_px: float | None = None,
    ) -> WitnessedField:
        """Hear the patches of a model and of a photo; takes some milliseconds a patch.

        Parameters
        ----------
        model : LensModel
            `warmed`: without its wavefront there is one opinion.
        settings : LensSettings
            Those of the photo that is to be corrected.
        patches : sequence of PsfSample
            Of that photo, see `Witness.of`.
        pitch_um, half_diagonal_px : float, optional
            Its pixels, as `LensModel.query` takes them.
        """
        opinions = opinions_of(model.hearing(patches))
        pixels = {"pitch_um": pitch_um, "half_diagonal_px": half_diagonal_px}
        fields = [one.field(settings, **pixels) for one in opinions]
        return cls(opinions, fields, Witness.of(opinions, settings, patches), settings, pixels)

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the mean kernel at a field position, in the image frame; see `PsfField`."""
        return self.belief_at(position, channel, size).kernel

    def belief_at(self, position: FieldPosition, channel: Channel, size: int) -> Belief:
        """Return what is thought of the PSF at a field position.

        Parameters
        ----------
        position : FieldPosition
        channel : {"r", "g", "b"}
        size : int
            Odd side of the kernel, pixels.

        Returns
        -------
        Belief
            Mean kernel, and variance at each frequency.
        """
        asked = self.settings.with_channel(channel)
        answer = self.opinions[0].query(position, asked, size, **self.pixels)
        expected = answer.predicted_error if math.isfinite(answer.predicted_error) else 1.0
        if (
            answer.shared_error == 0.0
        ):  # the estimator said nothing of itself: it shares the error that is usual
            expected = math.hypot(expected, USUAL_ERROR)
        if self.witness.votes_at(position) < _FEWEST_VOTES:
            return self._without_votes(position, answer.kernel, expected)
        kernels = [answer.kernel, *(field.kernel_at(position, channel, size) for field in self.fields[1:])]
        spread = SPREAD_OF_BOTH if len(kernels) > 1 else _SPREAD_OF_ONE
        shares = self.witness.shares(position, expected)
        if len(kernels) > 1 and self.turned > 0.0:
            kernels.append(as_kernel(kernels[1][::-1, ::-1]))
            shares = np.stack([shares[0], (1.0 - self.turned) * shares[1], self.turned * shares[1]])
        belief = Belief.mixture(kernels, NARROWINGS, shares)
        if answer.extrapolated and belief.error > 0.0:
            spread = max(spread, (expected / belief.error) ** 2)
        return belief.widened(spread)

    @property
    def turned(self) -> float:
        """Probability that the wavefront's kernels lie on the wrong side."""
        physical = self.opinions[0].physical
        return 0.0 if physical is None else physical.turned

    def _without_votes(self, position: FieldPosition, kernel: Kernel, expected: float) -> Belief:
        """What is thought of a kernel about which no patch speaks: the prior stays, no surer than it expects.

        So with lenses that were learned from JPEG files alone. The mean of the alternatives keeps more at the
        finest detail than the kernel does, which is what combs are made of where it is too wide.
        """
        if measured_share(expected) == 1.0 or len(self.opinions) > 1:
            return Belief.of_error(kernel, expected)
        belief = Belief.mixture([kernel], NARROWINGS, self.witness.shares(position, expected))
        if belief.error == 0.0:  # a point is as narrow as any
            return Belief.of_error(kernel, expected)
        return belief.widened(max(1.0, (expected / belief.error) ** 2))


def opinions_of(model: LensModel) -> list[LensModel]:
    """The kernels of a model's samples, and its wavefront if it has one."""
    kernels, wavefront = model.opinion("kernels"), model.opinion("wavefront")
    return [one for one in (kernels, wavefront) if one is not None]


def _prior(opinions: Sequence[LensModel]) -> tuple[tuple[float, ...], ...]:
    if len(opinions) == 1:
        return _OF_ONE
    physical = opinions[0].physical
    sure = physical is not None and physical.agreed and physical.diffraction_known
    return OF_BOTH if sure else _OF_UNKNOWN


def _costs(patch: PsfSample, kernel: Kernel) -> list[float]:
    return [surprise(patch, change.of(kernel)) for change in NARROWINGS]


def _own(model: LensModel, settings: LensSettings) -> list[tuple[PsfSample, float]]:
    """Green patches of a model that have spectra, and how much each counts at such settings."""
    known = [
        (sample, vote)
        for sample, vote in zip(model.samples, model.votes, strict=True)
        if vote > 0.0 and sample.spectrum is not None and sample.settings.channel == "g"
    ]
    if not known:
        return []
    samples = [sample for sample, _ in known]
    asked = va.point(samples[0].position, settings.with_channel("g"))
    gaps = settings_gap(va.points(samples), asked, va.scales(model.bandwidth))
    # votes of a cell's patches share the confidence of its kernel, which does not count here; those that
    # robust weighting took away do
    alike = np.exp(-0.5 * gaps) * np.array([min(vote / max(s.weight, 1e-9), 1.0) for s, vote in known])
    order = np.argsort(-alike, kind="stable")
    near = [int(i) for i in order if alike[i] > _ALIKE]
    if len(near) > _MOST:
        near = [near[i] for i in np.linspace(0, len(near) - 1, _MOST).round().astype(int)]
    return [(samples[i], float(alike[i])) for i in near]
