"""How the estimator `default` fares with scenes that its priors were not learned from.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.blind.priors --noise 0.003,0.01 --cases 24 [--folds 4]

The photographs of the development half are dealt into folds; the priors of scenes (`make_scene_spectra` and
`make_local_spectra`) are learned without the fold that is judged. What wins here may be chosen without a look
at the test half. Printed are the rows of `lensmodel bench blind --half dev`, all folds together, the
geometric mean of error ratios over those of the untouched patch, and what `blind_confidence.py` tells.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import asdict
from pathlib import Path
from unittest import mock

import numpy as np

from lensmodel.estimation.spectra.local_spectra import SpectrumMixture
from lensmodel.lab.blind.blind_benchmark import run_blind_benchmark
from lensmodel.lab.blind.confidence import summary
from lensmodel.lab.blind.results import UNTOUCHED, BlindBenchmark, CaseResult, summarised
from lensmodel.lab.cases import list_photos, photo_half
from lensmodel.lab.training import make_local_spectra, make_scene_spectra
from lensmodel.scene.prior import WindowPrior


def main() -> None:
    """Learn, run and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--noise", default="0.003,0.01", help="standard deviations, with commas between")
    parser.add_argument("--cases", type=int, default=24, help="for each noise, spread over photos and PSFs")
    parser.add_argument("--folds", type=int, default=4)
    asked = parser.parse_args()
    folder = os.environ.get("LENSMODEL_TEST_DATA")
    settings = BlindBenchmark(
        photos=Path(folder) / "sharp" if folder else None,
        noise=tuple(float(text) for text in asked.noise.split(",")),
        half="dev",
        cases=asked.cases,
        selection="r-map",
    )
    photos = [photo for photo in list_photos(settings.photos) if photo_half(photo.stem) == "dev"]
    results: list[CaseResult] = []
    for fold in range(asked.folds):
        held = {photo.stem for photo in photos[fold :: asked.folds]}
        known = [photo for photo in photos if photo.stem not in held]
        scene = WindowPrior.of(make_scene_spectra.measured(known))
        mixture = make_local_spectra.learned(known)
        with (
            mock.patch.object(WindowPrior, "load", return_value=scene),
            mock.patch.object(SpectrumMixture, "load", return_value=mixture),
        ):
            report = run_blind_benchmark(settings, only=held)
        results += report.results
        print(f"fold {fold + 1} of {asked.folds}: {len(report.results)} rows", flush=True)
    for row in summarised(results):
        print(
            f"{row.method}, {100 * row.noise:g} %: {row.cases} cases, better {row.improved:.0%}, "
            f"ER < 3 {row.er_lt_3:.0%}, < 2 {row.er_lt_2:.0%}, median {row.er_median:.2f} "
            f"({row.er_p90:.1f}), NCC {row.ncc:.3f}, L2 {row.rel_l2:.2f}, MTF error {row.mtf_rmse:.3f}, "
            f"width {row.width_ratio:.2f}"
        )
    for noise in settings.noise:
        rows = [asdict(r) for r in results if r.noise == noise and r.method != UNTOUCHED and not r.declined]
        gained = np.exp(np.mean([np.log(row["error_ratio"] / row["untouched_ratio"]) for row in rows]))
        print(f"{100 * noise:g} %: ER over untouched {gained:.3f}; {summary(rows)}")


if __name__ == "__main__":
    main()
