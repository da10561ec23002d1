"""How far the error of a blind kernel falls with the number of patches that share it.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.blind.pooling --pools 1,12 --cases 12 [--half test]

The cases of `lensmodel bench blind`, once for each size of the pool: the first patch of a case is the same in
all of them. Printed are medians, and the median error over that of the first pool. Finished cases are kept in
`--cache`, which may be that of `lensmodel bench blind`.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np

from lensmodel.lab.blind.blind_benchmark import run_blind_benchmark
from lensmodel.lab.blind.results import UNTOUCHED, BlindBenchmark


def main() -> None:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pools", default="1,12", help="patches that share a kernel, with commas between")
    parser.add_argument("--methods", default="default", help="estimators, with commas between")
    parser.add_argument("--noise", type=float, default=0.01)
    parser.add_argument("--cases", type=int, default=12)
    parser.add_argument("--half", choices=("dev", "test", "all"), default="test")
    parser.add_argument("--cache", type=Path, default=Path("bench-output/cache"))
    asked = parser.parse_args()
    data = os.environ.get("LENSMODEL_TEST_DATA")
    methods = tuple(asked.methods.split(","))
    first: dict[str, float] = {}
    print("| patches | method | cases | better than blurry | ER median | NCC | L2 | MTF error | L2 / L2(1) |")
    print("|---|---|---|---|---|---|---|---|---|")
    for pool in (int(text) for text in asked.pools.split(",")):
        settings = BlindBenchmark(
            photos=Path(data) / "sharp" if data else None,
            noise=(asked.noise,),
            methods=methods,
            half=asked.half,
            cases=asked.cases,
            pool=pool,
        )
        for row in run_blind_benchmark(settings, cache=asked.cache).summary:
            if row.method != UNTOUCHED:
                ratio = row.rel_l2 / first.setdefault(row.method, row.rel_l2)
                print(
                    f"| {pool} | {row.method} | {row.cases} | {row.improved:.0%} | {row.er_median:.2f} "
                    f"| {row.ncc:.3f} | {row.rel_l2:.2f} | {row.mtf_rmse:.3f} | {np.round(ratio, 2)} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
