"""Attention over the encoded patches of all photos: the regression of the paper with learned kernels.

Cross-attention from a place and settings to samples is Nadaraya-Watson regression (paper, eq. 4 to 7) whose
weights and values a network has learned: the weight of a sample follows from its distance in place and
settings and from what its patch says. A question attends to the nearest `NEAREST` samples, whose keys and
values are computed once for each neighbourhood: it takes the same time for a hundred samples and a million.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import numpy as np
import scipy  # `spatial` is loaded where it is needed: it takes a second
from numpy.typing import NDArray

from lensmodel.core.psf import KINDS, EncodedPatch, PatchKind, PsfSample, centred
from lensmodel.core.types import CHANNELS, FieldPosition, LensSettings
from lensmodel.model import camera_bodies, query
from lensmodel.model.query import Part
from lensmodel.neural.network import RING_MIDDLES, FieldAnswer, FieldNetwork, Memory, conditions_of

NEAREST: Final = 256  # samples that a question attends to (chosen: the patches of three photos)

# steps of x, y, stops, octaves and dioptres within which questions share a neighbourhood (chosen)
_CELL: Final = np.array([0.25, 0.25, 1.0 / 3.0, 0.25, 0.5]) / query.UNITS
_MEMORIES: Final = 64  # neighbourhoods whose keys are kept (chosen: a whole picture's, a megabyte each)
_ANSWERS: Final = 64  # that are kept: of all channels, which are asked for one after the other (chosen)
_ROW_BYTES: Final = 200  # of a patch besides its token: place, settings, its part of the tree
_KEY_BYTES: Final = 4608  # of a patch: keys and values of three attentions, 192 floats each


class LearnedField:
    """Encoded patches, ready to be attended to: samples with `encoded`, one of each patch."""

    def __init__(self, samples: Sequence[PsfSample]) -> None:
        self.network = FieldNetwork.load()
        patches = [sample.encoded for sample in samples if sample.encoded is not None]
        pairs = zip(samples, patches, strict=True)
        self._conditions = np.array([conditions_of(s.settings, s.pixel_pitch_um, p.kind) for s, p in pairs])
        self._xy = np.array([s.position.xy for s in samples])  # half diagonals, to the right and up
        self._tokens = self._tokens_of(samples, patches)
        self._where = query.in_units(query.points(samples))
        known = (column[~np.isnan(column)] for column in self._where.T)
        self._usual = np.array([np.median(values) if values.size else 0.0 for values in known])
        self._usual_pitch = camera_bodies.usual_pitch(samples)
        self._pitch = np.array([s.pixel_pitch_um for s in samples], dtype=np.float64)  # NaN = unknown
        self._photos = np.array([s.photo for s in samples])
        self._tree = lru_cache(maxsize=4)(self._tree_of)
        self._memory = lru_cache(maxsize=_MEMORIES)(self._memory_of)
        self._answer = lru_cache(maxsize=_ANSWERS)(self._answer_of)
        kept = len(samples) if len(samples) < NEAREST else _MEMORIES * NEAREST
        self.nbytes = self._tokens.nbytes + len(samples) * _ROW_BYTES + kept * _KEY_BYTES  # at most

    def _tokens_of(
        self, samples: Sequence[PsfSample], patches: Sequence[EncodedPatch]
    ) -> NDArray[np.float16]:
        """Tokens of samples; those that other weights made are made anew of the statistics."""
        tokens = np.array([patch.token for patch in patches], dtype=np.float16)
        stale: dict[tuple[str, bytes], list[int]] = {}
        for row, sample in enumerate(samples):
            if not sample.estimator.endswith(f"/{self.network.name}"):
                stale.setdefault((sample.photo, self._conditions[row].tobytes()), []).append(row)
        for rows in stale.values():
            statistics = np.array([patches[row].statistics for row in rows], dtype=np.float32)
            tokens[rows] = self.network.encode(statistics, self._xy[rows], self._conditions[rows[0]])
        return tokens

    def ask(self, position: FieldPosition, settings: LensSettings, size: int, pitch_um: float | None) -> Part:
        """Answer at a place, in pixels of some pitch."""
        answer, rows, own = self._answer(position, settings.with_channel("g"), pitch_um)
        channel = CHANNELS.index(settings.channel)
        scale = own / pitch_um if own is not None and pitch_um is not None else 1.0
        return Part(
            centred(camera_bodies.rescaled(answer.kernels[channel], own, pitch_um, size)),
            min(float(answer.error[channel]), 1.0),
            np.asarray(answer.weights, dtype=np.float64),
            self._photos[rows],
            query.nearest(self._where[rows], query.in_units(query.point(position, settings))),
            np.interp(scale * RING_MIDDLES, RING_MIDDLES, answer.ring_error[channel]),
        )

    def _answer_of(
        self, position: FieldPosition, settings: LensSettings, pitch_um: float | None
    ) -> tuple[FieldAnswer, NDArray[np.intp], float | None]:
        """What the network says of all channels, the samples that it attended to, the pitch of its pixels."""
        own = self._usual_pitch
        if own is not None and pitch_um is not None and self._of_pitch(pitch_um).any():
            own = pitch_um
        asked = query.in_units(query.point(position, settings))
        cell = np.round(np.where(np.isnan(asked), self._usual, asked) / _CELL).tolist()
        rows, memory, kind = self._memory(own, () if len(self._tree(own)[0]) <= NEAREST else tuple(cell))
        conditions = conditions_of(settings, own, kind)
        return self.network.query(memory, np.array(position.xy), conditions), rows, own

    def _memory_of(
        self, pitch_um: float | None, cell: tuple[float, ...]
    ) -> tuple[NDArray[np.intp], Memory, PatchKind]:
        """Samples near a cell of places, or all; their keys and values; the usual kind of files."""
        rows, tree = self._tree(pitch_um)
        if cell:
            rows = rows[np.sort(tree.query(np.array(cell) * _CELL, k=NEAREST)[1])]
        tokens = self._tokens[rows].astype(np.float32)
        memory = self.network.memory(tokens, self._xy[rows], self._conditions[rows])
        return rows, memory, KINDS[int(np.bincount(self._conditions[rows, -1].astype(int)).argmax())]

    def _tree_of(self, pitch_um: float | None) -> tuple[NDArray[np.intp], scipy.spatial.cKDTree]:
        """Samples of a pixel pitch, an unknown one being any, and a tree over their places and settings."""
        same = np.ones(len(self._pitch), dtype=bool) if pitch_um is None else self._of_pitch(pitch_um)
        rows = np.flatnonzero(same | np.isnan(self._pitch))
        where = self._where[rows]
        return rows, scipy.spatial.cKDTree(np.where(np.isnan(where), self._usual, where))

    def _of_pitch(self, pitch_um: float) -> NDArray[np.bool_]:
        return np.abs(self._pitch / pitch_um - 1.0) <= camera_bodies.SAME
