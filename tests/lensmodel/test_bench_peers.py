"""Programs that people use instead: called from outside, skipped where they are missing."""

from pathlib import Path

import numpy as np
import pytest

from lensmodel.bench.peers import PEERS, Peer, read_picture, skimage_results
from lensmodel.errors import InvalidInputError


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


def test_mosaic_for_raw_peers_keeps_each_colour_at_its_place(tmp_path: Path) -> None:
    seen = np.zeros((16, 16, 3), dtype=np.float32)
    seen[..., 0], seen[..., 1], seen[..., 2] = 0.25, 0.5, 0.75
    raw = next(peer for peer in PEERS if peer.raw)

    raw.write_input(seen, tmp_path / "in.dng")

    numbers = np.frombuffer((tmp_path / "in.dng").read_bytes()[-16 * 16 * 2 :], dtype="<u2")
    assert set(np.unique(numbers)) >= {round(0.25 * 65535), round(0.75 * 65535)}


def test_scikit_image_gives_pictures_of_the_same_size() -> None:
    seen = np.moveaxis(picture(), -1, 0)

    found = skimage_results(seen, widths=(0.7,))

    assert {name: len(pictures) for name, pictures in found.items()} == {
        "scikit-image Richardson-Lucy": 2,
        "scikit-image Wiener": 2,
    }
    assert all(p.shape == seen.shape for pictures in found.values() for p in pictures)
