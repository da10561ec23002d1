"""The demo from start to end, over HTTP as any other user of the service."""

from __future__ import annotations

import shutil
import tempfile
import time
from pathlib import Path

from app.client import Client
from lab.demo import report
from lab.demo.service import Say, corrected, follow, own_service, planes_of
from lab.images import as_shown
from lensmodel.photo import develop


def run(output: Path, say: Say) -> bool:
    """Run the demo; return whether the figures show an improvement."""
    output.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="lensmodel-demo-") as folder:
        work = Path(folder)
        say(f"Photographing 5 scenes through the simulated lens {report.LENS.model} ...")
        shots = report.take_photos(work / "photos", on_photo=lambda name: say(f"  photo of {name}"))
        say("Starting the service ...")
        with own_service(work / "data", output / "service.log") as client:
            found = _simulated(client, shots, work, output, say)
            say("Stopping the service ...")
    found.seconds = time.monotonic() - began
    found.write(output)
    say(f"Report: {output / 'report.md'}")
    return found.improved


def _simulated(
    client: Client, shots: dict[str, report.DemoShot], work: Path, output: Path, say: Say
) -> report.DemoReport:
    found = report.DemoReport(lens=report.LENS.model, aperture=report.SETTINGS.aperture or 0.0)
    say("Uploading the photos to be corrected, which the lens does not learn from")
    held_out, chart = (
        client.upload(shots[name].path, calibrate=False) for name in (report.HELD_OUT, report.CHART)
    )
    for photo in (held_out, chart):
        follow(client, photo, say)
    truth = shots[report.HELD_OUT]
    before = after = develop(truth.path).planes
    found.psnr_before = report.psnr(before, truth)
    lens_id = ""
    for number, name in enumerate(report.LEARN_FROM, start=1):
        say(f"Uploading {name}.dng, photo {number} of {len(report.LEARN_FROM)} of this lens")
        uploaded = client.upload(shots[name].path)
        follow(client, uploaded, say)
        lens_id = client.photo(uploaded.id).lens_id or lens_id
        version = client.lens(lens_id).version
        say(f"Correcting {report.HELD_OUT} with version {version} of the lens")
        after = planes_of(corrected(client, held_out, work, say, color_space="camera-linear"))
        found.psnr_after.append(report.psnr(after, truth))
        # not before: the correction is what the model was fitted wholly for
        found.psf_error.append(report.psf_error(client, lens_id, version))
    say(f"Correcting {report.CHART}, which has edges to measure")
    path = corrected(client, chart, work, say, color_space="camera-linear")
    found.chart_before = report.sharpness(develop(shots[report.CHART].path).planes)
    found.chart_after = report.sharpness(planes_of(path))
    say(f"Correcting {report.HELD_OUT} as a picture to look at")
    shutil.copy(corrected(client, held_out, work, say), output / "corrected.tif")
    gain = report.CAMERA.white_balance
    rows = {"as photographed": as_shown(before, gain), "corrected": as_shown(after, gain)}
    report.draw_crops(rows, output / "before-after.png")
    return found
