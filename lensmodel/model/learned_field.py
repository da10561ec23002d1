"""Attention over the encoded patches of all photos: the regression of the paper with learned kernels.

Cross-attention from a place and settings to samples is Nadaraya-Watson regression (paper, eq. 4 to 7) whose
weights and values a network has learned: the weight of a sample follows from its distance in place and
settings and from what its patch says, and the answer is a weighted sum over samples. A question attends to
the nearest `NEAREST` samples, spread over photos, whose keys and values are computed once for each
neighbourhood: so it takes the same time for a hundred samples and a million. Each patch was encoded beside
the others of its photo; a new photo changes no sample of another one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import scipy  # `spatial` is loaded where it is needed: it takes a second
from numpy.typing import NDArray

from lensmodel.core.psf import KINDS, PatchKind, PsfSample, centred, resized
from lensmodel.core.types import CHANNELS, Channel, FieldPosition, Kernel, LensSettings
from lensmodel.model import camera_bodies, support
from lensmodel.neural import Conditions, FieldAnswer, FieldNetwork, Memory

NEAREST: Final = 256
"""Samples that a question attends to (chosen: the patches of three photos)."""

_CANDIDATES: Final = 4 * NEAREST
"""Nearest samples among which the photos share (chosen: a dozen photos at one place)."""

_CELL: Final = np.array([0.25, 0.25, 1.0 / 3.0, 0.25, 0.5]) / support.UNITS
"""Steps of x, y, stops, octaves and dioptres within which questions share a neighbourhood (chosen)."""

_MEMORIES: Final = 64
"""Neighbourhoods whose keys are kept (chosen: those of a whole picture; each takes a megabyte)."""

_ROW_BYTES: Final = 200  # of a patch besides its token: place, settings, its part of the tree
_KEY_BYTES: Final = 4608  # of a patch: keys and values of three attentions, 192 floats each
_ANSWERS: Final = 64
"""Answers that are kept: one holds all three channels, which are asked for one after the other (chosen)."""


@dataclass(frozen=True, slots=True, eq=False)
class Attended:
    """What the network answers to one question."""

    answer: FieldAnswer
    rows: NDArray[np.intp]  # (m,), samples that it attended to, of `answer.weights`
    pitch_um: float | None  # pixel pitch of the kernels
    support: support.Support

    def kernel(self, channel: Channel, size: int, pitch_um: float | None) -> Kernel:
        """Return the kernel of a channel in pixels of some pitch."""
        kernel: Kernel = self.answer.kernels[CHANNELS.index(channel)]
        if (
            self.pitch_um is not None
            and pitch_um is not None
            and not camera_bodies.alike(self.pitch_um, pitch_um)
        ):
            return centred(camera_bodies.rescaled(kernel, self.pitch_um, pitch_um, size))
        return centred(resized(kernel, size))

    def error(self, channel: Channel) -> float:
        """Expected relative L2 error of the kernel of a channel."""
        return min(float(self.answer.error[CHANNELS.index(channel)]), 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Encoded patches as arrays."""

    tokens: NDArray[np.float16]  # (n, 192)
    xy: NDArray[np.float64]  # (n, 2), places in half diagonals, to the right and up
    where: NDArray[np.float64]  # (n, 5), places and settings in units of `support`
    pitch: NDArray[np.float64]  # (n,), pixel pitch in micrometres; NaN = unknown
    photos: NDArray[np.object_]  # (n,)
    conditions: tuple[Conditions, ...]

    @classmethod
    def of(cls, samples: Sequence[PsfSample], network: FieldNetwork) -> Patches:
        """Take them from samples with `encoded`, one of each patch."""
        return cls(
            _tokens(samples, network),
            np.array([s.position.xy for s in samples]),
            support.points(samples),
            np.array([np.nan if s.pixel_pitch_um is None else s.pixel_pitch_um for s in samples]),
            np.array([s.photo for s in samples], dtype=object),
            _conditions(samples),
        )

    def joined(self, more: Patches) -> Patches:
        """Return these and more."""
        return Patches(
            np.concatenate([self.tokens, more.tokens]),
            np.concatenate([self.xy, more.xy]),
            np.concatenate([self.where, more.where]),
            np.concatenate([self.pitch, more.pitch]),
            np.concatenate([self.photos, more.photos]),
            self.conditions + more.conditions,
        )


