"""`lensmodel psf`: what the lens makes of a point of light."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import tifffile
import typer
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from lensmodel import quality
from lensmodel.cli import files
from lensmodel.cli.console import Display, mtf50_words
from lensmodel.cli.ending import UsageError
from lensmodel.cli.options import (
    ANGLE,
    RADIUS,
    Channel,
    Force,
    Json,
    ProfileFile,
    Quiet,
    Size,
    Verbose,
    aperture_option,
)
from lensmodel.core import types
from lensmodel.core.codec import to_json
from lensmodel.core.files import replacing
from lensmodel.core.geometry import zone_of
from lensmodel.core.psf import rms_width
from lensmodel.core.types import ZONE_WORDS, FieldPosition, LensSettings
from lensmodel.model import PsfAnswer


def psf(
    context: typer.Context,
    profile: ProfileFile,
    r: Annotated[float, RADIUS] = 0.0,
    phi: Annotated[float, ANGLE] = 0.0,
    aperture: Annotated[float | None, aperture_option("f-number; default: all together.")] = None,
    channel: Channel = "g",
    size: Size = 55,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Where to write: a file ending in .npy, .json, .tif or .png.",
        ),
    ] = None,
    force: Force = False,
    json_output: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = 0,
) -> None:
    """Show what the lens makes of a point of light at one place in the picture.

    Examples:

        lensmodel psf my-24mm.lensprofile --r 0.9 --phi 0.6 --aperture 1.4

        lensmodel psf my-24mm.lensprofile --r 0.9 --channel b --output corner.npy

        lensmodel psf my-24mm.lensprofile --json

    Exit status: 0 answered, 1 the profile cannot be used, 2 wrong usage.
    """
    shown = Display.of(context, quiet=quiet, verbose=verbose)
    run(
        profile, PsfQuestion(r, phi, aperture, channel, size), output, shown, force=force, as_json=json_output
    )


WRITTEN: Final = (".npy", ".json", ".tif", ".png")


@dataclass(frozen=True, slots=True)
class PsfQuestion:
    """Which PSF is asked for."""

    r: float
    phi: float
    aperture: float | None
    channel: types.Channel
    size: int


def run(
    source: Path, question: PsfQuestion, output: Path | None, display: Display, *, force: bool, as_json: bool
) -> None:
    """Answer in words, as JSON, or into a file."""
    with files.as_usage():
        place = FieldPosition(question.r, question.phi)
        settings = LensSettings(aperture=question.aperture, channel=question.channel)
    if output is not None and output.suffix.lower() not in WRITTEN:
        raise UsageError(f"no format for {output.name}; give a name that ends in {', '.join(WRITTEN)}")
    files.refuse_existing(output, force=force)
    with display.busy("asking the lens"):
        answer = files.profile_at(source).model.query(place, settings, question.size)
    tangential, sagittal = quality.tangential_sagittal_mtf50(answer.kernel, place.phi)
    document = {
        "query": {
            "r": place.r,
            "phi": place.phi,
            "aperture": question.aperture,
            "channel": question.channel,
            "size": question.size,
        },
        "support": {
            "effective_samples": answer.effective_samples,
            "photos": answer.photos,
            "extrapolated": answer.extrapolated,
            "predicted_error": answer.predicted_error,
            "nearest": answer.nearest,
            "answered_by": answer.answered_by,
            "weights": answer.weights,
        },
        "rms_width_px": rms_width(answer.kernel),
        "mtf50": {"tangential": tangential, "sagittal": sagittal},
        "psf": {"shape": list(answer.kernel.shape), "dtype": "float32", "data": answer.kernel.tolist()},
    }
    if output is not None:
        output.parent.mkdir(parents=True, exist_ok=True)
        with replacing(output) as part:
            _write(part, answer, document)
    if as_json:
        display.document(document)
    else:
        display.result(_words(place, answer, tangential, sagittal))


def _words(place: FieldPosition, answer: PsfAnswer, tangential: float, sagittal: float) -> str:
    beyond = " (beyond what the photos cover)" if answer.extrapolated else ""
    photos = "1 photo" if answer.photos == 1 else f"{answer.photos} photos"
    return (
        f"{ZONE_WORDS[zone_of(place.r)]}, r {place.r:g}: rms width {rms_width(answer.kernel):.2f} px, "
        f"MTF50 tangential {mtf50_words(tangential)}, sagittal {mtf50_words(sagittal)} cycles/px; "
        f"{photos}, {answer.effective_samples:.1f} effective samples, expected error "
        f"{answer.predicted_error:.2f}{beyond}; answered by {answer.answered_by}"
    )


def _write(path: Path, answer: PsfAnswer, document: dict[str, Any]) -> None:
    """Write the kernel, and beside it what made it; NPY alone has no room for that, the command says it."""
    kernel = answer.kernel.astype(np.float32)
    about = json.dumps(to_json({key: value for key, value in document.items() if key != "psf"}))
    match path.suffix.lower():
        case ".npy":
            np.save(path, kernel, allow_pickle=False)
        case ".json":
            path.write_text(json.dumps(to_json(document)), encoding="utf-8")
        case ".tif":
            tifffile.imwrite(path, kernel, description=about, metadata=None)
        case _:
            texts = PngInfo()
            texts.add_text("Description", about)
            scaled = np.rint(65535.0 * kernel / kernel.max()).astype(np.uint16)
            Image.fromarray(scaled).save(path, pnginfo=texts)
