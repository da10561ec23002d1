"""Feed damaged files to all that reads what strangers send; keep each that is not refused in words.

    python tests/app/endurance/fuzz_parsers.py [--minutes 10] [--seed 0] [--keep FOLDER]

Each reader gets a valid file of its kind with random damage: bytes set, inserted, removed, doubled, numbers
of the header made huge, the end cut off. It may read it, or refuse it with an error of the library; any other
exception, and more than ten seconds, is a fault, and its file is kept. Damage that reached a new line of our
own modules is built upon (coverage by `sys.settrace`).
"""

from __future__ import annotations

import asyncio
import itertools
import json
import random
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import programs
from PIL import Image
from starlette.requests import Request

from app.http import upload
from lab.kernels import gaussian
from lensmodel import photo
from lensmodel.core.errors import LensModelError
from lensmodel.core.psf import EncodedPatch, PsfSample
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.lens import Lens
from lensmodel.model import LensModel
from lensmodel.photo.values import LensIdentity, PhotoMetadata
from lensmodel.photo.writing import write_bayer_dng

SLOW_S = 10.0
POOL = 400
"""Files kept for each reader (chosen): what reached a new line, the newest first to go."""

Reader = Callable[[Path], object]


def _multipart(path: Path) -> object:
    body = path.read_bytes()

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": body, "more_body": False}

    headers = [(b"content-type", b"multipart/form-data; boundary=lens")]
    scope = {"type": "http", "method": "POST", "headers": headers, "app": None}

    async def read() -> dict[str, str]:
        async with upload.read_form(Request(scope, receive)) as (_, fields):
            return fields

    return asyncio.run(read())


READERS: dict[str, tuple[str, Reader]] = {
    "inspect dng": ("a.dng", photo.inspect),
    "inspect tiff": ("a.tif", photo.inspect),
    "inspect jpeg": ("a.jpg", photo.inspect),
    "inspect png": ("a.png", photo.inspect),
    "sniff": ("a.dng", lambda path: photo.sniff(path.read_bytes()[: photo.HEAD_BYTES])),
    "profile": ("a.lensprofile", Lens.load),
    "encoded": ("encoded", lambda path: EncodedPatch.from_bytes(path.read_bytes())),
    "multipart": ("multipart", _multipart),
}


def write_seeds(folder: Path) -> None:
    """Write a small valid file of each kind."""
    rng = np.random.default_rng(0)
    mosaic = rng.integers(512, 9000, (96, 128), dtype=np.uint16)
    lens = LensIdentity("Test", "50mm", "1", "exif")
    metadata = PhotoMetadata(camera_maker="Test", camera_model="T-1", lens=lens, aperture=2.0)
    write_bayer_dng(folder / "a.dng", mosaic, black=512, white=15512, metadata=metadata)
    picture = Image.fromarray(rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))
    exif = Image.Exif()
    exif[0x010F], exif[0x829D] = "Test", 2.8
    for name in ("a.tif", "a.jpg", "a.png"):
        picture.save(folder / name, exif=exif)
    samples = [
        PsfSample(gaussian(15, np.eye(2)), FieldPosition(r, 0.3), LensSettings(2.8, 35.0), photo="x")
        for r in (0.1, 0.5, 0.9)
    ]
    profile = Lens(LensModel.fit(samples), {"model": "x"}, {"0" * 16: "x.dng"})
    profile.save(folder / "a.lensprofile")
    (folder / "encoded").write_bytes(b"\x00" + rng.bytes(1024))
    (folder / "multipart").write_bytes(
        b'--lens\r\nContent-Disposition: form-data; name="aperture"\r\n\r\n2.8\r\n'
        b'--lens\r\nContent-Disposition: form-data; name="file"; filename="a.dng"\r\n\r\nII*\0\r\n'
        b"--lens--\r\n"
    )


def damaged(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    """Return a file with one to eight kinds of damage."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        at = rng.randrange(max(len(out), 1))
        kind = rng.randrange(7)
        if kind == 0 and out:
            out[at] = rng.randrange(256)
        elif kind == 1:
            out[at:at] = rng.randbytes(rng.randint(1, 16))
        elif kind == 2:
            del out[at : at + rng.randint(1, 64)]
        elif kind == 3:
            out[at : at + 4] = rng.choice((b"\xff" * 4, b"\0" * 4, b"\x7f\xff\xff\xff", b"\0\0\0\x80"))
        elif kind == 4:
            out += out[at : at + 512]
        elif kind == 5:
            del out[rng.randrange(len(out) + 1) :]
        else:
            other = rng.choice(others)
            cut = rng.randrange(max(len(other), 1))
            out[at : at + 32] = other[cut : cut + 32]
    return bytes(out)


class Lines:
    """Notes which lines of our own code ran."""

    def __init__(self) -> None:
        self.known: set[tuple[str, int]] = set()
        self.fresh = False

    def trace(self, frame: FrameType, event: str, argument: object) -> Callable[..., object] | None:
        """Follow calls into our own modules."""
        del argument
        name = frame.f_code.co_filename
        if "lensmodel" not in name and "/app/" not in name:
            return None
        place = (name, frame.f_lineno)
        if event == "line" and place not in self.known:
            self.known.add(place)
            self.fresh = True
        return self.trace


def fault_of(reader: Reader, path: Path, lines: Lines) -> str:
    """Let a reader read a file; return what went wrong, empty if nothing did."""
    began, lines.fresh = time.monotonic(), False
    sys.settrace(lines.trace)
    try:
        reader(path)
    except LensModelError:
        pass
    except Exception:  # noqa: BLE001 - whatever else it is, is what we look for
        return traceback.format_exc()
    finally:
        sys.settrace(None)
    took = time.monotonic() - began
    return f"took {took:.0f} s" if took > SLOW_S else ""


def main() -> int:
    """Run for the time that was asked for; print each kind of fault once, and a summary."""
    wishes = programs.wishes(__doc__, minutes=10.0, seed=0, keep=Path("bench-output/fuzz"))
    rng, lines, done, faults = random.Random(wishes.seed), Lines(), Counter[str](), Counter[str]()
    with tempfile.TemporaryDirectory() as scratch:
        seeds = Path(scratch)
        write_seeds(seeds)
        pools = {name: [(seeds / file).read_bytes()] for name, (file, _) in READERS.items()}
        every = [pool[0] for pool in pools.values()]
        names, end = itertools.cycle(READERS), time.monotonic() + 60.0 * wishes.minutes
        while time.monotonic() < end:
            name = next(names)
            file, reader = READERS[name]
            data, path = damaged(rng.choice(pools[name]), every, rng), seeds / f"try-{file}"
            path.write_bytes(data)
            reason = fault_of(reader, path, lines)
            done[name] += 1
            if lines.fresh:
                pools[name] = [pools[name][0], *pools[name][1:][-POOL:], data]
            if reason:
                kept = wishes.keep / f"{name.replace(' ', '-')}-{done[name]}"
                kind = f"{name}: {reason.strip().splitlines()[-1]}"
                wishes.keep.mkdir(parents=True, exist_ok=True)
                kept.write_bytes(data)
                if not faults[kind]:
                    print(f"FAULT {name}: {kept}\n{reason}")
                faults[kind] += 1
    print(json.dumps({"files": dict(done), "lines of our code reached": len(lines.known)}))
    print(f"{sum(faults.values())} faults of {len(faults)} kinds")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
