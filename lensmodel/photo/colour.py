"""Transfer curves and colour matrices: file numbers to linear light and back.

A curve is a table of linear light at evenly spaced file values, one entry for each of 65536
codes, so that 8 and 16 bit files are decoded by look-up and encoded by the inverse.

Sources: IEC 61966-2-1:1999 (sRGB); ICC.1:2022 (curve types, section 10.6 and 10.18).
"""

from __future__ import annotations

import math
import struct
from functools import lru_cache
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lensmodel.photo.values import Matrix3, Transfer

CODES: Final = 65536  # of 16 bits
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
    if transfer == "icc" and icc is not None and (curves := icc_curves(icc)):
        return curves
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
    """Table of file values at the linear light (k / (n - 1))^2, for `encode`.

    The square root spreads the dark levels, where curves are steep; n is so large that the
    rounding is below a quarter of a 16-bit code: what was decoded is encoded to the same code.
    """
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


def _tag(icc: bytes, name: bytes) -> bytes:
    if len(icc) < 132:
        return b""
    count = struct.unpack(">I", icc[128:132])[0]
    for k in range(min(count, 100)):
        row = icc[132 + 12 * k : 144 + 12 * k]
        if len(row) == 12 and row[:4] == name:
            at, size = struct.unpack(">II", row[4:])
            return icc[at : at + size]
    return b""


def icc_space(icc: bytes) -> str:
    """Colour space of a profile: "RGB", "GRAY", "CMYK", ..."""
    return icc[16:20].decode("latin-1").strip()


def icc_curves(icc: bytes) -> tuple[Curve, Curve, Curve] | None:
    """Tone curves of a matrix or grey profile; `None` where it has none that can be inverted."""
    names = (b"kTRC",) * 3 if icc_space(icc) == "GRAY" else (b"rTRC", b"gTRC", b"bTRC")
    curves = [_curve(_tag(icc, name)) for name in names]
    if any(curve is None for curve in curves):
        return None
    red, green, blue = (curve for curve in curves if curve is not None)
    return red, green, blue


def _curve(tag: bytes) -> Curve | None:
    x = np.linspace(0.0, 1.0, CODES)
    if tag[:4] == b"curv" and len(tag) >= 12:
        count = struct.unpack(">I", tag[8:12])[0]
        points = np.frombuffer(tag[12 : 12 + 2 * min(count, CODES)], dtype=">u2")
        if len(points) != count:
            return None
        if count == 0:
            y = x
        elif count == 1:
            y = x ** max(points[0] / 256.0, 0.1)
        else:
            y = np.interp(x, np.linspace(0.0, 1.0, count), points / 65535.0)
    elif tag[:4] == b"para" and len(tag) >= 12:
        kind = struct.unpack(">H", tag[8:10])[0]
        size = {0: 1, 1: 3, 2: 4, 3: 5, 4: 7}.get(kind, 0)
        raw = tag[12 : 12 + 4 * size]
        if not size or len(raw) < 4 * size:
            return None
        y = _parametric(x, [v / 65536.0 for v in struct.unpack(f">{size}i", raw)])
    else:
        return None
    y = np.maximum.accumulate(np.clip(np.nan_to_num(y), 0.0, 1.0))
    return y.astype(np.float32) if y[-1] > 0.5 else None


def _parametric(x: NDArray[np.float64], p: list[float]) -> NDArray[np.float64]:
    """Parametric curve of 1, 3, 4, 5 or 7 parameters: y = (a x + b)^g + c, or c x + f below d."""
    g = p[0]
    a, b = (p[1], p[2]) if len(p) > 1 else (1.0, 0.0)
    upper = np.maximum(a * x + b, 0.0) ** g
    if len(p) == 1:
        return upper
    if len(p) == 3:
        return np.where(a * x + b >= 0, upper, 0.0)
    if len(p) == 4:
        return upper + p[3]  # below -b/a the base is 0: y = c
    if len(p) == 5:
        return np.where(x >= p[4], upper, p[3] * x)
    return np.where(x >= p[4], upper + p[5], p[3] * x + p[6])


def icc_to_xyz(icc: bytes) -> Matrix | None:
    """Matrix from the profile's linear RGB to XYZ under D50; `None` where it has none."""
    columns = []
    for name in (b"rXYZ", b"gXYZ", b"bXYZ"):
        tag = _tag(icc, name)
        if len(tag) < 20 or tag[:4] != b"XYZ ":
            return None
        columns.append([v / 65536.0 for v in struct.unpack(">3i", tag[8:20])])
    matrix = np.array(columns).T
    return matrix if abs(np.linalg.det(matrix)) > 1e-6 else None


def linear_profile(to_xyz_d50: Matrix, name: str) -> bytes:
    """Make an ICC profile, version 2, of linear RGB with the given primaries.

    Parameters
    ----------
    to_xyz_d50 : ndarray, shape (3, 3)
        Linear RGB to XYZ under D50.
    name : str
        Shown by programs; ASCII.
    """

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


def matrix3(matrix: Matrix) -> Matrix3:
    """Return a matrix as nested tuples, which are hashable and travel as JSON."""
    a, b, c = (tuple(float(v) for v in row) for row in matrix[:3, :3])
    return (a[0], a[1], a[2]), (b[0], b[1], b[2]), (c[0], c[1], c[2])


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
    return (
        np.linalg.inv(balanced) if abs(np.linalg.det(balanced)) > 1e-6 and math.isfinite(sums.sum()) else None
    )
