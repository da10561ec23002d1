"""`lensmodel demo`: from start to end over HTTP, as any other user, measured against the truth."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Final

import httpx2
import numpy as np
import tifffile
import typer
from PIL import Image
from scipy import ndimage

from app.client import Client
from app.schemas import CorrectionOut, JobOut, PhotoOut
from lab.images import Picture, ZoneSharpness, as_shown, by_zone, fidelity, measure_edges, side_by_side
from lab.kernels import distance
from lab.scenes import photograph_of
from lensmodel.cli.console import Display, UsageError, clock
from lensmodel.core.errors import LensModelError
from lensmodel.core.types import ZONES, FieldPosition, LensSettings, Planes, Zone, zone_of
from lensmodel.photo import develop
from lensmodel.report.lens_report import SensorGeometry
from lensmodel.simulate import SimulatedCamera, draw_lens, edge_chart, photograph, write_photo

# what a demo leaves in its folder
FILES: Final = frozenset({"before-after.png", "corrected.tif", "report.md", "service.log"})
LENS: Final = draw_lens(2024, "soft-fast")  # seed chosen: any number; nothing was tuned on it
CAMERA: Final = SimulatedCamera(height=896, width=1456)  # every scene covers its frame
SETTINGS: Final = LensSettings(aperture=LENS.at_focal().f_number, focal_mm=LENS.focal_mm[0])  # wide open

LEARN_FROM: Final = ("city", "lake", "tea-gardens")
HELD_OUT, CHART = "colosseum", "chart"

_START_SECONDS = 90.0
_STOP_SECONDS = 40.0  # longest wait for it to stop (chosen): it kills its members after 15 s
PATIENCE_SECONDS = 900.0  # longest wait for one job (chosen): far longer than one takes
Say = Callable[[str], None]  # takes one line of progress
_MARGIN: Final = 18  # pixels by which every photograph exceeds the frame
_CHART: Final = edge_chart(CAMERA.frame)
_SIDE: Final = 180  # pixels of a crop (chosen)


def demo(
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="DIR", help="Where to write: a folder for the pictures and the report."
        ),
    ] = Path("demo-output"),
    force: Annotated[bool, typer.Option("--force", help="Use a folder that holds other files too.")] = False,
) -> None:
    """Run the whole process on a simulated lens whose true blur is known.

    Starts a service of its own, uploads photos, calibrates their lens, corrects a photo, measures,
    and stops the service: some minutes on two cores. What an earlier demo left in the folder
    is renewed; a folder with anything else in it is refused without --force.

    Example:

        lensmodel demo --output demo-output

    Exit status: 0 the figures show an improvement, 1 they do not or something failed, 2 wrong usage.
    """
    shown = Display()
    _refuse_what_others_wrote(output, force=force)
    began = time.monotonic()
    improved = run(output, lambda text: shown.note(f"[{clock(time.monotonic() - began)}] {text}"))
    shown.result((output / "report.md").read_text(encoding="utf-8"))
    if not improved:
        shown.error("the corrected photo did not become better; see the report")
        raise typer.Exit(1)


def _refuse_what_others_wrote(folder: Path, *, force: bool) -> None:
    """Make sure that the folder holds nothing but what a demo leaves there."""
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file; give a folder to -o")
    for path in sorted(folder.glob("*")):
        if not force and path.name not in FILES:
            raise UsageError(f"{path} is not of a demo; give a new folder to -o, or --force")


def run(output: Path, say: Say) -> bool:
    """Run the demo; return whether the figures show an improvement."""
    output.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="lensmodel-demo-") as folder:
        work = Path(folder)
        say(f"Photographing 5 scenes through the simulated lens {LENS.identity.model} ...")
        names = enumerate((*LEARN_FROM, HELD_OUT, CHART))
        sharp = {name: _taken(name, work, number) for number, name in names}
        say("Starting the service ...")
        with own_service(work / "data", output / "service.log") as client:
            improved, tables = _learned(client, work, sharp[HELD_OUT], output, say)
            say("Stopping the service ...")
    tables |= {"verdict": "better" if improved else "NOT better", "lens": str(LENS.identity.model)}
    tables |= {"seconds": f"{time.monotonic() - began:.0f}", "aperture": f"{SETTINGS.aperture:g}"}
    (output / "report.md").write_text(_REPORT.format(**tables), encoding="utf-8")
    say(f"Report: {output / 'report.md'}")
    return improved


def _taken(name: str, folder: Path, number: int) -> Planes:
    """Photograph a scene as a DNG file; return the light that a perfect lens would have put on the sensor."""
    size = CAMERA.height + 2 * _MARGIN, CAMERA.width + 2 * _MARGIN
    scene = _CHART.scene if name == CHART else photograph_of(name, *size)
    photo = photograph(scene, LENS, SETTINGS, CAMERA, np.random.default_rng(number))
    write_photo(folder / f"{name}.dng", photo)
    return photo.sharp


def _learned(
    client: Client, work: Path, truth: Planes, output: Path, say: Say
) -> tuple[bool, dict[str, str]]:
    """Learn photo by photo; return whether the held-out photo became better, and what was measured."""
    say("Uploading the photos to be corrected, which the lens does not learn from")
    held_out, chart = (client.upload(work / f"{name}.dng", calibrate=False) for name in (HELD_OUT, CHART))
    for photo in (held_out, chart):
        follow(client, photo, say)
    before = after = develop(work / f"{HELD_OUT}.dng").planes
    first = last = _psnr(before, truth)
    rows, lens_id = [f"| 0, the photo as it was | | {_cells(first)} |"], ""
    for number, name in enumerate(LEARN_FROM, start=1):
        say(f"Uploading {name}.dng, photo {number} of {len(LEARN_FROM)} of this lens")
        uploaded = client.upload(work / f"{name}.dng")
        follow(client, uploaded, say)
        lens_id = client.photo(uploaded.id).lens_id or lens_id
        version = client.lens(lens_id).version
        say(f"Correcting {HELD_OUT} with version {version} of the lens")
        after = _planes(_corrected(client, held_out, work, say, color_space="camera-linear"))
        last = _psnr(after, truth)
        # not before: the correction is what the model was fitted wholly for
        rows.append(f"| {number} | {_cells(_psf_error(client, lens_id, version))} | {_cells(last)} |")
    say(f"Correcting {CHART}, which has edges to measure")
    sharpened = _planes(_corrected(client, chart, work, say, color_space="camera-linear"))
    edges = _sharpness(develop(work / f"{CHART}.dng").planes), _sharpness(sharpened)
    say(f"Correcting {HELD_OUT} as a picture to look at")
    shutil.copy(_corrected(client, held_out, work, say), output / "corrected.tif")
    seen, shown = (as_shown(planes, CAMERA.white_balance) for planes in (before, after))
    Image.fromarray(_enlarged([seen, shown])).save(output / "before-after.png", optimize=True)
    improved = last["center"] > first["center"] and last["corner"] > first["corner"]
    return improved, {"learned": "\n".join(rows), "edges": _edge_rows(*edges)}


def _corrected(client: Client, photo: PhotoOut, folder: Path, say: Say, **asked: str) -> Path:
    """Have a photo corrected into a 16-bit TIFF and download it; `asked` is the rest of what it asks for."""
    correction = client.correct(photo.id, output={"format": "tiff16", **asked})
    follow(client, correction, say)
    return client.download(correction.id, folder / f"{correction.id}.tif")


def _planes(path: Path) -> Planes:
    """Read the camera's linear colours of a corrected TIFF."""
    pixels = np.moveaxis(tifffile.imread(path), -1, 0)
    return np.ascontiguousarray(pixels, dtype=np.float32) / np.float32(65535.0)


