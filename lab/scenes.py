"""Scenes that hurt, drawn over a photograph in linear light (values above 1 are lamps), and dead leaves."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy import ndimage

from lab.images import middle
from lensmodel.core.types import Planes
from lensmodel.simulate import demo_scene

Scenery: TypeAlias = Callable[[Planes, np.random.Generator], Planes]
Colour: TypeAlias = tuple[float, float, float]
Mask: TypeAlias = NDArray[np.float32]

_OVER: Final = 3  # drawings are made larger by this factor and averaged: sampled by area
_LAMPS: Final[tuple[Colour, ...]] = ((1.0, 0.85, 0.6), (1.0, 0.6, 0.25), (0.7, 0.9, 1.0), (1.0, 0.15, 0.1))
"""Linear light of street lamps: warm white, sodium, cold white and red, chosen."""

# linear sRGB of light to dark skin in daylight (chosen)
_SKIN: Final[tuple[Colour, ...]] = (
    (0.62, 0.36, 0.25), (0.30, 0.16, 0.10), (0.50, 0.28, 0.18),
    (0.70, 0.45, 0.34), (0.14, 0.07, 0.045), (0.42, 0.24, 0.14),
)  # fmt: skip


def photograph_of(name: str, height: int, width: int) -> Planes:
    """Middle of a demo photograph; repeated in mirror image where it is too small."""
    scene = demo_scene(name)
    short = [max(want - have, 0) for have, want in zip(scene.shape[1:], (height, width), strict=True)]
    if any(short):
        scene = np.pad(scene, ((0, 0), *((s // 2, s - s // 2) for s in short)), mode="symmetric")
    return middle(scene, height, width)


def hard_scene(name: str, height: int, width: int, rng: np.random.Generator) -> Planes:
    """One of `HARD_SCENES` over the demo photograph that suits it."""
    return HARD_SCENES[name](photograph_of(_OVER_WHAT.get(name, "city"), height, width), rng)


def lamps(scene: Planes, rng: np.random.Generator) -> Planes:
    """Dusk, with lamps of 1 to 10 pixels, up to thirty times brighter than white."""
    scene = 0.2 * scene
    for _ in range(70):
        radius = float(rng.choice([0.6, 0.9, 1.4, 2.2, 3.5, 6.0, 10.0]))
        disc = _shape(scene, "ellipse", _around(scene, rng, radius, radius))
        colour = rng.uniform(2.0, 30.0) * np.array(_LAMPS[int(rng.integers(len(_LAMPS)))])
        scene = _over(scene, disc, (float(colour[0]), float(colour[1]), float(colour[2])))
    return scene


def red_cars(scene: Planes, rng: np.random.Generator) -> Planes:
    """Glossy red bodies in the sun: red far beyond white, green and blue well below."""
    height, width = scene.shape[1:]
    scene = 0.6 * scene
    for row in (0.2, 0.47, 0.74):
        for col in (0.04, 0.28, 0.52, 0.76):
            left = width * (col + float(rng.uniform(-0.01, 0.01)))
            scene = _car(scene, rng, height * row, left, width / 4.5)
    return scene


def night(scene: Planes, rng: np.random.Generator) -> Planes:
    """A thirtieth of the light, a few windows, and signs that clip; meant for a high ISO."""
    scene = 0.035 * scene
    for _ in range(60):
        half = rng.uniform(1.0, 7.0, 2)
        window = _shape(scene, "rectangle", _around(scene, rng, half[0], half[1]))
        level = float(rng.uniform(0.3, 1.6)) ** 3
        scene = _over(scene, window, (level, 0.75 * level, float(rng.uniform(0.2, 0.8)) * level))
    return scene


def snow(scene: Planes, rng: np.random.Generator) -> Planes:
    """Snow, bright and nearly flat, partly beyond white; dark twigs down to half a pixel."""
    height, width = scene.shape[1:]
    ground = scene.mean(axis=0)
    level = (0.72 + 0.25 * ground / max(float(ground.max()), 1e-6)).astype(np.float32)
    fall = np.linspace(0.9, 1.12, height, dtype=np.float32)[:, None]
    scene = np.stack([level * fall * tint for tint in (0.98, 0.99, 1.02)]).astype(np.float32)
    twigs, pen = _sheet(scene)
    for _ in range(26):
        foot, angle = (rng.uniform(0, width), float(height)), -math.pi / 2 + rng.uniform(-0.5, 0.5)
        _branch(pen, rng, foot, angle, rng.uniform(2.0, 6.0))
    return _over(scene, _averaged(twigs), (0.045, 0.035, 0.028))


def faces(scene: Planes, rng: np.random.Generator) -> Planes:
    """Six faces: smooth shading, pores and freckles of low contrast, lashes and hair."""
    height, width = scene.shape[1:]
    scene = 0.5 * scene
    for k in range(6):
        row, col = height * (0.28 + 0.46 * (k // 3)), width * (0.18 + 0.32 * (k % 3))
        scene = _face(scene, rng, row, col, height / 6.5, _SKIN[k])
    return scene


def foliage(scene: Planes, rng: np.random.Generator) -> Planes:
    """Leaves before the lower half: detail everywhere, long edges nowhere."""
    height, width = scene.shape[1] // 2, scene.shape[2]
    sheet = Image.new("RGB", (width * _OVER, height * _OVER))
    pen = ImageDraw.Draw(sheet)
    for _ in range(9000):
        length, angle = float(rng.uniform(4.0, 26.0)) * _OVER, float(rng.uniform(0.0, math.tau))
        at = rng.uniform((0.0, 0.0), sheet.size)
        tip = at + length * np.array([math.cos(angle), math.sin(angle)])
        side = 0.22 * length * np.array([-math.sin(angle), math.cos(angle)])
        middle = (at + tip) / 2.0
        green = int(rng.uniform(50, 190))
        colour = (int(green * rng.uniform(0.4, 0.9)), green, int(green * rng.uniform(0.2, 0.5)))
        pen.polygon([tuple(p) for p in (at, middle + side, tip, middle - side)], fill=colour)
    leaves = np.asarray(sheet.resize((width, height), Image.Resampling.BOX), dtype=np.float32) / 255.0
    scene = scene.copy()
    scene[:, scene.shape[1] - height :] = leaves.transpose(2, 0, 1) ** np.float32(2.2)
    return scene


def sky(scene: Planes, rng: np.random.Generator) -> Planes:
    """A cloudless sky over three fifths, down to a ragged horizon: a gradient, and nothing else."""
    height, width = scene.shape[1:]
    ragged = ndimage.gaussian_filter1d(rng.normal(size=width), 20.0, mode="wrap")
    horizon = height * (0.6 + 0.04 * ragged / np.abs(ragged).max())
    rows = np.arange(height)[:, None]
    above = np.clip(horizon[None, :] - rows + 0.5, 0.0, 1.0)
    fall = rows / height
    colours = (0.10 + 0.55 * fall, 0.22 + 0.55 * fall, 0.55 + 0.40 * fall)
    planes = [above * c + (1.0 - above) * plane for c, plane in zip(colours, scene, strict=True)]
    return np.stack(planes).astype(np.float32)


def text(scene: Planes, rng: np.random.Generator) -> Planes:
    """A printed page in several sizes, made of random words."""
    height, width = scene.shape[1:]
    over = 2
    page = Image.new("L", (width * over, height * over), 235)
    pen, row = ImageDraw.Draw(page), 8
    while row < page.height:
        size = int(rng.choice([18, 22, 28, 40, 64]))
        font = ImageFont.load_default(size)
        words = (rng.integers(97, 123, rng.integers(2, 10)) for _ in range(400))
        line = " ".join(bytes(word.astype(np.uint8)).decode("ascii") for word in words)
        pen.text((8, row), line[: int(page.width / (0.45 * size))], fill=20, font=font)
        row += int(1.35 * size)
    fine = np.asarray(page, dtype=np.float32).reshape(height, over, width, over).mean(axis=(1, 3)) / 255.0
    return np.ascontiguousarray(np.stack([fine**2.2] * 3), dtype=np.float32)


HARD_SCENES: Final[Mapping[str, Scenery]] = {
    scene.__name__.replace("_", "-"): scene
    for scene in (faces, foliage, lamps, night, red_cars, sky, snow, text)
}

_OVER_WHAT: Final = {"red-cars": "colosseum", "snow": "lake", "sky": "lake"} | dict.fromkeys(
    ("faces", "foliage"), "tea-gardens"
)


def _around(scene: Planes, rng: np.random.Generator, half_rows: float, half_cols: float) -> tuple[float, ...]:
    """Box of a shape of the given half sides at a random place, as Pillow wants it."""
    row, col = (float(rng.uniform(8, n - 8)) for n in scene.shape[1:])
    return col - half_cols, row - half_rows, col + half_cols, row + half_rows


def _sheet(scene: Planes) -> tuple[Image.Image, ImageDraw.ImageDraw]:
    """Room for a drawing over a scene, and a pen."""
    sheet = Image.new("L", (scene.shape[2] * _OVER, scene.shape[1] * _OVER), 0)
    return sheet, ImageDraw.Draw(sheet)


def _shape(scene: Planes, kind: str, box: tuple[float, ...], **more: float) -> Mask:
    """Coverage of a shape of Pillow's over a scene, 0 to 1."""
    sheet, pen = _sheet(scene)
    getattr(pen, kind)(tuple(_OVER * v for v in box), fill=255, **more)
    return _averaged(sheet)


