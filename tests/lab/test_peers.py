"""Programs that people use instead: called from outside, skipped where they are missing."""

import sys
from pathlib import Path

import numpy as np
import pytest

from lab import peers
from lab.peers import PEERS, Peer, read_picture
from lab.reproduce import programs
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import Planes


def picture() -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.repeat(np.repeat(rng.uniform(0.2, 0.7, (12, 16, 3)), 8, axis=0), 8, axis=1).astype(np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("peer", [p for p in PEERS if not p.raw], ids=lambda p: p.name)
def test_peer_sharpens_a_picture_and_leaves_it_without_its_setting(peer: Peer, tmp_path: Path) -> None:
    if not peer.installed:
        pytest.skip(f"{peer.program} is not installed")
    source = tmp_path / "in.tif"
    seen = picture()
    peer.write_input(seen, source)

    plain = read_picture(peer.run(source, tmp_path, 0.0)[0])
    sharp = read_picture(peer.run(source, tmp_path, peer.usual)[0])

    assert plain.shape == sharp.shape == seen.shape
    assert np.abs(plain - seen).mean() < 0.01
    assert np.abs(sharp - plain).mean() > 1e-4


def test_missing_program_is_named() -> None:
    peer = Peer("nobody's", "no-such-program", lambda *_: [], (1.0,), 1.0)

    assert not peer.installed
    with pytest.raises(InvalidInputError, match="no-such-program is not installed"):
        peer.run(Path("in.tif"), Path(), 1.0)


def test_program_that_does_not_end_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peers, "_LIMIT_S", 0.2)
    peer = Peer("sleeper", "sleep", lambda *_: ["sleep", "30"], (1.0,), 1.0)

    with pytest.raises(InvalidInputError, match=r"sleep did not end within 0\.2 s"):
        peer.run(Path("in.tif"), tmp_path, 1.0)


def test_mosaic_for_raw_peers_keeps_each_colour_at_its_place(tmp_path: Path) -> None:
    seen = np.zeros((16, 16, 3), dtype=np.float32)
    seen[..., 0], seen[..., 1], seen[..., 2] = 0.25, 0.5, 0.75
    raw = next(peer for peer in PEERS if peer.raw)

    raw.write_input(seen, tmp_path / "in.dng")

    numbers = np.frombuffer((tmp_path / "in.dng").read_bytes()[-16 * 16 * 2 :], dtype="<u2")
    assert set(np.unique(numbers)) >= {round(0.25 * 65535), round(0.75 * 65535)}


GAINS = (2.0, 1.0, 1.5)
SCALES = """
import sys, numpy, tifffile
seen = tifffile.imread(sys.argv[1]).astype(float)
tifffile.imwrite(sys.argv[2], numpy.clip(seen * float(sys.argv[3]), 0, 65535).astype(numpy.uint16)[2:-2])
"""


def seen_by_the_sensor(shown: np.ndarray) -> Planes:
    """Linear light before white balance."""
    return (np.moveaxis(shown, -1, 0) / np.asarray(GAINS)[:, None, None]).astype(np.float32)


def scaling() -> Peer:
    """A program that scales what it is given, and cuts two rows off at either side."""

    def command(source: Path, target: Path, folder: Path, setting: float) -> list[str]:
        del folder
        return [sys.executable, "-c", SCALES, str(source), str(target), str(setting)]

    return Peer("scale", "sh", command, (0.8, 1.0, 1.1), 1.0)


def test_program_gets_the_picture_as_shown_and_its_answer_is_light_again() -> None:
    planes = seen_by_the_sensor(picture())

    back = programs.corrected_by(scaling(), planes, 1.0, GAINS)

    assert back.shape == planes.shape
    np.testing.assert_allclose(back[:, 2:-2], planes[:, 2:-2], atol=2e-5)


def test_program_is_compared_at_the_setting_that_is_nearest_to_the_truth() -> None:
    planes = seen_by_the_sensor(picture())
    brighter = programs.corrected_by(scaling(), planes, 1.1, GAINS)

    setting, _ = programs.best_setting(scaling(), planes, brighter, GAINS)

    assert setting == 1.1


@pytest.mark.slow
@pytest.mark.parametrize("name", programs.installed())
def test_installed_program_sharpens_a_developed_photo_and_keeps_its_colours(name: str) -> None:
    shown = np.tile(picture(), (4, 4, 1))  # readers of raw files refuse tiny ones
    planes = seen_by_the_sensor(shown)
    peer = programs.named(name)

    after = programs.corrected_by(peer, planes, peer.usual, GAINS)

    np.testing.assert_allclose(np.median(after / planes, axis=(1, 2)), 1.0, rtol=0.03)
    assert np.abs(after - planes).mean() > 1e-4
