"""Programs that people use instead, called by their own command lines where installed: what they cost."""

from __future__ import annotations

import os
import resource
import shutil
import struct
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import tifffile
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import Planes
from lensmodel.photo import LinearPhoto, develop
from lensmodel.photo.writing import write_bayer_dng

_LIMIT_S: Final = 1800  # seconds that a program may take (chosen): one that hangs must end
_FULL: Final = 65535  # largest number of 16 bits

Command = Callable[[Path, Path, Path, float], list[str]]  # from input, output, folder for settings, setting


@dataclass(frozen=True, slots=True)
class Peer:
    """A program with one setting that matters."""

    name: str  # for tables
    program: str  # what must be on the path
    # the command line; a setting of 0 switches the sharpening off and leaves everything else
    command: Command
    usual: float  # the setting that is timed
    raw: bool = False  # whether it takes a mosaic in a DNG; else a 16-bit TIFF, sRGB-encoded

    @property
    def installed(self) -> bool:
        """Whether the program is on the path."""
        return shutil.which(self.program) is not None

    def write_input(self, encoded: NDArray[np.float32], path: Path) -> None:
        """Write a picture `(height, width, 3)`, 0 to 1, as this program takes it."""
        numbers = light_numbers(encoded)
        if self.raw:
            write_raw(np.moveaxis(numbers, -1, 0), path)
        else:
            tifffile.imwrite(path, numbers, photometric="rgb")

    def run(self, source: Path, folder: Path, setting: float) -> tuple[Path, float]:
        """Run the program on a file; return its picture, and the CPU seconds of the process."""
        if not self.installed:
            raise InvalidInputError(f"{self.program} is not installed; install it to compare with it")
        target = folder / f"{self.program}-out.tif"
        target.unlink(missing_ok=True)
        words = self.command(source, target, folder, setting)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        around = os.environ | {"HOME": str(folder), "OMP_NUM_THREADS": "2"}
        try:
            done = subprocess.run(words, capture_output=True, check=False, timeout=_LIMIT_S, env=around)
        except subprocess.TimeoutExpired as error:
            raise InvalidInputError(f"{self.program} did not end within {_LIMIT_S} s") from error
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        if done.returncode != 0 or not target.exists():
            said = done.stderr.decode(errors="replace")[-300:]
            raise InvalidInputError(f"{self.program} failed with status {done.returncode}: {said}")
        return target, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    def net_seconds(self, source: Path, folder: Path) -> float:
        """CPU seconds of the sharpening alone: a run with it less one without."""
        with_it = self.run(source, folder, self.usual)[1]
        return with_it - self.run(source, folder, 0.0)[1]


def write_raw(numbers: NDArray[np.uint16], path: Path) -> None:
    """Write a DNG whose sensor saw a picture `(3, height, width)`, of whose colours each pixel keeps one."""
    rows, cols = numbers.shape[1] // 2 * 2, numbers.shape[2] // 2 * 2
    mosaic = np.ascontiguousarray(numbers[1, :rows, :cols])
    mosaic[::2, ::2] = numbers[0, :rows:2, :cols:2]
    mosaic[1::2, 1::2] = numbers[2, 1:rows:2, 1:cols:2]
    write_bayer_dng(path, mosaic, black=0, white=_FULL)


def as_raw(planes: Planes) -> LinearPhoto:
    """Develop linear light `(3, height, width)` as if a sensor with a mosaic had seen it."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "photo.dng"
        write_raw(light_numbers(planes), path)
        return develop(path)


def light_numbers(planes: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Light of 0 to 1 in numbers of 16 bits."""
    return np.round(np.clip(planes, 0.0, 1.0) * np.float32(_FULL)).astype(np.uint16)


def _gmic(source: Path, target: Path, folder: Path, setting: float) -> list[str]:
    del folder
    step = ["-deblur_richardsonlucy", f"1.2,{setting:.0f},1"] if setting else []
    return ["gmic", str(source), *step, "-c", "0,65535", "-o", f"{target},uint16"]


_CAPTURE = """[Version]
AppVersion=5.9
Version=346
[PostDemosaicSharpening]
Enabled={enabled}
Contrast=0
AutoContrast=false
AutoRadius=false
DeconvRadius={radius}
DeconvRadiusOffset=0
DeconvIterCheck=false
DeconvIterations=20
"""


def _rawtherapee(source: Path, target: Path, folder: Path, setting: float) -> list[str]:
    profile = folder / "rawtherapee.pp3"
    enabled = "true" if setting else "false"
    profile.write_text(_CAPTURE.format(enabled=enabled, radius=setting or 1.0), encoding="utf-8")
    return ["rawtherapee-cli", "-Y", "-t", "-b16", "-o", str(target), "-p", str(profile), "-c", str(source)]


_HISTORY = """<?xml version="1.0" encoding="UTF-8"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:darktable="http://darktable.sf.net/" darktable:xmp_version="4"
 darktable:raw_params="0" darktable:auto_presets_applied="1" darktable:history_end="1"
 darktable:iop_order_version="4"><darktable:history><rdf:Seq>
<rdf:li darktable:num="0" darktable:operation="diffuse" darktable:enabled="{enabled}"
 darktable:modversion="2" darktable:params="{params}" darktable:multi_name="" darktable:multi_priority="0"/>
</rdf:Seq></darktable:history></rdf:Description></rdf:RDF></x:xmpmeta>
"""


def _darktable(source: Path, target: Path, folder: Path, setting: float) -> list[str]:
    # The preset "lens deblur: medium" of version 4.2 has 16 iterations over 10 pixels.
    numbers = (3.0, 1.0, 1.0, 0.0, 1.0, 0.0, 0.0, -0.25, 0.125, -0.5, 0.25)
    params = struct.pack("<ifi11fi", int(setting) or 16, 0.0, 10, *numbers, 0)
    history = folder / "darktable.xmp"
    history.write_text(_HISTORY.format(enabled=int(setting > 0), params=params.hex()), encoding="utf-8")
    core = ["--core", "--configdir", str(folder / "darktable"), "--library", ":memory:"]
    files = [str(source), str(history), str(target), "--apply-custom-presets", "false"]
    return ["darktable-cli", *files, *core, "--conf", "plugins/imageio/format/tiff/bpp=16"]


# each at the setting that is timed
PEERS: Final[tuple[Peer, ...]] = (
    Peer("G'MIC Richardson-Lucy", "gmic", _gmic, 20.0),
    Peer("darktable lens deblur", "darktable-cli", _darktable, 16.0),
    Peer("RawTherapee capture sharpening", "rawtherapee-cli", _rawtherapee, 1.15, raw=True),
)