def _averaged(sheet: Image.Image) -> Mask:
    size = sheet.width // _OVER, sheet.height // _OVER
    return np.asarray(sheet.resize(size, Image.Resampling.BOX), dtype=np.float32) / np.float32(255.0)


def _over(scene: Planes, mask: Mask, colour: Colour | Planes) -> Planes:
    """Lay a colour, or a picture, over a scene where the mask says."""
    top = np.asarray(colour, dtype=np.float32)
    if top.ndim == 1:
        top = top[:, None, None]
    return np.ascontiguousarray((1.0 - mask) * scene + mask * top, dtype=np.float32)


def _car(scene: Planes, rng: np.random.Generator, top: float, left: float, length: float) -> Planes:
    """One car from the side: body with a glossy gradient, glass, wheels, seams and a glint."""
    size = scene.shape[1], scene.shape[2]
    tall = 0.34 * length
    body = np.maximum(
        _shape(scene, "rounded_rectangle", (left, top + 0.4 * tall, left + length, top + tall), radius=24.0),
        _shape(scene, "ellipse", (left + 0.18 * length, top, left + 0.8 * length, top + 1.1 * tall)),
    )
    gloss = np.clip((np.arange(size[0])[:, None] - top) / tall, 0.0, 1.0)
    red = (float(rng.uniform(2.6, 4.2)) - 1.6 * gloss) * np.ones(size)
    green = 0.05 + 0.05 * (1.0 - gloss) * np.ones(size)
    scene = _over(scene, body, np.stack([red, green, 0.6 * green]).astype(np.float32))
    glass = (left + 0.3 * length, top + 0.12 * tall, left + 0.68 * length, top + 0.38 * tall)
    scene = _over(scene, _shape(scene, "rounded_rectangle", glass, radius=12.0), (0.03, 0.04, 0.06))
    for at in (0.2, 0.78):
        middle = left + at * length
        wheel = (middle - 0.09 * length, top + 0.72 * tall, middle + 0.09 * length, top + 1.25 * tall)
        scene = _over(scene, _shape(scene, "ellipse", wheel), (0.02, 0.02, 0.022))
    for at in (0.34, 0.52, 0.66):
        edge = left + at * length
        seam = (edge, top + 0.42 * tall, edge + rng.uniform(0.4, 1.5), top + 0.95 * tall)
        scene = _over(scene, _shape(scene, "rectangle", seam), (0.25, 0.02, 0.02))
    glint = (left + 0.1 * length, top + 0.47 * tall, left + 0.9 * length, top + 0.485 * tall)
    return _over(scene, _shape(scene, "rectangle", glint), (6.0, 4.5, 4.0))


