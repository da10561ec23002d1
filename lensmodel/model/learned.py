"""What a model has learned from its samples, as bytes: so that nobody has to fit it twice.

An npz archive without pickle: a JSON document and arrays. It belongs to certain samples in a certain
order and to the settings they were fitted with; both are checked when it is opened.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import PsfSample
from lensmodel.model import pitch as pitches
from lensmodel.model import variables as va
from lensmodel.model.answer import MODES, ModelSettings
from lensmodel.model.far_light import bounds_of
from lensmodel.model.field.cross_validation import CrossValidation
from lensmodel.model.field.index import SampleIndex
from lensmodel.model.field.leave_one_out import Choice
from lensmodel.model.field.local_frame import LocalKernels
from lensmodel.model.field.robust import Flag
from lensmodel.model.field.transport import WidthField
from lensmodel.model.fitting import Fit, Roster, expected_errors, with_spectra
from lensmodel.model.wavefront.physical_mean import REASONS_APART, Physics
from lensmodel.model.wavefront.zoom import End
from lensmodel.optics.wavefront import NAMES, Wavefront

VERSION: Final = 18
"""Raised whenever the same samples would be fitted otherwise."""

_MOST_BYTES = 1 << 27  # unpacked: against files made to fill the memory
_MOST_NODES = 4096  # of arrays that do not grow with the samples (chosen: far beyond any)
_DAMAGED = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    ArithmeticError,
    IndexError,
    EOFError,
    MemoryError,
    RecursionError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
)

Arrays = dict[str, NDArray[np.float64]]


def dump(fit: Fit, samples: Sequence[PsfSample], settings: ModelSettings) -> bytes:
    """Write what was learned from samples with settings."""
    validation, physical = fit.validation, fit.physical
    arrays: Arrays = {
        "votes": validation.votes,
        "errors": validation.errors,
        "noise": validation.noise,
    }
    document: dict[str, Any] = {
        "version": VERSION,
        "belongs": _belongs(samples, settings),
        "size": fit.size,
        "mode": fit.mode,
        "rule": fit.rule,
        "bandwidth": fit.bandwidth,
        "choice": asdict(validation.choice),
        "flags": [asdict(flag) for flag in validation.flags],
        "widths": {k: v for k, v in _scalars(fit.widths).items() if k != "slopes"},
    }
    if fit.widths.slopes is not None:
        arrays["widths.slopes"] = fit.widths.slopes
    if physical is not None:
        document["physical"] = []
        for number, one in enumerate((physical, *(end.physical for end in fit.ends))):
            arrays |= _arrays(f"physical{number}", one) | _arrays(f"front{number}", one.front)
            front = {k: v for k, v in _scalars(one.front).items() if k != "slopes"}
            document["physical"].append({"front": front, **_scalars(one)})
        document["ends"] = [end.octaves for end in fit.ends]
    text = np.frombuffer(json.dumps(document, allow_nan=True).encode(), dtype=np.uint8)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, document=text, **arrays)
    return buffer.getvalue()


def load(data: bytes, samples: Sequence[PsfSample], settings: ModelSettings) -> Fit:
    """Open what `dump` wrote.

    Raises
    ------
    InvalidInputError
        If it is damaged, of another version, or belongs to other samples or settings.
    """
    try:
        document, arrays = _opened(data)
        if document["version"] != VERSION or document["belongs"] != _belongs(samples, settings):
            raise InvalidInputError("what was learned belongs to other samples or another version; fit again")
        return _fit(document, _checked(arrays, len(samples)), samples, settings)
    except _DAMAGED as error:
        raise InvalidInputError(f"what was learned is damaged ({error}); fit the model again") from error


def fronts(data: bytes) -> tuple[Wavefront, ...]:
    """Wavefront that all patches agreed on when `data` was learned, whatever its samples; else nothing."""
    try:
        document, arrays = _opened(data)
        if document["version"] != VERSION or "physical" not in document:
            return ()
        values = document["physical"][0]
        lines = {name: np.asarray(line, dtype=np.float64) for name, line in _of(arrays, "front0").items()}
        return (_front(values["front"], lines),) if values["agreed"] else ()
    except (*_DAMAGED, InvalidInputError):
        return ()


def _opened(data: bytes) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > _MOST_BYTES:
            raise InvalidInputError("what was learned unpacks to too much; fit the model again")
    with np.load(io.BytesIO(data), allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    return json.loads(arrays.pop("document").tobytes()), arrays


def _belongs(samples: Sequence[PsfSample], settings: ModelSettings) -> str:
    """Checksum of settings and of what names the samples: their pixels are rounded when they are stored."""
    checksum = zlib.crc32(json.dumps(asdict(settings), sort_keys=True).encode())
    for s in samples:
        named = (
            s.photo,
            s.estimator,
            round(s.weight, 6),
            pitches.pixel_of(s, settings.unit),
            s.kernel.shape[0],
            s.settings,
        )
        checksum = zlib.crc32(f"{named} {s.position.r:.6f} {s.position.phi:.6f}".encode(), checksum)
    return f"{len(samples)}-{checksum:08x}"


def _scalars(value: Any) -> dict[str, Any]:  # noqa: ANN401 - any of the frozen values here
    named = {name: getattr(value, name) for name in value.__dataclass_fields__}
    return {
        k: list(v) if isinstance(v, tuple) else v
        for k, v in named.items()
        if not isinstance(v, (np.ndarray, Wavefront, dict))
    }


def _arrays(prefix: str, value: Any) -> Arrays:  # noqa: ANN401 - likewise
    named = {name: getattr(value, name) for name in value.__dataclass_fields__}
    return {f"{prefix}.{k}": v for k, v in named.items() if isinstance(v, np.ndarray)}


def _checked(arrays: Mapping[str, NDArray[Any]], count: int) -> Arrays:
    checked: Arrays = {}
    for name, values in arrays.items():
        numbers = np.asarray(values, dtype=np.float64)
        # an unknown setting is NaN, and only points have settings
        known = numbers[~np.isnan(numbers)] if name.endswith("where") else numbers
        if not np.isfinite(known).all():
            raise ValueError(f"{name} is not finite")
        if name.endswith(("votes", "errors", "noise")) and numbers.min(initial=0.0) < 0:
            raise ValueError(f"{name} is negative")
        per_sample = name.startswith("physical") and name.endswith(".errors")
        if (per_sample or name in {"votes", "errors", "noise"}) and len(numbers) != count:
            raise ValueError(f"{name} has {len(numbers)} entries for {count} samples")
        if numbers.ndim and len(numbers) > max(count, _MOST_NODES):
            raise ValueError(f"{name} has {len(numbers)} entries")
        checked[name] = numbers
    return checked


def _of(arrays: Arrays, prefix: str) -> dict[str, Any]:
    return {name.partition(".")[2]: v for name, v in arrays.items() if name.startswith(f"{prefix}.")}


def _front(scalars: Mapping[str, Any], lines: Mapping[str, Any]) -> Wavefront:
    if any(line.shape != (len(NAMES),) for line in lines.values()):
        raise ValueError("the terms of a wavefront do not fit together")
    return Wavefront(**lines, **{**scalars, "eye": tuple(scalars["eye"])})


def _physical(document: Mapping[str, Any], lines: dict[str, Any], arrays: dict[str, Any]) -> Physics:
    scalars = {name: value for name, value in document.items() if name != "front"}
    physics = Physics(front=_front(document["front"], lines), **scalars, **arrays)
    if not 0.0 <= physics.turned <= 1.0:
        raise ValueError("a probability lies outside 0..1")
    if physics.why_apart not in REASONS_APART or physics.agreed != (physics.why_apart == ""):
        raise ValueError(f"no reason {physics.why_apart!r} to solve patches apart")
    if (
        physics.side < 1
        or physics.side % 2 == 0
        or physics.rest.shape != (len(physics.vectors), physics.side**2)
    ):
        raise ValueError("a wavefront and the rest of its samples do not fit together")
    return physics


def _fit(
    document: Mapping[str, Any], arrays: Arrays, samples: Sequence[PsfSample], settings: ModelSettings
) -> Fit:
    pixel = pitches.usual_pixel(samples, settings.unit)
    common = pitches.at_pixel(samples, pixel, settings.unit)
    where = va.points(common)
    widths = WidthField(slopes=arrays.get("widths.slopes"), **document["widths"])
    local = LocalKernels.of(common, where, widths)
    physical = None
    ends: tuple[End, ...] = ()
    if "physical" in document:
        physical, *others = [
            _physical(values, _of(arrays, f"front{number}"), _of(arrays, f"physical{number}"))
            for number, values in enumerate(document["physical"])
        ]
        ends = tuple(
            End(float(octaves), other) for octaves, other in zip(document["ends"], others, strict=True)
        )
    validation = CrossValidation(
        votes=arrays["votes"],
        errors=arrays["errors"],
        noise=arrays["noise"],
        choice=Choice(**document["choice"]),
        flags=tuple(Flag(**flag) for flag in document["flags"]),
    )
    rule = {str(k): float(v) for k, v in document["rule"].items()}
    used = {str(k): float(v) for k, v in document["bandwidth"].items()}
    mode = str(document["mode"])
    if mode not in MODES:
        raise ValueError(f"no mode {mode!r}")
    scales = np.concatenate([va.scales(rule), va.scales(used)])
    if not (np.isfinite(scales).all() and scales.min() > 0):
        raise ValueError("a bandwidth is not positive")
    if not validation.votes.any():
        raise ValueError("no sample may vote")
    return Fit(
        pixel=pixel,
        size=int(document["size"]),
        widths=widths,
        local=local,
        index=SampleIndex.of(where),
        roster=Roster.of(common),
        validation=validation,
        expected=expected_errors(samples),
        has_spectrum=with_spectra(samples),
        darkest=bounds_of(samples),
        rule=rule,
        bandwidth=used,
        physical=physical,
        mode=mode,
        unit=settings.unit,
        ends=ends,
    )
