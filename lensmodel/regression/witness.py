"""What patches say against a model's kernels, place by place.

Kernels that are too wide, or those of another place, ruin a photo while their own scatter looks small: a
regression does not know where it does not fit. Patches do, those that the lens was learned from and those of
the very photo that is to be corrected: behind the right kernel nothing narrower makes their spectra likelier
(`likelihood`). With D_ia the rise of the negative log likelihood of patch i from the model's kernel k_0 to an
alternative k_a, bounded so that no patch speaks for all,

    M_a(x) = sum_i w_i(x) D_ia / max(sum_i w_i(x), n)        q_a(x) ~ p_a(x) exp(-t M_a(x))

where w falls off with the distance in the field and in the settings: a mean over patches, since neighbouring
bins and patches of one motif err alike, and less than a mean below n patches. There the prior p of the
alternatives fades too: where no patch speaks, k_0 stays. The answer is the mean of k_0 and all k_a under q.
Its error grows by its distance from k_0, the lack of fit, and by how far the alternatives lie apart.

Power spectra are blind to a kernel turned by 180 degrees and to one that is shifted. Where patches cannot
tell kernels apart (blur of less than half a pixel) the prior stays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.psf import PsfField, PsfSample, as_kernel, delta, rms_width
from lensmodel.regression import variables as va
from lensmodel.regression.kriging import field_vector, settings_gap
from lensmodel.regression.likelihood import surprise
from lensmodel.regression.model import LensModel
from lensmodel.regression.pitch import rescaled
from lensmodel.types import Channel, FieldPosition, Kernel, LensSettings

WIDTHS: Final = (0.85, 0.7, 0.55)
"""Parts of the width of the model's kernel."""
SHARES: Final = (0.7, 0.45)
"""Shares of the model's kernel where the rest is a point."""
ALONG: Final = 0.7
"""Part of the width along the radius alone, and across it alone: what astigmatism of another sign leaves."""
COUNT: Final = len(WIDTHS) + len(SHARES) + 2
"""Number of alternatives."""

# Chosen on simulated lenses of development seeds (0 to 5) with kernels that are right, too wide, turned and
# displaced; `benchmarks/witness.py` prints what they give on others.
# Prior probability of the model's kernel by its width in pixels: narrow alternatives of a narrow kernel are
# hardly less likely when it is right, cost next to nothing then, and spare up to 3 dB when it is wrong.
_PRIOR_WIDTHS, _PRIORS = (0.5, 1.0), (0.6, 0.9)
_AGAINST, _FOR = 12.0, 6.0  # bounds of what one patch says: a neighbour's support is no excuse for a place
_RADIUS: Final = 0.2  # half-diagonals
_FEWEST: Final = 5.0  # patches whose mean counts in full; one alone overrules nothing
_TEMPER: Final = 1.5  # t
_MOST: Final = 96  # patches of a model that are asked: some 30 ms each
_ALIKE: Final = 0.05  # least weight by settings
_TINY: Final = 1e-12
_SURE: Final = 0.995  # probability from which on a kernel stays as it is


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """What the patches around one place say of kernels there.

    Parameters
    ----------
    shares : ndarray, shape (1 + COUNT,)
        Probabilities of the model's kernel and of each of its `alternatives`; sum 1.
    phi : float
        Angle of the place, radian.
    """

    shares: NDArray[np.float64]
    phi: float

    @property
    def objects(self) -> bool:
        """Whether the patches leave room for anything but the model's kernel."""
        return bool(self.shares[0] < _SURE)

    def kernel(self, kernel: Kernel) -> Kernel:
        """Return the mean of a kernel and its alternatives, weighed by how probable they are."""
        return as_kernel(np.tensordot(self.shares, self._all(kernel), axes=1)) if self.objects else kernel

    def error(self, kernel: Kernel) -> float:
        """Relative L2 that the mean may have beyond the expected error of the kernel itself."""
        if not self.objects:
            return 0.0
        every = self._all(kernel)
        mean = np.tensordot(self.shares, every, axes=1)
        spread = float(self.shares @ ((every - mean) ** 2).sum(axis=(1, 2)))
        moved = float(((every[0] - mean) ** 2).sum())
        return math.sqrt((spread + moved) / float((mean**2).sum()))

    def _all(self, kernel: Kernel) -> NDArray[np.float64]:
        return np.concatenate([kernel[None], alternatives(kernel, self.phi)])


