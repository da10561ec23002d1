"""The portable lens profile: a zip of JSON and npy that opens anywhere and gives the same PSFs.

Layout of a `.lensprofile`, format 1::

    profile.json    format, lens, cameras, provenance, settings of the model, one entry for each sample
    kernels.npy     (n, k, k) float32, sum 1, centred, in the order of the entries
    spectra.npy     optional: what each patch says without a kernel, see `PatchSpectrum`
    phases.npy      optional: phase of red and blue against green, a part of that, see `CrossPhase`
    learned.npz     optional: what the model has learned from them, see `learned`
    family.lensprofile  optional: the profile of other copies that the model leans on, without one of its own

Other files, as the `evidence/` of earlier versions, are passed over. Nothing in it can run code: no pickle,
sizes bounded before arrays are made.
"""

from __future__ import annotations

import io
import json
import logging
import zipfile
import zlib
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError, LensModelError
from lensmodel.core.files import atomic
from lensmodel.core.psf import PsfSample
from lensmodel.model.answer import FORMER_MODES, ModelSettings
from lensmodel.model.field.smoothers import FORMER_METHODS
from lensmodel.model.lens_model import LensModel
from lensmodel.model.sample_codec import PackedSamples, pack_samples, unpack_samples

FORMAT = 1  # raised when older programs could not read a profile any more
_MAX_BYTES = 1 << 30  # unpacked: against files made to fill the memory
_MAX_SAMPLES = 200_000  # some 2,700 photos of 24 patches in three colours (chosen: memory)
_MAX_SIDE = 255  # pixels: several times the widest kernels; larger files would fill the memory (chosen)
_LEARNED = "learned.npz"
_SPECTRA = "spectra.npy"
_PHASES = "phases.npy"  # beside the spectra: older programs read those and pass over this
_FAMILY = "family.lensprofile"

log = logging.getLogger(__name__)
_UNREADABLE = (
    OSError,
    ValueError,
    KeyError,
    EOFError,
    MemoryError,  # an array header may claim any size
    RecursionError,  # lists in lists in lists
    RuntimeError,  # encrypted, or packed by a method that zipfile does not know
    zipfile.BadZipFile,
    zlib.error,
)


@dataclass(frozen=True, slots=True)
class Camera:
    """A body that photos of a lens were taken with; the lens may be part of it.

    Parameters
    ----------
    maker, model, serial : str, optional
        As the photos say; None where they do not.
    """

    maker: str | None = None
    model: str | None = None
    serial: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class LensProfile:
    """A model with what is known of its lens and of the photos that it came from.

    Parameters
    ----------
    model : LensModel
    lens : dict
        Texts: maker, model, serial, label; whatever is known.
    photos : dict
        File name of each photo by the id that samples carry.
    cameras : tuple of Camera
        What these were taken with, each once; empty where no photo says, and in older profiles.
    """

    model: LensModel
    lens: dict[str, str] = field(default_factory=dict)
    photos: dict[str, str] = field(default_factory=dict)
    cameras: tuple[Camera, ...] = ()


def save_profile(path: Path | str, profile: LensProfile, *, learned: bool = True) -> None:
    """Write a profile; the file appears complete or not at all.

    Parameters
    ----------
    path : Path or str
        Replaced if it is there.
    profile : LensProfile
    learned : bool
        Whether what was learned is kept; without it, whoever opens the file fits it anew.

    Raises
    ------
    InvalidInputError
        As `write_profile`.
    OSError
        If the file cannot be written.
    """
    with atomic(Path(path)) as file:
        write_profile(file, profile, learned=learned)


def write_profile(file: IO[bytes], profile: LensProfile, *, learned: bool = True) -> None:
    """Write a profile to an open file.

    Parameters
    ----------
    file : binary file, open for writing
    profile : LensProfile
    learned : bool
        As of `save_profile`.

    Raises
    ------
    InvalidInputError
        If it has more samples, or larger ones, than a profile holds.
    """
    samples, prior = profile.model.samples, profile.model.prior
    side = max(sample.kernel.shape[0] for sample in samples)
    if not _within_limits(len(samples), side):
        raise InvalidInputError(
            f"a profile holds {_MAX_SAMPLES} samples of side {_MAX_SIDE}, not {len(samples)} of side {side}"
        )
    packed = pack_samples(samples)
    document = {
        "format": FORMAT,
        "units": {"r": "half-diagonal", "phi": "radian, counter-clockwise from the right", "kernel": "pixel"},
        "lens": profile.lens,
        "photos": profile.photos,
        "cameras": [_named(asdict(camera)) for camera in profile.cameras],
        "model": asdict(profile.model.settings),
        "samples": packed.entries,
    }
    if prior is not None and isinstance(prior.source, LensModel):
        document["family"] = {"name": prior.name, "strength": prior.strength}
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("profile.json", json.dumps(document, allow_nan=False))
        archive.writestr("kernels.npy", _saved(packed.kernels))
        for part, rows in ((_SPECTRA, packed.spectra), (_PHASES, packed.phases)):
            if rows is not None:
                archive.writestr(part, _saved(rows))
        if learned:
            archive.writestr(_LEARNED, profile.model.learned(), zipfile.ZIP_STORED)
        if prior is not None and isinstance(prior.source, LensModel):
            family = io.BytesIO()
            write_profile(family, LensProfile(prior.source))
            archive.writestr(_FAMILY, family.getvalue(), zipfile.ZIP_STORED)
        if _unpacked(archive) > _MAX_BYTES:
            raise InvalidInputError(f"a profile holds {_MAX_BYTES >> 20} MiB at most; save fewer samples")


