"""`python -m lab.population`: make scenes and lenses, train the network."""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Final

import numpy as np

from lab.population import library, scenes, sets
from lab.population.prescriptions import HELD_OUT, PRESCRIPTIONS
from lab.population.traced import draw, grid_of
from lensmodel.core.files import write_atomically
from lensmodel.neural.network import WEIGHTS, FieldNetwork


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m lab.population")
    parser.add_argument("--folder", type=Path, default=Path("population"), help="where scenes and lenses lie")
    commands = parser.add_subparsers(dest="command", required=True)
    make = commands.add_parser("scenes", help="scale photographs down to sharp scenes, draw others")
    make.add_argument("--photos", type=Path, required=True, help="folder of sharp photographs (PNG)")
    make.add_argument("--git", type=Path, nargs="*", default=[], help="git repositories of JPEGs")
    lenses = commands.add_parser("lenses", help="draw lenses and take photos through them; resumable")
    lenses.add_argument("--family", choices=library.FAMILIES, default="wavefront")
    lenses.add_argument("--first", type=int, default=0, help="first shard of 25 lenses")
    lenses.add_argument("--shards", type=int, default=400)
    lenses.add_argument("--of-errors", action="store_true", help="for `train-errors`")
    lenses.add_argument("--held-out", action="store_true", help="lenses, designs and scenes to judge by")
    lenses.add_argument("--plain", action="store_true", help="held out, RAW photos that nothing spoils")
    lenses.add_argument("--through", type=Path, help="take other photos through the lenses of this folder")
    lenses.add_argument("--rescaled", action="store_true", help="before pixels of another size then")
    lenses.add_argument("--processes", type=int, default=2)
    train = commands.add_parser("train", help="train the network; goes on where it was ended")
    train.add_argument("--minutes", type=float, default=60.0, help="of this sitting")
    train.add_argument("--total-minutes", type=float, default=60.0, help="of all sittings")
    train.add_argument("--rate", type=float, default=1e-3)
    train.add_argument("--threads", type=int, default=2)
    train.add_argument("--seed", type=int, default=0)
    train.add_argument("--code", default="", help="what made the library, for the provenance")
    told = commands.add_parser("train-errors", help="after that: what tells errors, on lenses of its own")
    told.add_argument("--minutes", type=float, default=8.0)
    told.add_argument("--threads", type=int, default=2)
    told.add_argument("--seed", type=int, default=0)
    judged = commands.add_parser("judge", help="errors on plain lenses by number of photos")
    judged.add_argument("--family", choices=library.FAMILIES, default="traced")
    judged.add_argument("--weights", type=Path, help="others than those of the package")
    grid = commands.add_parser("grid", help="PSFs of a copy of a design, to take photos through")
    grid.add_argument("design", nargs="+", choices=sorted(PRESCRIPTIONS), metavar="DESIGN")
    grid.add_argument("--copy", type=int, default=0, help="seed of the copy")
    grid.add_argument("--pitch", type=float, default=4.5, help="pixel pitch, micrometres")
    grid.add_argument("--stopped", type=float, default=0.0, help="stops closed from wide open")
    publish = commands.add_parser("publish", help="put trained weights into the package, with their figures")
    publish.add_argument("weights", type=Path)
    publish.add_argument("--fixed", type=Path, required=True, help="set to hold them by, made if missing")
    return parser.parse_args()


def _judge(asked: argparse.Namespace) -> None:
    data = (asked.weights or WEIGHTS).read_bytes()
    network = FieldNetwork.from_bytes(data)
    lenses = sets.load_library(asked.folder / "plain", set(), families=(asked.family,))
    print(f"{asked.family}, {len(lenses)} lenses, weights {network.name}: relative L2 of PSFs")
    for photos in (1, 2, 5):
        figures = sets.judge(network, (sets.of_photos(lens, photos) for lens in lenses))
        print(f"{photos} photos: " + "  ".join(f"{name} {value:.3f}" for name, value in figures.items()))


