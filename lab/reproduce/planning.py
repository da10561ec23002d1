"""Plan a run of `lensmodel reproduce`: which lenses, which of them behind other files and scenes too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, TypeVar

from lab.reproduce import families, programs
from lab.reproduce.cases import HARD_METHODS, METHODS, RIVALS, Case, Reproduction, Size
from lab.reproduce.conditions import PATHS, SCENES_THAT_HURT
from lab.reproduce.scenes import layout_for, scene_files
from lensmodel.core.errors import InvalidInputError
from lensmodel.simulate import draw_lens

LensT = TypeVar("LensT")

_QUICK_FRAME = (640, 960)  # rows and columns (chosen): 0.6 megapixels
_HARD_FRAME = (840, 1260)  # rows and columns (chosen): a megapixel
_STOPPED_DOWN = 2.0  # two stops

_DRAWN_EACH: Final = {"default": 2, "full": 4}
_TRACED_EACH: Final = {"default": 2, "full": 2}
"""Lenses of a family behind each other kind of file, by size of the run (chosen: a night)."""


def planned(
    size: Size,
    *,
    scenes: Path | None = None,
    grids: Sequence[Path] | None = None,
    only: Sequence[str] = (),
    default_only: bool = False,
) -> Reproduction:
    """Plan a run of one of four sizes.

    Parameters
    ----------
    size : {"quick", "small", "default", "full"}
        Four lenses, small photos, n = 1, 2, without rivals and the paper's own way; all lenses wide open on
        frames of a megapixel, n = 1, 2, 5, without rivals; eight lenses of different kind, wide open,
        n = 1, 2, 5; the same stopped down too, the zoom also at its long end, and n = 10, 20 on smaller
        frames. The default size takes the other paths (high ISO, TIFF, JPEG) with two lenses of each
        family, the full size takes them and the scenes that hurt with four of third order.
    scenes : Path or None
        See `Reproduction`.
    grids : sequence of Path, optional
        Grids of ray-traced lenses, one lens each; None takes those of the repository.
    only : sequence of str
        Only lenses whose name begins so, such as "1003" or "heliar"; for sittings on several machines.
    default_only : bool
        Only what a user gets who chooses nothing is measured, beside the photo as it was and the true PSF.

    Raises
    ------
    InvalidInputError
        If two grids are of one design and aperture, or no lens has such a name.

    Notes
    -----
    With few photographs the largest n shrinks to what they allow without using one twice.
    """
    files = scene_files(scenes)
    seeds = families.SEEDS
    paths = tuple(families.repository_grids() if grids is None else grids)
    if size == "quick":
        two = (families.SEEDS[0], families.SEEDS[4])
        cases = tuple(_case(seed, (1, 2), files, _QUICK_FRAME) for seed in two)
        cases += tuple(_traced(path, (1, 2), files, _QUICK_FRAME) for path in paths)
    else:
        few, frame = _allowed((1, 2, 5), len(files)), _HARD_FRAME if size == "small" else None
        cases = tuple(_case(seed, few, files, frame) for seed in seeds)
        cases += tuple(_traced(path, few, files, frame) for path in paths)
    if size == "full":
        zooms = [seed for seed in seeds if len(draw_lens(seed).focal_mm) > 1]
        cases += tuple(_case(seed, few, files, focal=-1) for seed in zooms)
        cases += tuple(_case(seed, few, files, stopped=_STOPPED_DOWN) for seed in seeds)
        many = _allowed((10, 20), 2 * len(files))
        cases += tuple(_case(seed, many, files) for seed in seeds if many != few)
    names: tuple[str, ...] = PATHS if size in {"default", "full"} else ()
    names += SCENES_THAT_HURT if size == "full" else ()
    for number, name in enumerate(names):
        cases += tuple(
            replace(_case(seed, (1,), files, _HARD_FRAME), condition=name)
            for seed in in_turn(seeds, number, _DRAWN_EACH[size])
        )
        if name in PATHS:
            cases += tuple(
                replace(_traced(path, (1,), files, _HARD_FRAME), condition=name)
                for path in in_turn(paths, number, _TRACED_EACH[size])
            )
    return Reproduction(
        _chosen(cases, only),
        scenes,
        methods=HARD_METHODS if default_only else METHODS,
        rivals=RIVALS if size in {"default", "full"} and not default_only else (),
        programs=() if default_only else programs.installed(),
        size=size,
        paper=size != "quick" and not default_only,
        general=not default_only,
        target=not default_only,
    )


def in_turn(lenses: Sequence[LensT], number: int, count: int) -> list[LensT]:
    """Lenses of a condition: other ones for each, in turn, as unlike each other as they come."""
    each = min(count, len(lenses))
    return [lenses[(number + len(lenses) * i // each) % len(lenses)] for i in range(each)]


def _chosen(cases: Sequence[Case], only: Sequence[str]) -> tuple[Case, ...]:
    names = [case.name for case in cases]
    if len(set(names)) < len(names):
        raise InvalidInputError("two grids are of one design and aperture; give one of each")
    unknown = [text for text in only if not any(name.startswith(text) for name in names)]
    if unknown:
        raise InvalidInputError(f"no lens's name begins with {unknown[0]!r}; they are {', '.join(names)}")
    return tuple(case for case in cases if not only or case.name.startswith(tuple(only)))


def _allowed(wanted: tuple[int, ...], parts: int) -> tuple[int, ...]:
    """Numbers of photos that leave one frame over for the measurement."""
    most = parts - 1
    return tuple(sorted({min(n, most) for n in wanted}))


def _case(
    seed: int,
    photos: tuple[int, ...],
    files: Sequence[Path],
    frame: tuple[int, int] | None = None,
    *,
    focal: int = 0,
    stopped: float = 1.0,
) -> Case:
    lens = draw_lens(seed)
    layout = layout_for(files, photos[-1] + 1, frame)
    height, width = frame or layout.frame
    mm = lens.focal_mm[focal]
    return Case(seed, mm, lens.at_focal(mm).f_number * stopped, photos, height, width, layout)


def _traced(
    path: Path, photos: tuple[int, ...], files: Sequence[Path], frame: tuple[int, int] | None = None
) -> Case:
    lens = families.traced(path)
    layout = layout_for(files, photos[-1] + 1, frame)
    height, width = frame or layout.frame
    return Case(
        families.number(path),
        lens.focal_mm[0],
        lens.widest(),
        photos,
        height,
        width,
        layout,
        grid=path,
    )
