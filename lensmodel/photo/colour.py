"""Transfer curves, colour matrices and ICC profiles: file numbers to linear light and back.

Sources: IEC 61966-2-1:1999 (sRGB); ICC.1:2022.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal, TypeAlias, cast

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from lensmodel.photo.values import Matrix3, Transfer

CODES: Final = 65536  # of 16 bits
_LEAST_COLUMN: Final = 1e-3  # of XYZ: a channel that gives no light has no curve
_ADDITIVE: Final = 2e-3  # error in XYZ up to which channels add up (chosen): rounding makes a tenth of it

Curve: TypeAlias = NDArray[np.float32]
"""Linear light at the codes k / 65535, shape (65536,), not decreasing."""

Matrix: TypeAlias = NDArray[np.float64]

# Linear sRGB to CIE XYZ under D65, IEC 61966-2-1, and the Bradford matrix D65 -> D50 of ICC.1 annex E.
SRGB_TO_XYZ_D65: Final[Matrix] = np.array(
    [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
)
D65_TO_D50: Final[Matrix] = np.array(
    [[1.047886, 0.022919, -0.050216], [0.029582, 0.990484, -0.017079], [-0.009252, 0.015073, 0.751678]]
)


def srgb_to_linear(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Decode sRGB values in 0..1; the sign is kept."""
    size = np.abs(np.asarray(values, dtype=np.float64))
    linear = np.where(size <= 0.04045, size / 12.92, ((size + 0.055) / 1.055) ** 2.4)
    return np.copysign(linear, values)


@lru_cache(maxsize=8)
def curves_of(transfer: Transfer, icc: bytes | None = None) -> tuple[Curve, Curve, Curve]:
    """Curves of r, g and b. A profile without curves of its own is read as sRGB."""
    codes = np.linspace(0.0, 1.0, CODES)
    if transfer == "linear":
        return (codes.astype(np.float32),) * 3
    if transfer == "icc" and icc is not None and (profile := matrix_profile(icc)) is not None:
        return profile.curves
    return (srgb_to_linear(codes).astype(np.float32),) * 3


def decode(codes: NDArray[np.generic], curve: Curve) -> NDArray[np.float32]:
    """Turn file values (uint8, uint16 or float in 0..1) into linear light."""
    if codes.dtype == np.uint8:
        return curve[::257][codes]
    if codes.dtype == np.uint16:
        return curve[codes]
    values = np.asarray(codes, dtype=np.float32)
    grid = np.linspace(0.0, 1.0, CODES)
    inside = np.interp(values, grid, curve).astype(np.float32)
    return np.where((values < 0) | (values > 1), values, inside)


def inverse(curve: Curve) -> NDArray[np.float32]:
    """Table of file values at the linear light (k / (n - 1))^2: so fine that what was decoded comes back."""
    levels = np.linspace(0.0, 1.0, 4 * CODES) ** 2
    return np.interp(levels, curve, np.linspace(0.0, 1.0, CODES)).astype(np.float32)


def encode(linear: NDArray[np.float32], table: NDArray[np.float32]) -> NDArray[np.float32]:
    """Turn linear light into file values in 0..1 by a table of `inverse`; clipped."""
    clipped = np.clip(linear, 0.0, 1.0)
    np.sqrt(clipped, out=clipped)
    clipped *= np.float32(len(table) - 1)
    clipped += np.float32(0.5)
    return table[clipped.astype(np.int32)]


# --- ICC profiles ------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class MatrixProfile:
    """What a profile of RGB or grey says by three curves and a matrix."""

    curves: tuple[Curve, Curve, Curve]
    to_xyz: Matrix  # (3, 3), linear RGB to XYZ under D50


def icc_space(icc: bytes) -> str:
    """Colour space of a profile: "RGB", "GRAY", "CMYK", ..."""
    return icc[16:20].decode("latin-1").strip()


def is_whole(icc: bytes) -> bool:
    """Whether a profile has all the bytes that it says to have: ICC.1:2022, section 7.2.2."""
    return 128 <= int.from_bytes(icc[:4], "big") <= len(icc) + 3  # the last tag is often not padded


@lru_cache(maxsize=8)
def is_of_rgb(icc: bytes) -> bool:
    """Whether a profile, perhaps one of tables, says what light numbers of RGB stand for."""
    try:
        return is_whole(icc) and icc_space(icc) == "RGB" and len(_to_xyz(np.eye(3), icc, "rgb")) == 3
    except (imagecodecs.CmsError, ValueError):
        return False