def _psf_error(client: Client, lens_id: str, version: int) -> Mapping[Zone, float]:
    """Median relative L2 error of the served green PSFs in each zone, after sub-pixel alignment."""
    errors: dict[Zone, list[float]] = {zone: [] for zone in ZONES}
    for r, count in ((0.05, 1), (0.2, 3), (0.45, 4), (0.6, 4), (0.85, 4)):  # not where patches lie
        for i in range(count):
            phi = 2 * math.pi * (i + 0.3) / count - math.pi
            answer = client.psf(lens_id, r=r, phi=phi, aperture=SETTINGS.aperture, size=55, version=version)
            truth = LENS.kernel(FieldPosition(r, phi), SETTINGS, 55, pitch_um=CAMERA.pitch_um)
            errors[zone_of(r)].append(distance(np.asarray(answer.psf.data), truth).rel_l2)
    return {zone: float(np.median(values)) for zone, values in errors.items()}


def _psnr(planes: Planes, truth: Planes) -> Mapping[Zone, float]:
    gains = np.asarray(CAMERA.white_balance, dtype=np.float32)[:, None, None]
    return fidelity(planes * gains, truth * gains, CAMERA.frame)


def _sharpness(planes: Planes) -> dict[Zone, ZoneSharpness]:
    return by_zone(measure_edges(planes[1], [edge.box for edge in _CHART.edges]))


