"""Programs that people use instead: called from outside, skipped where they are missing."""

from pathlib import Path

import numpy as np
import pytest
import tifffile

from lab import peers
from lab.peers import PEERS, Peer
from lensmodel.core.errors import InvalidInputError


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

    plain, sharp = (
        tifffile.imread(peer.run(source, tmp_path, setting)[0])[..., :3] / 65535.0
        for setting in (0.0, peer.usual)
    )

    assert plain.shape == sharp.shape == seen.shape
    assert np.abs(plain - seen).mean() < 0.01
    assert np.abs(sharp - plain).mean() > 1e-4


def test_a_picture_made_a_raw_photo_keeps_one_colour_of_each_pixel_and_its_light() -> None:
    planes = np.full((3, 64, 80), 0.2, dtype=np.float32)
    planes[1, :, 40:] = 0.5

    seen = peers.as_raw(planes)

    assert seen.cfa is not None
    np.testing.assert_allclose(seen.planes[:, :, 20], planes[:, :, 20], rtol=0.02)
    np.testing.assert_allclose(seen.planes[:, 8:-8, 60], planes[:, 8:-8, 60], rtol=0.02)


def test_a_program_that_is_missing_or_does_not_end_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(peers, "_LIMIT_S", 0.2)
    missing = Peer("nobody's", "no-such-program", lambda *_: [], 1.0)
    sleeper = Peer("sleeper", "sleep", lambda *_: ["sleep", "30"], 1.0)

    assert not missing.installed
    for peer, said in ((missing, "no-such-program is not"), (sleeper, r"sleep did not end within 0\.2 s")):
        with pytest.raises(InvalidInputError, match=said):
            peer.run(Path("in.tif"), tmp_path, 1.0)