def _saved(array: NDArray[np.float32]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def _opened(archive: zipfile.ZipFile, part: str) -> NDArray[np.float32] | None:
    """Read an array that a profile may lack."""
    if part not in archive.namelist():
        return None
    return np.asarray(np.load(io.BytesIO(archive.read(part)), allow_pickle=False))


def _within_limits(count: int, side: int) -> bool:
    return 0 < count <= _MAX_SAMPLES and side <= _MAX_SIDE


def _unpacked(archive: zipfile.ZipFile) -> int:
    return sum(entry.file_size for entry in archive.infolist())


def load_profile(path: Path | str) -> LensProfile:
    """Open a profile.

    Parameters
    ----------
    path : Path or str

    Returns
    -------
    LensProfile
        Its model answers at once: nothing is fitted again where the file holds what was learned.

    Raises
    ------
    InvalidInputError
        If the file is no profile, or one of a newer format; the text says which.
    """
    return _read(path, Path(path).name)


def read_profile(file: IO[bytes], name: str) -> LensProfile:
    """Open a profile that lies in an open file.

    Parameters
    ----------
    file : binary file, open for reading
    name : str
        What errors call it.

    Returns
    -------
    LensProfile

    Raises
    ------
    InvalidInputError
        As `load_profile`.
    """
    return _read(file, name)


def _read(source: Path | str | IO[bytes], name: str, *, alone: bool = False) -> LensProfile:
    """Open a profile; `alone` passes over the family, which has none of its own."""
    try:
        with zipfile.ZipFile(source) as archive:
            names = set(archive.namelist())
            if _unpacked(archive) > _MAX_BYTES:
                raise InvalidInputError(
                    f"{name} unpacks to more than {_MAX_BYTES >> 20} MiB; it is no lens profile"
                )
            document = json.loads(archive.read("profile.json"))
            stack = np.load(io.BytesIO(archive.read("kernels.npy")), allow_pickle=False)
            spectra, phases = (_opened(archive, part) for part in (_SPECTRA, _PHASES))
            learned = archive.read(_LEARNED) if _LEARNED in names else None
            family = archive.read(_FAMILY) if _FAMILY in names and not alone else None
    except FileNotFoundError:
        raise
    except _UNREADABLE as error:
        raise InvalidInputError(
            f"{name} is no lens profile; choose one whose name ends in .lensprofile"
        ) from error
    try:
        if document["format"] != FORMAT:
            raise InvalidInputError(
                f"{name} has profile format {document['format']}, this program reads {FORMAT}; "
                "update the program"
            )
        entries = document["samples"]
        fits = (
            stack.ndim == 3
            and len(entries) == stack.shape[0]
            and _within_limits(len(entries), stack.shape[1])
        )
        if not fits or stack.dtype != np.float32:
            raise InvalidInputError(
                f"{name} holds {len(entries)} samples but kernels of shape {stack.shape}; "
                f"one is needed for each, of side {_MAX_SIDE} at most"
            )
        samples = unpack_samples(PackedSamples(entries, stack, spectra, phases))
        model = _model(samples, _settings(document["model"]), learned)
        if family is not None:
            other = _read(io.BytesIO(family), f"the family in {name}", alone=True)
            leaning = document["family"]
            model = model.with_prior(other.model, float(leaning["strength"]), str(leaning["name"])[:200])
        cameras = tuple(_camera(_texts(camera)) for camera in document.get("cameras", []))
        return LensProfile(model, _texts(document["lens"]), _texts(document["photos"]), cameras)
    except LensModelError:
        raise
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise InvalidInputError(f"{name} is damaged: {error}") from error


def _model(samples: list[PsfSample], settings: ModelSettings, learned: bytes | None) -> LensModel:
    if learned is not None:
        try:
            return LensModel.restored(samples, learned, settings)
        except InvalidInputError as error:
            log.info("the profile's model is fitted anew: %s", error)
    return LensModel.fit(samples, settings)


def _settings(values: dict[str, Any]) -> ModelSettings:
    # written until 0.2; it changed how finely kernels were kept, and no answer
    known = {key: value for key, value in values.items() if key != "oversampling"}
    if known.get("mode") in FORMER_MODES:
        log.info("the mode %s of the profile is gone: the usual one answers", known["mode"])
        del known["mode"]
    if known.get("method") in FORMER_METHODS:
        log.info("the regression %s of the profile is gone: the usual one answers", known["method"])
        del known["method"]
    return ModelSettings(**known)


def _named(values: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in values.items() if value is not None}


def _camera(texts: dict[str, str]) -> Camera:
    return Camera(texts.get("maker"), texts.get("model"), texts.get("serial"))


def _texts(values: dict[str, Any]) -> dict[str, str]:
    return {str(key)[:200]: str(value)[:200] for key, value in values.items()}