@lru_cache(maxsize=8)
def matrix_profile(icc: bytes) -> MatrixProfile | None:
    """Ask LittleCMS for the XYZ of each channel's levels alone; None where the channels do not just add up.

    So it is with profiles of printers and those made of tables, and with nonsense.
    """
    space = {"RGB": "rgb", "GRAY": "gray"}.get(icc_space(icc))
    if space is None or not is_whole(icc):
        return None
    codes = np.linspace(0.0, 1.0, CODES)
    channels = 3 if space == "rgb" else 1
    mixed = np.random.default_rng(0).random((64, channels))
    ramps = np.zeros((channels, CODES, channels))
    for k in range(channels):
        ramps[k, :, k] = codes
    try:
        xyz = _to_xyz(np.concatenate([ramps.reshape(-1, channels), mixed]), icc, space)
    except (imagecodecs.CmsError, ValueError):
        return None
    xyz, of_mixed = xyz[:-64].reshape(channels, CODES, 3), xyz[-64:]
    columns = xyz[:, -1, :].T  # of the full channels
    power = (columns**2).sum(axis=0)
    if not np.isfinite(xyz).all() or power.min() < _LEAST_COLUMN**2:
        return None
    levels = np.einsum("knx,xk->kn", xyz, columns) / power[:, None]
    levels = np.maximum.accumulate(np.clip(levels, 0.0, 1.0), axis=1)
    at = np.stack([np.interp(mixed[:, k], codes, levels[k]) for k in range(channels)], axis=-1)
    if np.abs(at @ columns.T - of_mixed).max() > _ADDITIVE:
        return None
    red, green, blue = np.broadcast_to(levels, (3, CODES)).astype(np.float32)
    to_xyz = columns if channels == 3 else D65_TO_D50 @ SRGB_TO_XYZ_D65
    return MatrixProfile((red, green, blue), to_xyz) if abs(np.linalg.det(to_xyz)) > 1e-6 else None


def _to_xyz(values: NDArray[np.float64], icc: bytes, space: str) -> NDArray[np.float64]:
    """XYZ under D50 of numbers `(value, channel)`, relative colorimetric: white is that of D50."""
    out = imagecodecs.cms_transform(
        values[None],
        icc,
        imagecodecs.cms_profile("xyz"),
        colorspace=space,
        outcolorspace="xyz",
        outdtype=np.float64,
        intent=1,
    )
    return np.asarray(out, dtype=np.float64).reshape(-1, 3)


def linear_profile(to_xyz_d50: Matrix, name: str) -> bytes:
    """Make an ICC profile, version 2, of linear RGB with the given primaries."""

    def xyz(vector: NDArray[np.float64]) -> bytes:
        return b"XYZ \0\0\0\0" + struct.pack(">3i", *(round(float(v) * 65536) for v in vector))

    text = name.encode("ascii")
    description = b"desc\0\0\0\0" + struct.pack(">I", len(text) + 1) + text + b"\0" + bytes(78)
    linear = b"curv\0\0\0\0" + struct.pack(">I", 0)
    tags = {
        b"desc": description,
        b"cprt": b"text\0\0\0\0No copyright, use freely\0",
        b"wtpt": xyz(np.array([0.9642, 1.0, 0.8249])),
        **{name_: xyz(to_xyz_d50[:, k]) for k, name_ in enumerate((b"rXYZ", b"gXYZ", b"bXYZ"))},
        **dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), linear),
    }
    table, body, at = b"", b"", 132 + 12 * len(tags)
    for tag, data in tags.items():
        padded = data + bytes(-len(data) % 4)
        table += tag + struct.pack(">II", at + len(body), len(data))
        body += padded
    size = at + len(body)
    header = struct.pack(">I4sI4s4s4s", size, b"\0" * 4, 0x02400000, b"mntr", b"RGB ", b"XYZ ")
    header += struct.pack(">6H", 2025, 1, 1, 0, 0, 0) + b"acsp" + bytes(28)
    header += struct.pack(">3i", 63190, 65536, 54061) + bytes(48)
    return header + struct.pack(">I", len(tags)) + table + body


def matrix3(matrix: Matrix | None) -> Matrix3 | None:
    """Return a matrix as nested tuples, which are hashable and travel as JSON."""
    return None if matrix is None else cast("Matrix3", tuple(map(tuple, matrix[:3, :3].tolist())))


def camera_to_srgb(xyz_to_camera: Matrix) -> Matrix | None:
    """White-balanced camera RGB to linear sRGB.

    The rows of (XYZ -> camera)(sRGB -> XYZ) are scaled so that white stays white, then
    inverted: D. Coffin's dcraw, function cam_xyz_coeff.
    """
    srgb_to_camera = xyz_to_camera[:3] @ SRGB_TO_XYZ_D65
    sums = srgb_to_camera.sum(axis=1, keepdims=True)
    if not np.isfinite(srgb_to_camera).all() or np.abs(sums).min() < 1e-6:
        return None
    balanced = srgb_to_camera / sums
    return np.linalg.inv(balanced) if abs(np.linalg.det(balanced)) > 1e-6 else None


def named_profile(name: Literal["srgb", "adobergb"]) -> bytes:
    """Return the profile of a standard colour space, of a fixed date: the same bytes each time."""
    icc = imagecodecs.cms_profile(name)
    return icc[:24] + struct.pack(">6H", 2025, 1, 1, 0, 0, 0) + icc[36:]
