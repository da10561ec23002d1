"""Transfer curves, colour matrices and ICC profiles: file numbers to linear light and back.

Sources: IEC 61966-2-1:1999 (sRGB); ICC.1:2022.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal, TypeAlias

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from lensmodel.photo.values import Transfer

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
    """Curves of r, g and b; of a profile that cannot be read those of sRGB."""
    codes = np.linspace(0.0, 1.0, CODES)
    if transfer == "icc" and (profile := read_profile(icc)) is not None:
        return profile.curves
    return ((codes if transfer == "linear" else srgb_to_linear(codes)).astype(np.float32),) * 3


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
class Profile:
    """What a profile of RGB or grey says of light."""

    curves: tuple[Curve, Curve, Curve]  # those of sRGB where the profile is made of tables
    to_xyz: Matrix | None  # (3, 3), linear RGB to XYZ under D50; None where channels do not just add up


@lru_cache(maxsize=8)
def read_profile(icc: bytes | None) -> Profile | None:
    """Ask LittleCMS for the XYZ of each channel's levels alone; None for nonsense, and colours of prints."""
    space = {b"RGB ": "rgb", b"GRAY": "gray"}.get((icc or b"")[16:20])
    # ICC.1:2022, section 7.2.2; the last tag is often not padded
    if icc is None or space is None or not 128 <= int.from_bytes(icc[:4], "big") <= len(icc) + 3:
        return None
    codes = np.linspace(0.0, 1.0, CODES)
    channels = 3 if space == "rgb" else 1
    mixed = np.random.default_rng(0).random((64, channels))
    ramps = np.einsum("n,kc->knc", codes, np.eye(channels)).reshape(-1, channels)
    try:  # relative colorimetric: white is that of D50
        found = imagecodecs.cms_transform(
            np.concatenate([ramps, mixed])[None],
            icc,
            imagecodecs.cms_profile("xyz"),
            colorspace=space,
            outcolorspace="xyz",
            outdtype=np.float64,
            intent=1,
        )[0]
    except (imagecodecs.CmsError, ValueError):
        return None
    xyz, of_mixed = found[:-64].reshape(channels, CODES, 3), found[-64:]
    columns = xyz[:, -1, :].T  # of the full channels
    power = (columns**2).sum(axis=0)
    levels = np.einsum("knx,xk->kn", xyz, columns) / np.maximum(power, _LEAST_COLUMN**2)[:, None]
    levels = np.maximum.accumulate(np.clip(levels, 0.0, 1.0), axis=1)
    at = np.stack([np.interp(mixed[:, k], codes, levels[k]) for k in range(channels)], axis=-1)
    to_xyz = columns if channels == 3 else D65_TO_D50 @ SRGB_TO_XYZ_D65
    additive = np.abs(at @ columns.T - of_mixed).max() <= _ADDITIVE
    if not additive or power.min() < _LEAST_COLUMN**2 or abs(np.linalg.det(to_xyz)) < 1e-6:
        return Profile(curves_of("srgb"), None) if channels == 3 else None
    red, green, blue = np.broadcast_to(levels, (3, CODES)).astype(np.float32)
    return Profile((red, green, blue), to_xyz)


def named_profile(name: Literal["srgb", "adobergb"]) -> bytes:
    """Return the profile of a colour space."""
    return _dated(imagecodecs.cms_profile(name))


def _dated(icc: bytes) -> bytes:
    """Give a profile a fixed date: the same bytes each time."""
    return icc[:24] + struct.pack(">6H", 2025, 1, 1, 0, 0, 0) + icc[36:]


def linear_profile(to_xyz_d50: Matrix) -> bytes:
    """Make an ICC profile of linear RGB: that of other primaries, with the given ones in their place."""
    xyy_of_d50, xyy = (0.3457, 0.3585, 1.0), (0.64, 0.33, 1.0, 0.3, 0.6, 1.0, 0.15, 0.06, 1.0)
    other = imagecodecs.cms_profile("rgb", gamma=1.0, whitepoint=xyy_of_d50, primaries=xyy)
    icc = bytearray(_dated(other))
    table = icc[132 : 132 + 12 * int.from_bytes(icc[128:132], "big")]
    for name, at, _ in struct.iter_unpack(">4sII", table):
        if name in {b"rXYZ", b"gXYZ", b"bXYZ"}:
            column = to_xyz_d50[:, b"rgb".index(name[:1])]
            icc[at + 8 : at + 20] = np.rint(65536.0 * column).astype(">i4").tobytes()
    return bytes(icc)


def camera_to_srgb(xyz_to_camera: Matrix) -> Matrix | None:
    """White-balanced camera RGB to linear sRGB, white staying white: D. Coffin's dcraw, cam_xyz_coeff."""
    srgb_to_camera = xyz_to_camera[:3] @ SRGB_TO_XYZ_D65
    sums = srgb_to_camera.sum(axis=1, keepdims=True)
    if not np.isfinite(srgb_to_camera).all() or np.abs(sums).min() < 1e-6:
        return None
    balanced = srgb_to_camera / sums
    return np.linalg.inv(balanced) if abs(np.linalg.det(balanced)) > 1e-6 else None
