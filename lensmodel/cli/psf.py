"""`lensmodel psf`: what the lens makes of a point of light."""

from __future__ import annotations

from typing import Annotated

import typer

from lensmodel import quality
from lensmodel.cli import files
from lensmodel.cli.console import Display, mtf50_words
from lensmodel.cli.options import (
    ANGLE,
    RADIUS,
    Channel,
    Json,
    ProfileFile,
    Quiet,
    Size,
    Verbose,
    aperture_option,
)
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
    json_output: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = 0,
) -> None:
    """Show what the lens makes of a point of light at one place in the picture.

    Examples:

        lensmodel psf my-24mm.lensprofile --r 0.9 --phi 0.6 --aperture 1.4

        lensmodel psf my-24mm.lensprofile --json

    `lensmodel export` writes it to a file.

    Exit status: 0 answered, 1 the profile cannot be used, 2 wrong usage.
    """
    shown = Display.of(context, quiet=quiet, verbose=verbose, as_json=json_output)
    with files.as_usage():
        place = FieldPosition(r, phi)
        settings = LensSettings(aperture=aperture, channel=channel)
    with shown.busy("computing the PSF"):
        answer = files.profile_at(profile).model.query(place, settings, size)
    tangential, sagittal = quality.tangential_sagittal_mtf50(answer.kernel, place.phi)
    shown.result(_words(place, answer, tangential, sagittal))
    support = ("effective_samples", "photos", "extrapolated", "predicted_error", "nearest", "answered_by")
    shown.document(
        {
            "query": {"r": place.r, "phi": place.phi, "aperture": aperture, "channel": channel, "size": size},
            "support": {name: getattr(answer, name) for name in (*support, "weights")},
            "rms_width_px": rms_width(answer.kernel),
            "mtf50": {"tangential": tangential, "sagittal": sagittal},
            "psf": {"shape": list(answer.kernel.shape), "dtype": "float32", "data": answer.kernel.tolist()},
        }
    )


def _words(place: FieldPosition, answer: PsfAnswer, tangential: float, sagittal: float) -> str:
    beyond = " (beyond what the photos cover)" if answer.extrapolated else ""
    photos = "1 photo" if answer.photos == 1 else f"{answer.photos} photos"
    return (
        f"{ZONE_WORDS[zone_of(place.r)]}, r {place.r:g}: rms width {rms_width(answer.kernel):.2f} px, "
        f"MTF50 tangential {mtf50_words(tangential)}, sagittal {mtf50_words(sagittal)} cycles/px; "
        f"{photos}, {answer.effective_samples:.1f} effective samples, expected error "
        f"{answer.predicted_error:.2f}{beyond}; answered by {answer.answered_by}"
    )
