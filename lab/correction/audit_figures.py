"""How the audit judges the trials of `bench.audit`: what it catches, what it costs."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from lab.correction.audit_trials import BLOCK, CHANGES, FAULTS, SOUND, AuditCase, Exposure, Trial
from lab.images import psnr
from lensmodel.core.psf import as_kernel
from lensmodel.core.types import Planes
from lensmodel.correction.audit import CHECKS, Evidence, held_back, nearby
from lensmodel.correction.audit.check import TilePair
from lensmodel.correction.audit.findings import HELD
from lensmodel.correction.audit.tile import GROWN
from lensmodel.correction.blur import UniformBlur, crop_to_support

HALO: Final = 24
"""Pixels around each block that the audit sees besides: what a correction's tiles have at least."""
LOSS: Final = -1.0
"""Gain against the photo, in dB, below which a fault counts as one."""


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """One block of a trial, with the pixels around.

    Parameters
    ----------
    made : str
        Name of the correction or the fault.
    mosaic : bool
        Whether the photo was one.
    photo, corrected, scene : Planes
        With the pixels around.
    evidence : Evidence
        What the audit is told.
    """

    made: str
    mosaic: bool
    photo: Planes
    corrected: Planes
    scene: Planes
    evidence: Evidence

    @property
    def gain(self) -> float:
        """Gain of the correction in PSNR, dB."""
        return self.gain_of(self.corrected[INNER])

    def gain_of(self, planes: Planes) -> float:
        """Gain of other planes of the inner part."""
        truth = self.scene[INNER]
        return psnr(planes, truth, srgb=True) - psnr(self.photo[INNER], truth, srgb=True)

    @property
    def sound(self) -> bool:
        """Whether it was corrected with the true PSF and gains by it."""
        return self.made in SOUND and self.gain > 0.0


INNER: Final = (slice(None), slice(HALO, HALO + BLOCK), slice(HALO, HALO + BLOCK))


@dataclass(frozen=True, slots=True)
class BlockVerdict:
    """What the audit made of one block.

    Parameters
    ----------
    made : str
        Name of the correction or the fault.
    mosaic : bool
        Whether the photo was one.
    gain, after : float
        Gain in PSNR against the photo, before and after the audit, dB.
    held_back : float
        Mean share held back.
    checks : dict
        The same by check.
    mended : float
        Share of the squared error beyond the photo's that is gone.
    """

    made: str
    mosaic: bool
    gain: float
    after: float
    held_back: float
    checks: dict[str, float]
    mended: float

    @property
    def caught(self) -> bool:
        """Whether a tenth was held back, or half of what was worse than the photo is gone."""
        return self.held_back > HELD or self.mended >= 0.5


def blocks(trial: Trial, *, reblur: bool = True) -> Iterator[Block]:
    """Cut a trial and the faults made of it into blocks."""
    made = dict(trial.made)
    for number, (name, spoil) in enumerate(FAULTS.items()):
        rng = np.random.default_rng([number, trial.case.seed, *trial.case.pair])
        made[name] = spoil(trial.made[SOUND[0]], rng)
    for name, corrected in made.items():
        change = CHANGES.get(name)
        for top, left, kernels in trial.blocks():
            part = (slice(None), *(slice(at - HALO, at + BLOCK + HALO) for at in (top, left)))
            used = kernels if change is None else [as_kernel(np.maximum(change(k), 0.0)) for k in kernels]
            blurs = [UniformBlur(crop_to_support(kernel)) for kernel in used]
            evidence = Evidence(
                [trial.noise] * 3,
                blurs=blurs if reblur else None,
                measured=[trial.measured(c, part[1:]) for c in range(3)],
            )
            yield Block(
                name, trial.case.mosaic, trial.photo[part], corrected[part], trial.scene[part], evidence
            )


def judged(block: Block) -> tuple[BlockVerdict, float]:
    """Audit a block; seconds of the processor besides."""
    start = time.process_time()
    planes, audit = held_back(block.photo, block.corrected, block.evidence, inner=(INNER[1], INNER[2]))
    seconds = time.process_time() - start
    before, now, untouched = (
        float(np.square(p - block.scene[INNER]).mean())
        for p in (block.corrected[INNER], planes, block.photo[INNER])
    )
    mended = (before - now) / (before - untouched) if before > untouched else 0.0
    checks = {finding.check: finding.held_back for finding in audit.findings}
    gain, after = block.gain, block.gain_of(planes)
    return BlockVerdict(block.made, block.mosaic, gain, after, audit.held_back, checks, mended), seconds


def shares(case: AuditCase, folder: Path, method: str, rounds: int) -> list[float]:
    """Time of the audit over that of the correction without it, round by round, both of the processor."""
    exposure, found = Exposure.of(case, folder), []
    for number in range(rounds + 1):  # in the first one loops are compiled
        seconds = []
        for audited in (False, True):
            start = time.process_time()
            exposure.corrected(exposure.lens, method, audited=audited)
            seconds.append(time.process_time() - start)
        if number > 0:
            found.append(seconds[1] / seconds[0] - 1.0)
    return found


def factors(block: Block) -> dict[str, float]:
    """By how much each check's limit would have to be larger for a tenth of the block to be held back."""
    pair = TilePair.of(block.photo, block.corrected, block.evidence)
    found = {}
    for name, check in CHECKS.items():
        severity = check(pair)
        values = severity.values
        if severity.step == 1:
            values = nearby.highest(values, GROWN)  # what is kept of a pixel spreads
        values = values[severity.part((INNER[1], INNER[2]), pair.shape)]
        low, high = 1e-3, 1e3
        for _ in range(20):
            middle = float(np.sqrt(low * high))
            share = float(np.clip(values / np.float32(middle) - 1.0, 0.0, 1.0).mean())
            low, high = (middle, high) if share > HELD else (low, middle)
        found[name] = high
    return found


def table(verdicts: Sequence[BlockVerdict]) -> list[str]:
    """Print lines of a table in Markdown: sound blocks first, then each fault."""
    lines = [
        "| correction | blocks | held back > 0.1 | caught | gain before, dB | after | still lose > 1 dB |",
        "|---|---|---|---|---|---|---|",
    ]
    for made in dict.fromkeys(v.made for v in verdicts):
        for mosaic in (False, True):
            own = [v for v in verdicts if v.made == made and v.mosaic == mosaic]
            own = [v for v in own if (v.gain > 0.0 if made in SOUND else v.gain < LOSS)]
            if own:
                lines.append(_line(f"{made}{', mosaic' if mosaic else ''}", own, faulty=made not in SOUND))
    return lines


def _line(name: str, verdicts: Sequence[BlockVerdict], *, faulty: bool) -> str:
    def mean(values: list[float] | list[bool]) -> float:
        return float(np.mean(values))

    caught = f"{mean([v.caught for v in verdicts]):.1%}" if faulty else ""
    left = f"{mean([v.after < LOSS for v in verdicts]):.1%}" if faulty else ""
    return (
        f"| {name} | {len(verdicts)} | {mean([v.held_back > HELD for v in verdicts]):.1%} | {caught} "
        f"| {mean([v.gain for v in verdicts]):+.2f} | {mean([v.after for v in verdicts]):+.2f} | {left} |"
    )