class LearnedField:
    """Encoded patches, ready to be attended to: a value, which `added` keeps."""

    def __init__(self, network: FieldNetwork, patches: Patches) -> None:
        self.network, self.patches = network, patches
        _, self._photo = np.unique(patches.photos.astype(str), return_inverse=True)
        known = patches.pitch[~np.isnan(patches.pitch)]
        self._pitches, self._counts = np.unique(known, return_counts=True)
        self._group = lru_cache(maxsize=4)(self._group_of)
        self._memory = lru_cache(maxsize=_MEMORIES)(self._memory_of)
        self.ask = lru_cache(maxsize=_ANSWERS)(self._ask)

    @classmethod
    def of(cls, samples: Sequence[PsfSample], network: FieldNetwork | None = None) -> LearnedField:
        """Take up samples with `encoded`, one of each patch; by default with the packaged network."""
        network = network or FieldNetwork.load()
        return cls(network, Patches.of(samples, network))

    def added(self, samples: Sequence[PsfSample]) -> LearnedField:
        """Return the field with more patches; those that there are stay as they were encoded."""
        return LearnedField(self.network, self.patches.joined(Patches.of(samples, self.network)))

    def __len__(self) -> int:
        return len(self.patches.tokens)

    def _ask(self, position: FieldPosition, settings: LensSettings, pitch_um: float | None) -> Attended:
        """Answer for all channels at a place."""
        group = self._group(self._pitch_of(pitch_um))
        asked = support.point(position, settings)
        cell = tuple(None if np.isnan(value) else float(value) for value in np.round(asked / _CELL))
        rows, memory, kind = self._memory(group.pitch_um, () if len(group.rows) <= NEAREST else cell)
        conditions = Conditions.of(settings, group.pitch_um, kind)
        answer = self.network.query(memory, np.array(position.xy), conditions)
        return Attended(answer, rows, group.pitch_um, support.support(self.patches.where[rows], asked))

    def _pitch_of(self, asked: float | None) -> float | None:
        """The pitch of the samples that answer: the one asked for if there are such, else the commonest."""
        if not self._pitches.size:
            return None
        if asked is not None and (np.abs(self._pitches / asked - 1.0) <= camera_bodies.SAME).any():
            return asked
        return float(self._pitches[self._counts.argmax()])

    def _memory_of(
        self, pitch_um: float | None, cell: tuple[float | None, ...]
    ) -> tuple[NDArray[np.intp], Memory, PatchKind]:
        """Samples near a cell of place and settings, of all without a cell, with their keys and values.

        And the kind of file of most of them: a question has none of its own.
        """
        group = self._group(pitch_um)
        rows = group.rows
        if cell:
            center = np.array([np.nan if step is None else step for step in cell]) * _CELL
            rows = rows[group.nearest(center, self._photo[rows])]
        conditions = [self.patches.conditions[int(row)] for row in rows]
        kinds = [one.kind for one in conditions]
        tokens = self.patches.tokens[rows].astype(np.float32)
        memory = self.network.memory(tokens, self.patches.xy[rows], conditions)
        return rows, memory, max(KINDS, key=kinds.count)

    def _group_of(self, pitch_um: float | None) -> _Group:
        same = np.isnan(self.patches.pitch) | (pitch_um is None)
        if pitch_um is not None:
            same |= np.abs(self.patches.pitch / pitch_um - 1.0) <= camera_bodies.SAME
        rows = np.flatnonzero(same)
        return _Group.of(rows, self.patches.where[rows], pitch_um)

    @property
    def nbytes(self) -> int:
        """Bytes kept, with all that questions may add."""
        near = min(len(self), NEAREST)
        kept = (1 if near < NEAREST else _MEMORIES) * near * _KEY_BYTES
        return len(self) * (self.patches.tokens[0].nbytes + _ROW_BYTES) + kept


@dataclass(frozen=True, slots=True, eq=False)
class _Group:
    """Samples of one pixel pitch in a kd-tree over place and settings; an unknown one is the usual."""

    rows: NDArray[np.intp]
    pitch_um: float | None
    usual: NDArray[np.float64]
    tree: scipy.spatial.cKDTree

    @classmethod
    def of(cls, rows: NDArray[np.intp], where: NDArray[np.float64], pitch_um: float | None) -> _Group:
        unknown = np.isnan(where)
        known = zip(where.T, ~unknown.T, strict=True)
        usual = np.array([float(np.median(column[has])) if has.any() else 0.0 for column, has in known])
        return cls(rows, pitch_um, usual, scipy.spatial.cKDTree(np.where(unknown, usual, where)))

    def nearest(self, asked: NDArray[np.float64], photo: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the nearest samples, as many of each photo, as places `(NEAREST,)` in `rows`."""
        point = np.where(np.isnan(asked), self.usual, asked)
        distance, near = self.tree.query(point, k=min(_CANDIDATES, len(self.rows)))
        by_photo = np.argsort(photo[near], kind="stable")  # nearest first within each
        starts = np.flatnonzero(np.diff(photo[near][by_photo], prepend=-1))
        rank = np.empty(len(near), dtype=np.intp)
        rank[by_photo] = np.arange(len(near)) - np.repeat(starts, np.diff(starts, append=len(near)))
        return np.asarray(np.sort(near[np.lexsort((distance, rank))[:NEAREST]]))


def _tokens(samples: Sequence[PsfSample], network: FieldNetwork) -> NDArray[np.float16]:
    """Tokens of samples; those that other weights made are made anew of the statistics, photo by photo."""
    encoded = [sample.encoded for sample in samples]
    tokens = np.array([patch.token for patch in encoded if patch is not None], dtype=np.float16)
    stale: dict[tuple[str, Conditions], list[int]] = {}
    for row, (sample, conditions) in enumerate(zip(samples, _conditions(samples), strict=True)):
        if not sample.estimator.endswith(f"/{network.name}"):
            stale.setdefault((sample.photo, conditions), []).append(row)
    for (_, conditions), rows in stale.items():
        statistics = np.array([patch.statistics for row in rows if (patch := encoded[row])], dtype=np.float32)
        xy = np.array([samples[row].position.xy for row in rows])
        tokens[rows] = network.encode(statistics, xy, conditions)
    return tokens


def _conditions(samples: Sequence[PsfSample]) -> tuple[Conditions, ...]:
    """Conditions of samples; equal ones are one object."""
    known: dict[Conditions, Conditions] = {}
    made = (
        Conditions.of(s.settings, s.pixel_pitch_um, "raw" if s.encoded is None else s.encoded.kind)
        for s in samples
    )
    return tuple(known.setdefault(conditions, conditions) for conditions in made)