def _grid(asked: argparse.Namespace) -> None:
    asked.folder.mkdir(parents=True, exist_ok=True)
    for design in asked.design:
        lens = draw(np.random.default_rng([asked.copy, *design.encode()]), [design])
        lens = replace(lens, pitch_um=asked.pitch)
        f_number = lens.f_number * 2.0 ** (asked.stopped / 2.0)
        path = asked.folder / f"{design.replace('@', '-')}-f{f_number:.2g}.npz"
        grid_of(lens, f_number).write(path)
        print(path, "held out" if design in HELD_OUT else "trained on")


def _publish(asked: argparse.Namespace) -> None:
    if not asked.fixed.exists():
        lenses = sets.load_library(asked.folder / "plain", set(), families=("traced",))
        sets.save_sets(sets.fixed_set(lenses), asked.fixed)
    data = asked.weights.read_bytes()
    rng = np.random.default_rng(0)
    apart = sets.load_library(asked.folder / "held-out", set())
    drawn = [sets.draw_set(lens, 64, 8, rng, varied=False) for lens in apart]
    powers = sets.best_powers(FieldNetwork.from_bytes(data), drawn)
    data = sets.adjusted(data, powers=powers)
    shift = sets.understated(FieldNetwork.from_bytes(data), drawn)
    data = sets.adjusted(data, raised=shift)
    figures = sets.judge(FieldNetwork.from_bytes(data), sets.load_sets(asked.fixed))
    published = sets.adjusted(
        data,
        fixed_set={name: round(value, 4) for name, value in figures.items()},
        errors_raised=round(shift, 4),
        powers=[round(power, 2) for power in powers],
    )
    write_atomically(WEIGHTS, published)
    print("kernels are raised to the powers " + ", ".join(f"{power:.2f}" for power in powers))
    print(f"told errors are raised by {np.exp(shift):.2f}, the median on lenses held out")
    print(f"{WEIGHTS}: {len(published) / 2**20:.1f} MiB, {FieldNetwork.from_bytes(published).name}")
    print("  ".join(f"{name} {value:.4f}" for name, value in figures.items()))


def _scenes(asked: argparse.Namespace) -> None:
    from lab.cases import photo_half  # noqa: PLC0415 - brings all of the library

    trained = (source for source in scenes.files_of(asked.photos) if photo_half(source.name) == "dev")
    others = chain.from_iterable(scenes.objects_of(repository, ".") for repository in asked.git)
    print(len(scenes.build(asked.folder / "scenes", chain(trained, others))), "scenes")


def _lenses(asked: argparse.Namespace) -> None:
    began, count = time.monotonic(), 0
    name = "plain" if asked.plain else "held-out" if asked.held_out else "lenses"
    order = library.Order(
        asked.folder / ("lenses-of-errors" if asked.of_errors else name), asked.folder / "scenes",
        asked.family, held_out=asked.held_out or asked.plain, plain=asked.plain, through=asked.through,
        rescaled=asked.rescaled,
    )  # fmt: skip
    shards = range(asked.first, asked.first + asked.shards)
    for made in library.generate(order, shards, asked.processes):
        count += made
        if made:
            print(f"{asked.family}: {count} lenses in {time.monotonic() - began:.0f} s", flush=True)


def _train(asked: argparse.Namespace) -> None:
    from lab.population import training  # noqa: PLC0415 - needs PyTorch

    options = {name: value for name, value in vars(asked).items() if name != "command"}
    (training.train if asked.command == "train" else training.train_errors)(**options)


_COMMANDS: Final = {
    "scenes": _scenes, "lenses": _lenses, "train": _train, "train-errors": _train, "judge": _judge,
    "grid": _grid, "publish": _publish,
}  # fmt: skip


if __name__ == "__main__":
    asked_for = _arguments()
    _COMMANDS[asked_for.command](asked_for)
