"""The demo from start to end, over HTTP as any other user of the service."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import time
from pathlib import Path

from app.client import Client, JobEndedError
from lab.demo import camera, figures, measure
from lab.demo.own_service import own_service
from lab.demo.report import DemoReport
from lab.demo.service_tasks import corrected, follow, planes_of
from lab.demo.stages import Stages, Tell
from lensmodel.quality.images import as_shown
from lensmodel.simulate import demo_data_path

REAL_RAW = "canon_kissx4_colorchart.dng"


def run(output: Path, tell: Tell, *, estimator: str = "default") -> bool:
    """Run the demo; return whether the figures show an improvement.

    Parameters
    ----------
    output : Path
        Folder for what it leaves behind; files of an earlier demo there are replaced.
    tell : callable
        Takes one line of progress at a time, and the seconds that are left.
    estimator : str
        Blind estimator by which the lens is learned.
    """
    output.mkdir(parents=True, exist_ok=True)
    stages = Stages(tell)
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="lensmodel-demo-") as folder:
        work = Path(folder)
        stages.begin(
            "photograph", f"Photographing 5 scenes through the simulated lens {camera.demo_lens().model} ..."
        )
        shots = camera.take_photos(
            work / "photos",
            workers=os.cpu_count() or 1,
            on_photo=lambda name, done, total: stages.part(
                done / total, f"  photo {done} of {total}: {name}"
            ),
        )
        stages.begin("start", "Starting the service ...")
        settings = {"LENS_ESTIMATOR": estimator}
        with own_service(work / "data", output / "service.log", settings) as client:
            report = _simulated(client, shots, work, output, stages)
            _real(client, report, stages)
            stages.finish("Stopping the service ...")
    report.estimator, report.seconds = estimator, time.monotonic() - began
    report.write(output)
    stages.finish(f"Report: {output / 'report.md'}")
    return report.improved


def _simulated(
    client: Client, shots: dict[str, camera.DemoShot], work: Path, output: Path, stages: Stages
) -> DemoReport:
    report = DemoReport(lens=camera.demo_lens().model, aperture=camera.demo_settings().aperture or 0.0)
    stages.begin("develop", "Uploading the photos to be corrected, which the lens does not learn from")
    held_out = client.upload(shots[camera.HELD_OUT].path, calibrate=False)
    chart = client.upload(shots[camera.CHART].path, calibrate=False)
    for photo in (held_out, chart):
        follow(client, photo)
    truth = shots[camera.HELD_OUT]
    before = after = measure.developed(truth)
    report.psnr_before = measure.psnr(before, truth)
    lens_id = ""
    for number, name in enumerate(camera.LEARN_FROM, start=1):
        stages.begin(
            f"learn {number}",
            f"Uploading {name}.dng, photo {number} of {len(camera.LEARN_FROM)} of this lens",
        )
        uploaded = client.upload(shots[name].path)
        follow(client, uploaded, on_job=stages.job)
        lens_id = client.photo(uploaded.id).lens_id or lens_id
        version = client.lens(lens_id).version
        stages.begin(f"correct {number}", f"Correcting {camera.HELD_OUT} with version {version} of the lens")
        path = corrected(
            client,
            held_out,
            work,
            on_job=stages.job,
            lens_version=version,
            output={"color_space": "camera-linear"},
        )
        after = planes_of(path)
        report.psnr_after.append(measure.psnr(after, truth))
        # not before: the correction is what the model was fitted wholly for
        report.psf_error.append(measure.psf_error(client, lens_id, version))
    lens = client.lens(lens_id)
    stages.begin(
        "compare", f"Lens {lens.model}, version {lens.version}: {lens.photos} photos, {lens.samples} samples"
    )
    for place in (0.0, 0.5, 0.9):
        answer = client.psf(lens_id, r=place, phi=0.6, aperture=lens.apertures[0])
        report.answers.append(
            (place, answer.support.effective_samples, answer.support.photos, answer.support.predicted_error)
        )

    stages.begin("correct chart", f"Correcting {camera.CHART}, which has edges to measure")
    path = corrected(client, chart, work, on_job=stages.job, output={"color_space": "camera-linear"})
    report.chart_before = measure.sharpness(measure.developed(shots[camera.CHART]))
    report.chart_after = measure.sharpness(planes_of(path))

    stages.begin("correct", f"Correcting {camera.HELD_OUT} as a picture to look at")
    shutil.copy(corrected(client, held_out, work, on_job=stages.job), output / "corrected.tif")
    gain = camera.demo_camera().white_balance
    rows = {
        "as photographed": as_shown(before, gain),
        "corrected": as_shown(after, gain),
        "the scene itself": as_shown(truth.sharp(), gain),
    }
    figures.mosaic(rows, output / "before-after.png")
    (output / "psf-field.png").write_bytes(client.field_png(lens_id, aperture=lens.apertures[0]))
    history = client.calibrations(lens_id)
    (output / "calibration-history.json").write_text(
        json.dumps([event.model_dump(mode="json") for event in history], indent=2), encoding="utf-8"
    )
    figures.curve(
        output / "calibration-history.svg",
        title="Error of the PSF after each photo",
        x_label="photos of this lens",
        series={zone: [row[zone] for row in report.psf_error] for zone in ("center", "mid", "corner")},
        unit="(relative L2)",
    )
    return report


def _real(client: Client, report: DemoReport, stages: Stages) -> None:
    """Upload a real photo that shows too little of its lens, and keep what the service says to it."""
    stages.begin(
        "refuse a real photo",
        f"Uploading {REAL_RAW}, a real RAW file; it does not say its lens, so the form does",
    )
    photo = client.upload(
        demo_data_path(REAL_RAW),
        lens_maker="Canon",
        lens_model="unknown lens of the Kiss X4",
        lens_serial="demo-1",
        aperture=5.6,
    )
    try:
        follow(client, photo, on_job=stages.job)
    except JobEndedError as ended:
        report.refusal = str(ended) if ended.job.error is None else ended.job.error.detail or str(ended)