def _branch(
    pen: ImageDraw.ImageDraw,
    rng: np.random.Generator,
    at: tuple[float, float],
    angle: float,
    thickness: float,
) -> None:
    """Draw a twig and what grows from it, ever thinner down to half a pixel."""
    x, y = at
    for _ in range(int(rng.integers(5, 10))):
        angle += float(rng.normal(0.0, 0.18))
        length = float(rng.uniform(10.0, 28.0))
        end = x + length * math.cos(angle), y + length * math.sin(angle)
        pen.line([_OVER * v for v in (x, y, *end)], fill=255, width=max(round(_OVER * thickness), 1))
        x, y = end
        if thickness > 0.5 and rng.random() < 0.55:
            _branch(pen, rng, (x, y), angle + float(rng.choice([-0.7, 0.7])), 0.6 * thickness)
        thickness = max(0.92 * thickness, 0.34)


def _face(
    scene: Planes, rng: np.random.Generator, row: float, col: float, radius: float, skin: Colour
) -> Planes:
    """One face with hair, eyes, mouth and a skin that has pores."""
    size = scene.shape[1], scene.shape[2]
    wide = 0.76 * radius
    hair = (col - 1.15 * wide, row - 1.2 * radius, col + 1.15 * wide, row + 0.75 * radius)
    scene = _over(scene, _shape(scene, "ellipse", hair), (0.03, 0.02, 0.015))
    strands, pen = _sheet(scene)
    for _ in range(160):
        start = rng.uniform(-1.15, 1.15) * wide + col, row + rng.uniform(-1.25, 0.3) * radius
        end = start[0] + rng.normal(0.0, 8.0), start[1] + rng.uniform(15.0, 50.0)
        pen.line([_OVER * v for v in (*start, *end)], fill=200, width=1)
    scene = _over(scene, _averaged(strands), (0.16, 0.10, 0.06))
    rows = (np.arange(size[0])[:, None] - row) / radius
    cols = (np.arange(size[1])[None, :] - col) / wide
    shade = np.clip(1.08 - 0.35 * rows * rows - 0.45 * (cols + 0.3) ** 2, 0.25, None)
    pores = ndimage.gaussian_filter(rng.normal(size=size), 0.9) * 0.06
    freckles = ndimage.gaussian_filter((rng.random(size) < 0.004).astype(np.float64), 1.1) * 1.6
    texture = shade * (1.0 + pores - freckles)
    skin_plane = np.stack([np.clip(texture, 0.05, None) * c for c in skin]).astype(np.float32)
    oval = _shape(scene, "ellipse", (col - wide, row - radius, col + wide, row + radius))
    scene = _over(scene, oval, skin_plane)
    for side in (-1.0, 1.0):
        x, y = col + 0.38 * side * wide, row - 0.15 * radius
        white = (x - 0.17 * wide, y - 0.055 * radius, x + 0.17 * wide, y + 0.055 * radius)
        scene = _over(scene, _shape(scene, "ellipse", white), (0.75, 0.72, 0.7))
        for share, colour in ((0.065, (0.10, 0.06, 0.03)), (0.03, (0.005, 0.005, 0.005))):
            r = share * radius
            scene = _over(scene, _shape(scene, "ellipse", (x - r, y - r, x + r, y + r)), colour)
        glint = (x + 1.0, y - 2.5, x + 2.6, y - 0.9)
        scene = _over(scene, _shape(scene, "ellipse", glint), (1.3, 1.3, 1.3))
        lashes, pen = _sheet(scene)
        for t in np.linspace(-1.0, 1.0, 14):
            foot = x + 0.17 * wide * t, y - 0.055 * radius * math.sqrt(max(1.0 - t * t, 0.0))
            lash = [_OVER * v for v in (*foot, foot[0] + 3.0 * t, foot[1] - 5.0)]
            pen.line(lash, fill=255, width=_OVER // 2)
        brow = (x - 0.22 * wide, y - 0.2 * radius, x + 0.22 * wide, y - 0.1 * radius)
        pen.arc([_OVER * v for v in brow], 190, 350, fill=230, width=2 * _OVER)
        scene = _over(scene, _averaged(lashes), (0.02, 0.015, 0.01))
    mouth = (col - 0.33 * wide, row + 0.42 * radius, col + 0.33 * wide, row + 0.56 * radius)
    lips = (0.9 * skin[0] + 0.05, 0.5 * skin[1], 0.55 * skin[2])
    scene = _over(scene, _shape(scene, "ellipse", mouth), lips)
    line = (col - 0.32 * wide, row + 0.487 * radius, col + 0.32 * wide, row + 0.487 * radius + 1.2)
    return _over(scene, _shape(scene, "rectangle", line), (0.08, 0.02, 0.02))


def dead_leaves(
    height: int, width: int, rng: np.random.Generator, *, smallest: float = 1.5, largest: float = 150.0
) -> Planes:
    """Discs that cover one another, radii with density ~ r^-3, 0.02..0.95, averaged over the pixels.

    Source: A. B. Lee, D. Mumford, J. Huang, "Occlusion models for natural images", IJCV 41, 2001.
    """
    size = (height * _OVER, width * _OVER)
    canvas = np.zeros((*size, 3), dtype=np.float32)
    empty = np.ones(size, dtype=bool)
    # painted from the front: a leaf shows where nothing lies yet
    for _ in range(200_000):
        if not empty.any():
            break
        # by inversion of the distribution of r^-3
        radius = float((smallest**-2 - rng.random() * (smallest**-2 - largest**-2)) ** -0.5) * _OVER
        row, col = rng.uniform(-radius, size[0] + radius), rng.uniform(-radius, size[1] + radius)
        colour = _leaf_colour(rng)
        top, left = max(int(row - radius), 0), max(int(col - radius), 0)
        bottom, right = min(int(row + radius) + 2, size[0]), min(int(col + radius) + 2, size[1])
        if bottom <= top or right <= left:
            continue
        free = empty[top:bottom, left:right]
        if not free.any():
            continue
        dr, dc = np.arange(top, bottom)[:, None] - row, np.arange(left, right)[None, :] - col
        leaf = free & (dr * dr + dc * dc <= radius * radius)
        canvas[top:bottom, left:right][leaf] = colour
        free[leaf] = False
    canvas[empty] = _leaf_colour(rng)
    fine = canvas.reshape(height, _OVER, width, _OVER, 3)
    return np.ascontiguousarray(fine.mean(axis=(1, 3)).transpose(2, 0, 1))


def _leaf_colour(rng: np.random.Generator) -> NDArray[np.float32]:
    grey = rng.uniform(0.05, 0.9)
    return np.clip(grey * rng.uniform(0.75, 1.25, 3), 0.02, 0.95).astype(np.float32)