@dataclass(frozen=True, slots=True, eq=False)
class Witness:
    """The patches that speak about a lens model at some settings.

    Parameters
    ----------
    places : ndarray, shape (n, 2)
        Field vectors.
    votes : ndarray, shape (n,)
        How much each counts, at most 1.
    rises : ndarray, shape (n, COUNT)
        How much the negative log likelihood of each patch rises from the model's kernel to each alternative.
    widths : ndarray, shape (n,)
        Root mean square widths of the model's kernels there, pixels.
    """

    places: NDArray[np.float64]
    votes: NDArray[np.float64]
    rises: NDArray[np.float64]
    widths: NDArray[np.float64]

    @classmethod
    def of(cls, model: LensModel, settings: LensSettings, patches: Sequence[PsfSample] = ()) -> Witness:
        """Hear the model's own patches at such settings, and others.

        Parameters
        ----------
        model : LensModel
        settings : LensSettings
            Those of the photo that is to be corrected.
        patches : sequence of PsfSample
            Of that photo; only place, settings, pixels and spectrum count. Those without a spectrum, of JPEG
            files, say nothing.
        """
        heard = [*_own(model, settings), *((patch, 1.0) for patch in patches if patch.spectrum is not None)]
        kernels = [model.kernel_of(patch) for patch, _ in heard]
        rises = [_rises(patch, kernel) for (patch, _), kernel in zip(heard, kernels, strict=True)]
        return cls(
            np.array([field_vector(patch.position) for patch, _ in heard]).reshape(-1, 2),
            np.array([vote for _, vote in heard]),
            np.array(rises).reshape(-1, COUNT),
            np.array([rms_width(kernel) for kernel in kernels]),
        )

    def verdict(self, position: FieldPosition) -> Verdict:
        """What the patches around a place say."""
        gaps = ((self.places - field_vector(position)) ** 2).sum(axis=1)
        weights = self.votes * np.exp(-0.5 * gaps / _RADIUS**2)
        heard = float(weights.sum())
        total, width = max(heard, _FEWEST), float(weights @ self.widths) / max(heard, _TINY)
        prior = float(np.interp(width, _PRIOR_WIDTHS, _PRIORS))
        open_ = (1.0 - prior) * (heard / total) ** 2
        shares = np.concatenate(
            [[1.0 - open_], open_ / COUNT * np.exp(-_TEMPER / total * (weights @ self.rises))]
        )
        return Verdict(shares / shares.sum(), position.phi)


@dataclass(frozen=True, slots=True, eq=False)
class WitnessedField:
    """A PSF field with its kernels as patches leave them.

    Parameters
    ----------
    field : PsfField
    witness : Witness
    """

    field: PsfField
    witness: Witness

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the kernel of odd side `size` at a field position, in the image frame."""
        return self.witness.verdict(position).kernel(self.field.kernel_at(position, channel, size))


def alternatives(kernel: Kernel, phi: float) -> NDArray[np.float64]:
    """Narrower kernels at the angle `phi`, shape (COUNT, k, k): `WIDTHS`, `SHARES`, radial, tangential."""
    size = kernel.shape[0]
    point = delta(size)
    narrow = [rescaled(kernel, 1.0, 1.0 / width, size) for width in WIDTHS]
    mixed = [share * kernel + (1.0 - share) * point for share in SHARES]
    radial, tangential = _narrowed(kernel, phi), _narrowed(kernel, phi + math.pi / 2.0)
    return np.stack([*narrow, *mixed, radial, tangential])


def _narrowed(kernel: Kernel, angle: float) -> Kernel:
    """Kernel narrowed to `ALONG` of its width in one direction, counter-clockwise from the right."""
    size = kernel.shape[0]
    middle = size // 2
    rows, cols = np.mgrid[:size, :size] - middle
    right, up = math.cos(angle), math.sin(angle)
    out = (cols * right - rows * up) * (1.0 / ALONG - 1.0)
    where = rows - out * up + middle, cols + out * right + middle
    return as_kernel(np.maximum(ndimage.map_coordinates(kernel, where, order=3), 0.0))


def _rises(patch: PsfSample, kernel: Kernel) -> NDArray[np.float64]:
    usual = surprise(patch, kernel)
    others = alternatives(kernel, patch.position.phi)
    rises = [surprise(patch, as_kernel(other)) - usual for other in others]
    return np.clip(rises, -_AGAINST, _FOR)


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