def _enlarged(pictures: Sequence[Picture]) -> Picture:
    """Rows of crops, twice as large: the three tiles where the last picture has most detail."""
    steep = ndimage.gaussian_gradient_magnitude(pictures[-1].mean(axis=2), 1.0)
    rows, cols = (n // _SIDE for n in steep.shape)
    detail = steep[: rows * _SIDE, : cols * _SIDE].reshape(rows, _SIDE, cols, _SIDE).sum(axis=(1, 3))
    best = sorted(np.argsort(detail, axis=None)[-3:], key=lambda number: number % cols)
    places = [(number // cols * _SIDE, number % cols * _SIDE) for number in best]
    strips = [side_by_side([p[r : r + _SIDE, c : c + _SIDE] for r, c in places]) for p in pictures]
    return np.concatenate(strips).repeat(2, axis=0).repeat(2, axis=1)


def _cells(values: Mapping[Zone, float]) -> str:
    return " / ".join(f"{values[zone]:.2f}" for zone in ZONES)


def _edge_rows(before: Mapping[Zone, ZoneSharpness], after: Mapping[Zone, ZoneSharpness]) -> str:
    words = SensorGeometry().words
    return "\n".join(
        f"| {'centre' if zone == 'center' else zone} | {words(before[zone].mtf50)} | {words(made.mtf50)} "
        f"| {made.mtf_max:.2f} | {made.overshoot:.1f} % |"
        for zone, made in after.items()
        if zone in before
    )


@contextmanager
def own_service(data: Path, log_file: Path, settings: Mapping[str, str] | None = None) -> Iterator[Client]:
    """Start the real service on a free loopback port, wait until it is ready, and stop it at the end."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("LENS_")}
    environment |= settings or {}
    data.mkdir(parents=True, exist_ok=True)
    with log_file.open("wb") as log:
        words = [sys.executable, "-m", "lensmodel", "serve", "--port", "0", "--data", str(data)]
        process = subprocess.Popen(words, stdout=log, stderr=subprocess.STDOUT, env=environment)
    try:
        with Client(_ready(process, data, log_file), key="") as client:  # nobody is asked here
            yield client
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(_STOP_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()


def _ready(process: subprocess.Popen[bytes], data: Path, log_file: Path) -> str:
    until = time.monotonic() + _START_SECONDS
    while time.monotonic() < until and process.poll() is None:
        try:
            url = str(json.loads((data / "service.json").read_text(encoding="utf-8"))["url"])
            if httpx2.get(f"{url}/readyz", timeout=5).status_code == httpx2.codes.OK:
                return url
        except (OSError, ValueError, KeyError, httpx2.HTTPError):
            pass  # not there yet: asked again until the time is up
        time.sleep(0.2)
    status = process.poll()
    became = f"was not ready within {_START_SECONDS:g} s" if status is None else f"ended with status {status}"
    raise LensModelError(f"the service {became}; {log_file} says why")


def follow(client: Client, work: PhotoOut | CorrectionOut, say: Say) -> JobOut:
    """Wait until a job is done; say each stage once."""
    last = ""

    def show(job: JobOut) -> None:
        nonlocal last
        if (words := f"  {job.stage or job.state}") != last:
            last = words
            say(words)

    return client.wait(work, timeout=PATIENCE_SECONDS, on_change=show)


_REPORT: Final = """# What the demo measured

Lens: {lens}, at f/{aperture}, simulated, so that the truth is known. The photo that it was never
calibrated with became **{verdict}** in centre and corner.

| photos learned from | PSF error centre / mid / corner | PSNR centre / mid / corner (dB) |
| --- | --- | --- |
{learned}

PSF error: relative L2 distance to the true green PSF after sub-pixel alignment, median of the zone; 0 is
perfect. PSNR: sRGB-encoded picture against the sharp scene, each block of 128 pixels at its best shift.

| slanted edges of a chart | MTF50 before | MTF50 after | highest MTF after | overshoot after |
| --- | --- | --- | --- | --- |
{edges}

MTF50 in cycles/pixel, green. A PSF that is too wide raises MTF50 as well, but then the highest MTF rises
above 1 and edges overshoot: read them together.

The whole demo took {seconds} s.

Files: corrected.tif (16 bit), before-after.png, service.log.
"""
