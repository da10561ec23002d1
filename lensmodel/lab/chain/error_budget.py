r"""Error budget of the whole chain: one part at a time replaced by the truth.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.chain.error_budget \
        [--seeds 3 8] [--photos 1] [--json FILE]

Lenses of development seeds (0 to 99) photograph development scenes: small Bayer DNG files at base ISO.
Each row gives the error of the PSF field and what the corrected chart and a photo never learned from
reach, as a share of the gain that the true PSF field gives on the same files:

* as it is: develop, choose patches, estimate, fit the model, correct;
* without caution: the same field, corrected as if it were certain;
* true patch PSFs: the true kernels at the same patches, of weight one, through the same model;
* no noise, no demosaicing (three full planes), no lateral colour: other files, the whole chain again;
* denoised only: corrected with a PSF that is a point.

"patch kernels" is no chain: the error of the estimates at their own patches.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lensmodel.core.errors import LensModelError
from lensmodel.core.geometry import zone_of
from lensmodel.core.psf import PsfField, PsfSample, distance
from lensmodel.core.types import ZONES, FieldPosition, Planes
from lensmodel.lab.cases import list_photos, photo_half
from lensmodel.lab.model.model_benchmark import asked_places
from lensmodel.lab.reproduce.cases import Case
from lensmodel.lab.reproduce.fidelity import fidelity
from lensmodel.lab.reproduce.measure import edges
from lensmodel.lab.reproduce.routes import PointField, corrected_with
from lensmodel.lab.reproduce.scenes import centred_cut, frame_scene, layout_for
from lensmodel.lab.reproduce.shots import guard_of
from lensmodel.model import LensModel
from lensmodel.photo import LinearPhoto, develop
from lensmodel.simulate import SimulatedField, SimulatedLens, draw_lens, edge_chart, photograph, write_photo
from lensmodel.workflow import pipeline

FRAME = (600, 900)  # rows and columns of a photo (chosen): half a megapixel, for many lenses in little time
SIZE = 31  # pixels of a kernel: that of an estimate
LEAST_LP_PER_PH, LEAST_DB = 10.0, 0.2
"""Gains of the true PSF below these say nothing."""

FILES = ("as it is", "no noise", "no demosaicing", "no lateral colour")
HEAD = ("row", *(f"{what} {zone}" for what in ("PSF L2", "MTF50 share", "PSNR share") for zone in ZONES))

Row = dict[str, dict[str, float]]


@dataclass(frozen=True)
class DevelopedFiles:
    """The files of one lens made in one way, developed."""

    case: Case
    lens: SimulatedLens
    learn: tuple[Path, ...]
    held_out: LinearPhoto
    chart: LinearPhoto
    sharp: Planes

    def truth(self) -> PsfField:
        """Return the true PSF field, which remembers what it was asked."""
        return SimulatedField(self.lens, self.case.settings, self.case.camera.pitch_um)


def case_of(seed: int, photos: int, files: Sequence[Path]) -> Case:
    """Plan a lens wide open on small frames."""
    lens = draw_lens(seed)
    focal = lens.focal_mm[0]
    layout = layout_for(files, photos + 1, FRAME)
    return Case(seed, focal, lens.at_focal(focal).f_number, (photos,), *FRAME, layout)


def without_lateral(lens: SimulatedLens) -> SimulatedLens:
    """Return the same lens whose colours lie on top of each other."""
    optics = tuple(replace(o, lateral_red=(0.0, 0.0), lateral_blue=(0.0, 0.0)) for o in lens.optics)
    return replace(lens, optics=optics)


def shoot(case: Case, files: Sequence[Path], folder: Path, how: str) -> DevelopedFiles:
    """Take all photos of a lens in one of the ways of `FILES`."""
    drawn = draw_lens(case.seed)
    lens = without_lateral(drawn) if how == "no lateral colour" else drawn
    frames = case.photos[-1] + 1
    order = case.order(len(files) * case.layout.pieces)
    paths, sharp = [], np.empty(0, dtype=np.float32)
    for number in range(frames + 1):
        if number < frames:
            whole = frame_scene(files, case.layout, order, number)
            scene = centred_cut(whole, case.height, case.width)
        else:
            scene = edge_chart(case.camera.frame, guard=guard_of(case)).scene
        rng = None if how == "no noise" else np.random.default_rng([case.seed, number])
        photo = photograph(scene, lens, case.settings, case.camera, rng)
        path = folder / f"{how.replace(' ', '-')}-{number}.dng"
        write_photo(path, photo, demosaiced=how == "no demosaicing")
        paths.append(path)
        if number == frames - 1:
            sharp = photo.sharp
    return DevelopedFiles(
        case, lens, tuple(paths[: frames - 1]), develop(paths[-2]), develop(paths[-1]), sharp
    )


def true_samples(samples: Sequence[PsfSample], truth: PsfField) -> list[PsfSample]:
    """Put the true kernels at the places of the estimated ones; spectra of patches no longer count."""
    return [
        replace(s, kernel=truth.kernel_at(s.position, s.settings.channel, SIZE), weight=1.0, spectrum=None)
        for s in samples
    ]


def psf_error(field: PsfField, truth: PsfField) -> dict[str, float]:
    """Median relative L2 of green by zone, at places that are no patches."""
    return by_zone([(p, field.kernel_at(p, "g", 55), truth.kernel_at(p, "g", 55)) for p in asked_places()])


def by_zone(rows: Sequence[tuple[FieldPosition, np.ndarray, np.ndarray]]) -> dict[str, float]:
    """Median relative L2 by zone of pairs of kernels."""
    found: dict[str, list[float]] = {zone: [] for zone in ZONES}
    for place, kernel, true in rows:
        found[zone_of(place.r)].append(distance(kernel, true).rel_l2)
    return {zone: float(np.median(values)) for zone, values in found.items() if values}


def uncautious(developed: LinearPhoto, model: LensModel, case: Case, method: str, workers: int) -> Planes:
    """Correct with a model as if its PSFs were certain."""
    return corrected_with(developed, model.field(case.settings), method, workers=workers)


def cautious(developed: LinearPhoto, model: LensModel, case: Case, method: str, workers: int) -> Planes:
    """Correct as the pipeline does."""
    lateral = pipeline.lateral_of(developed)
    return pipeline.correct_photo(
        developed, model, case.settings, method=method, lateral=lateral, workers=workers
    ).planes


def reached(chart: Planes, photo: Planes, shot: DevelopedFiles) -> tuple[dict[str, float], dict[str, float]]:
    """MTF50 of the chart and PSNR of the photo by zone."""
    gains = np.asarray(shot.case.camera.white_balance, dtype=np.float32)[:, None, None]
    psnr = fidelity(photo * gains, shot.sharp * gains, shot.case.camera.frame)["psnr"]
    mtf50 = {zone: row["mtf50"] for zone, row in edges(chart, shot.case).items()}
    return {zone: value for zone, value in mtf50.items() if value is not None}, psnr


def shares(
    after: dict[str, float], before: dict[str, float], true: dict[str, float], least: float
) -> dict[str, float]:
    """Share of the gain of the true PSF; left out where that gain is below `least`."""
    return {
        zone: (after[zone] - before[zone]) / (true[zone] - before[zone])
        for zone in ZONES
        if zone in true and zone in before and zone in after and true[zone] - before[zone] > least
    }


def rows_of(
    shot: DevelopedFiles, how: str, estimator: str, count: int, workers: int
) -> Iterator[tuple[str, Row]]:
    """All rows that these files tell."""
    truth, case = shot.truth(), shot.case
    recipe = pipeline.Recipe(estimator=estimator, count=count)
    samples = [
        sample for path in shot.learn for sample in pipeline.samples_of_photo(path, recipe, workers=workers)
    ]
    model = LensModel.fit(samples).warmed()
    before = reached(shot.chart.planes, shot.held_out.planes, shot)
    true = reached(
        corrected_with(shot.chart, truth, "paper", workers=workers),
        corrected_with(shot.held_out, truth, "standard", workers=workers),
        shot,
    )

    def row(error: dict[str, float], chart: Planes, photo: Planes) -> Row:
        after = reached(chart, photo, shot)
        return {
            "PSF L2": error,
            "MTF50 share": shares(after[0], before[0], true[0], LEAST_LP_PER_PH),
            "PSNR share": shares(after[1], before[1], true[1], LEAST_DB),
        }

    def chain(made: LensModel, correct: object = cautious) -> Row:
        error = psf_error(made.field(case.settings), truth)
        planes = [
            correct(photo, made, case, method, workers)  # type: ignore[operator]  # one of two functions
            for photo, method in ((shot.chart, "paper"), (shot.held_out, "standard"))
        ]
        return row(error, *planes)

    yield how, chain(model)
    if how != FILES[0]:
        return
    green = [s for s in samples if s.settings.channel == "g"]
    pairs = [(s.position, s.kernel, truth.kernel_at(s.position, "g", SIZE)) for s in green]
    yield "patch kernels", {"PSF L2": by_zone(pairs)}
    yield "without caution", chain(model, uncautious)
    yield "true patch PSFs", chain(LensModel.fit(true_samples(samples, truth)).warmed())
    yield (
        "denoised only",
        row(
            {},
            corrected_with(shot.chart, PointField(), "standard", workers=workers),
            corrected_with(shot.held_out, PointField(), "standard", workers=workers),
        ),
    )


def mean_of(rows: Sequence[Row]) -> Row:
    """Mean over lenses of each cell."""
    found: Row = {}
    for what in ("PSF L2", "MTF50 share", "PSNR share"):
        cells = {zone: [row[what][zone] for row in rows if zone in row.get(what, {})] for zone in ZONES}
        found[what] = {zone: float(np.mean(values)) for zone, values in cells.items() if values}
    return found


def table(rows: dict[str, Row]) -> str:
    """Write the rows as Markdown."""
    lines = ["| " + " | ".join(HEAD) + " |", "|---" * len(HEAD) + "|"]
    for name, row in rows.items():
        cells = [
            f"{row[what][zone]:.2f}" if zone in row[what] else "-"
            for what in ("PSF L2", "MTF50 share", "PSNR share")
            for zone in ZONES
        ]
        lines.append("| " + " | ".join([name, *cells]) + " |")
    return "\n".join(lines)


def main() -> None:
    """Print the budget."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", nargs="+", type=int, default=[3, 8])
    parser.add_argument("--photos", type=int, default=1)
    parser.add_argument("--patches", type=int, default=12, help="patches asked for in one photo")
    parser.add_argument("--estimator", default="default")
    parser.add_argument("--only", nargs="+", choices=FILES, default=list(FILES))
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", type=Path)
    wanted = parser.parse_args()
    if max(wanted.seeds) > 99:
        parser.error("the budget is for development: seeds 0 to 99")
    folder = os.environ.get("LENSMODEL_TEST_DATA")
    photos = list_photos(Path(folder) / "sharp" if folder else None)
    files = tuple(path for path in photos if photo_half(path.stem) == "dev")
    found: dict[str, list[Row]] = {}
    for seed in wanted.seeds:
        case = case_of(seed, wanted.photos, files)
        for how in wanted.only:
            began = time.monotonic()
            with tempfile.TemporaryDirectory(prefix="lensmodel-budget-") as work:
                shot = shoot(case, files, Path(work), how)
                try:
                    for name, row in rows_of(shot, how, wanted.estimator, wanted.patches, wanted.workers):
                        found.setdefault(name, []).append(row)
                except LensModelError as error:
                    print(f"{case.title}, {how}: {error}", file=sys.stderr)
            print(f"{case.title}, {how}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    means = {name: mean_of(rows) for name, rows in found.items()}
    print(f"\nmean over seeds {wanted.seeds}, n = {wanted.photos}, estimator {wanted.estimator}\n")
    print(table(means))
    if wanted.json:
        wanted.json.write_text(json.dumps({"seeds": wanted.seeds, "mean": means, "rows": found}, indent=1))


if __name__ == "__main__":
    main()
