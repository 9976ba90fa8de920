"""Procedural textures, drawn by a generator: square, grey or R G B, with levels from 0 (darkest) to 1 (brightest)."""

from __future__ import annotations

import string
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Float32
from matplotlib import get_data_path
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw, ImageFont
from scipy import fft
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d

SIZE = 1024
"""Texels along one side of a texture, unless its function states another size."""
TEXELS_PER_METRE = 256
EXTENT = SIZE / TEXELS_PER_METRE
"""Metres after which a texture of `SIZE` texels repeats."""

Colour = Sequence[float]
"""Red, green and blue, each from 0 to 255."""


def plain() -> np.ndarray:
    """A texture of one texel with level 1."""
    return np.ones((1, 1), np.float32)


def clouds(rng: np.random.Generator, coarsest: float = 1.0, finest: float = 0.1) -> np.ndarray:
    """Noise with a 1/f spectrum between two wavelengths in metres; all grey levels are equally frequent."""
    frequency = np.hypot(*np.meshgrid(*2 * [np.fft.fftfreq(SIZE) * TEXELS_PER_METRE]))
    band = np.where((frequency >= 1 / coarsest) & (frequency <= 1 / finest), 1.0, 0.0)
    spectrum = np.fft.fft2(rng.standard_normal((SIZE, SIZE))) * band / np.maximum(frequency, 1e-6)
    noise = np.fft.ifft2(spectrum).real
    levels = np.empty(noise.size, np.float32)
    levels[np.argsort(noise, axis=None)] = np.linspace(0, 1, noise.size)
    return levels.reshape(noise.shape)


def mosaic(rng: np.random.Generator, cell: float = 0.2) -> np.ndarray:
    """Square tiles of `cell` metres, each with a random grey level."""
    texels = round(cell * TEXELS_PER_METRE)
    tiles = rng.uniform(size=2 * [-(-SIZE // texels)])
    return np.kron(tiles, np.ones((texels, texels)))[:SIZE, :SIZE].astype(np.float32)


def bricks(rng: np.random.Generator, width: float = 0.5, height: float = 0.25, joint: float = 0.03) -> np.ndarray:
    """Bricks of random grey levels with dark joints, every second row shifted by half a brick."""
    w, h, j = (round(x * TEXELS_PER_METRE) for x in (width, height, joint))
    image = np.zeros((SIZE, SIZE), np.float32)
    for row, top in enumerate(range(0, SIZE, h)):
        for left in range(-(row % 2) * w // 2, SIZE, w):
            image[top : top + h - j, max(left, 0) : max(left + w - j, 0)] = rng.uniform(0.3, 1)
    return image


def lines(rng: np.random.Generator, count: int = 30, background: float = 0.35) -> np.ndarray:
    """Straight bright and dark strokes of random width, as roads on a map."""
    image = np.full((SIZE, SIZE), background, np.float32)
    for _ in range(count):
        ends = rng.integers(-SIZE // 4, SIZE + SIZE // 4, (2, 2))
        grey, width = float(rng.choice([0.0, 0.7, 1.0])), int(rng.integers(8, 32))
        for shift in np.ndindex(3, 3):  # strokes that leave at one border enter at the opposite one
            start, end = ends + SIZE * (np.array(shift) - 1)
            cv2.line(image, start.tolist(), end.tolist(), (grey,), width, cv2.LINE_AA)
    return image


def text(rng: np.random.Generator, line_height: float = 0.2, background: float = 1.0) -> np.ndarray:
    """Rows of random capital letters, dark on bright."""
    image = np.full((SIZE, SIZE), background, np.float32)
    step = round(line_height * TEXELS_PER_METRE)
    for baseline in range(step, SIZE + step, step):
        row = "".join(rng.choice(list(string.ascii_uppercase + "   "), 64))
        cv2.putText(image, row, (-8, baseline), cv2.FONT_HERSHEY_SIMPLEX, 0.028 * step, (0.0,), step // 8, cv2.LINE_AA)
    return image


def roads(rng: np.random.Generator) -> Float32[np.ndarray, "2048 2048 3"]:
    """The map of a town, in colour, which repeats after `EXTENT` metres.

    It has streets of four widths with centre lines and crossings, blocks of houses and gardens, parks, and a river with
    bridges.
    """
    cells, steps = 6, 24
    town = _Map(np.empty((4096, 4096, 3), np.uint8))
    nodes = np.stack(np.meshgrid(*2 * [np.arange(cells) + 0.5], indexing="ij"), -1)
    nodes = (nodes + rng.uniform(-0.22, 0.22, nodes.shape)) * EXTENT / cells
    streets = [_closed_curve(nodes[:, j], (EXTENT, 0), steps) for j in range(cells)]
    avenues = [_closed_curve(nodes[i], (0, EXTENT), steps) for i in range(cells)]

    for i, j in np.ndindex(cells, cells):
        columns, rows = slice(i * steps, (i + 1) * steps + 1), slice(j * steps, (j + 1) * steps + 1)
        next_street = streets[(j + 1) % cells] + (0, EXTENT * (j + 1 == cells))
        next_avenue = avenues[(i + 1) % cells] + (EXTENT * (i + 1 == cells), 0)
        top, bottom = streets[j][columns], next_street[columns]
        left, right = avenues[i][rows], next_avenue[rows]
        corners = np.stack([top[[0, -1]], bottom[[0, -1]]])
        draw_block = _draw_park if rng.uniform() < 0.3 else _draw_houses
        draw_block(town, np.concatenate([top, right, bottom[::-1], left[::-1]]), corners, rng)

    bends = rng.uniform(0.2, 0.8) + np.cumsum(rng.uniform(-0.12, 0.12, 5))
    river = _closed_curve(np.column_stack([np.arange(5) / 5, bends]) * EXTENT, (EXTENT, 0), 40)
    for width, colour in ((0.42, (196, 184, 140)), (0.37, (62, 112, 152)), (0.24, (78, 134, 176))):
        town.stroke(river, width, colour)

    kinds = np.concatenate([rng.permutation([0, 1, 1, 2, 2, 3]), rng.permutation([0, 0, 1, 1, 2, 3])])
    widths = np.array([0.04, 0.075, 0.11, 0.17])[kinds]
    asphalt = [(140, 136, 130), (98, 98, 102), (74, 74, 80), (54, 54, 62)]
    lines, from_wide_to_narrow = [*streets, *avenues], np.argsort(widths, kind="stable")
    for line in from_wide_to_narrow:
        town.stroke(lines[line], float(widths[line]) + 0.026, (212, 206, 194))
    for line in from_wide_to_narrow:
        town.stroke(lines[line], float(widths[line]), asphalt[kinds[line]])
    for line in range(2 * cells):
        across = widths[cells:] if line < cells else widths[:cells]
        _draw_markings(town, lines[line], float(widths[line]), across, steps)
    picture = cv2.resize(town.pixels, (2048, 2048), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    wear = cv2.resize(clouds(rng, 0.5, 0.02), (2048, 2048), interpolation=cv2.INTER_LINEAR)
    return picture * (0.85 + 0.15 * wear[..., None])


@dataclass(frozen=True)
class _Map:
    """A canvas of EXTENT x EXTENT metres. Drawings that leave it at one border enter at the opposite border."""

    pixels: np.ndarray
    """Texels of the canvas, uint8 [size, size, 3]."""

    def area(self, corners: np.ndarray, colour: Colour) -> None:
        """Fills a polygon with corners [N, 2], metres."""
        for points in self._copies(corners, 0):
            cv2.fillPoly(self.pixels, [points], colour)

    def stroke(self, points: np.ndarray, width: float, colour: Colour) -> None:
        """Draws a line along points [N, 2]; points and width in metres."""
        for copy in self._copies(points, width):
            cv2.polylines(self.pixels, [copy], False, colour, max(self._texels(width), 1))

    def disc(self, centre: np.ndarray, radius: float, colour: Colour) -> None:
        for (point,) in self._copies(centre[None], 2 * radius):
            cv2.circle(self.pixels, point.tolist(), self._texels(radius), colour, cv2.FILLED)

    def _copies(self, points: np.ndarray, width: float) -> Iterator[np.ndarray]:
        """Those of nine copies of a drawing, each shifted by EXTENT, that touch the canvas, in texels."""
        for shift in np.ndindex(3, 3):
            moved = points + EXTENT * (np.array(shift) - 1)
            if (moved.max(0) > -width).all() and (moved.min(0) < EXTENT + width).all():
                yield np.round(moved * len(self.pixels) / EXTENT).astype(np.int32)

    def _texels(self, metres: float) -> int:
        return round(metres * len(self.pixels) / EXTENT)


def _closed_curve(points: np.ndarray, period: tuple[float, float], steps: int) -> np.ndarray:
    """A smooth line [N * steps + 1, 2] through points [N, 2] that repeats after N points, shifted by `period`."""
    knots = np.arange(len(points) + 1)
    drift = np.outer(knots, period) / len(points)
    offsets = np.concatenate([points, points[:1]]) - drift
    offsets[-1] = offsets[0]
    at = np.arange(len(points) * steps + 1) / steps
    return CubicSpline(knots, offsets, bc_type="periodic")(at) + np.outer(at, period) / len(points)


def _inside(corners: np.ndarray, across: ArrayLike, down: ArrayLike) -> np.ndarray:
    """Points [..., 2] of a block with corners [2 (down), 2 (across), 2], at fractions of its width and height."""
    across, down = np.asarray(across)[..., None], np.asarray(down)[..., None]
    top, bottom = ((1 - across) * corners[row, 0] + across * corners[row, 1] for row in (0, 1))
    return (1 - down) * top + down * bottom


def _draw_park(town: _Map, outline: np.ndarray, corners: np.ndarray, rng: np.random.Generator) -> None:
    town.area(outline, (104, 152, 84))
    for _ in range(3):
        town.disc(_inside(corners, *rng.uniform(0.2, 0.8, 2)), rng.uniform(0.05, 0.13), (128, 172, 98))
    if rng.uniform() < 0.5:
        middle, angles = _inside(corners, *rng.uniform(0.35, 0.65, 2)), np.linspace(0, 2 * np.pi, 40)
        wobble = 0.1 + 0.02 * np.cos(2 * angles + rng.uniform(0, 6)) + 0.015 * np.cos(3 * angles + rng.uniform(0, 6))
        pond = middle + wobble[:, None] * np.stack([np.cos(angles), 0.7 * np.sin(angles)], -1)
        town.area(pond, (72, 128, 170))
    ends = rng.uniform(0.2, 0.8, 4)
    shares = np.linspace(0, 1, 30)
    bend = 0.15 * np.sin(np.pi * shares)
    for path in (
        _inside(corners, shares, ends[0] + (ends[1] - ends[0]) * shares + bend),
        _inside(corners, ends[2] + (ends[3] - ends[2]) * shares - bend, shares),
    ):
        town.stroke(path, 0.022, (214, 200, 160))
    for _ in range(rng.integers(25, 60)):
        _draw_tree(town, _inside(corners, *rng.uniform(0.04, 0.96, 2)), rng)


def _draw_tree(town: _Map, centre: np.ndarray, rng: np.random.Generator) -> None:
    radius, green = rng.uniform(0.01, 0.028), int(rng.integers(84, 126))
    town.disc(centre + 0.3 * radius, radius, (58, 84, 50))
    town.disc(centre, radius, (green - 44, green, green - 50))
    town.disc(centre - 0.3 * radius, 0.45 * radius, (green - 24, green + 24, green - 34))


def _draw_houses(town: _Map, outline: np.ndarray, corners: np.ndarray, rng: np.random.Generator) -> None:
    """Draws rows of plots. Most have a house with a roof that is darker on one side; the others have trees."""
    town.area(outline, [(206, 192, 160), (176, 184, 140), (196, 196, 192)][rng.integers(3)])
    columns, rows = rng.integers(2, 6, 2)
    for column, row in np.ndindex(columns, rows):
        left, right = 0.1 + 0.8 * (column + np.array([0.04, 0.96])) / columns
        top, bottom = 0.1 + 0.8 * (row + np.array([0.04, 0.96])) / rows
        if rng.uniform() < 0.6:
            town.area(_inside(corners, [left, right, right, left], [top, top, bottom, bottom]), (142, 174, 108))
        if rng.uniform() < 0.15:
            for _ in range(4):
                _draw_tree(town, _inside(corners, rng.uniform(left, right), rng.uniform(top, bottom)), rng)
            continue
        inset = rng.uniform(0.06, 0.3, 4) * [right - left, left - right, bottom - top, top - bottom]
        west, east, north, south = np.add(inset, [left, right, top, bottom])
        roof = np.array([(176, 74, 54), (196, 104, 66), (132, 66, 56), (122, 126, 136), (214, 202, 186), (92, 98, 112)])
        colour = roof[rng.integers(len(roof))] * rng.uniform(0.85, 1.1)
        shadow = np.array([0.006, 0.008])
        house = _inside(corners, [west, east, east, west], [north, north, south, south])
        town.area(house + shadow, (84, 84, 76))
        town.area(house, colour.tolist())
        ridge = (north + south) / 2
        town.area(_inside(corners, [west, east, east, west], [ridge, ridge, south, south]), (0.72 * colour).tolist())


def _draw_markings(town: _Map, line: np.ndarray, width: float, across: np.ndarray, steps: int) -> None:
    """Draws the centre line and the edge lines of a street, and zebra crossings before each street that it meets.

    The widths of the streets that it meets are `across`, in metres.
    """
    travelled = np.append(0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1)))
    along = np.linspace(0, travelled[-1], round(travelled[-1] / 0.004))
    points = np.stack([np.interp(along, travelled, line[:, axis]) for axis in (0, 1)], -1)
    ahead = np.gradient(points, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    aside = ahead[:, ::-1] * (-1, 1)
    met = travelled[::steps]
    free = (np.abs(along[:, None] - met) > np.append(across, across[0]) / 2 + 0.07).all(1)
    white, yellow = (232, 232, 226), (222, 184, 72)

    def dashes(offset: float, stroke: float, colour: Colour, drawn: np.ndarray) -> None:
        pieces = np.split(np.arange(len(along)), np.flatnonzero(np.diff(drawn)) + 1)
        for piece in pieces:
            if drawn[piece[0]]:
                town.stroke(points[piece] + offset * aside[piece], stroke, colour)

    if width > 0.15:
        for offset in (-0.006, 0.006):
            dashes(offset, 0.005, yellow, free)
        for offset in (-0.04, 0.04):
            dashes(offset, 0.004, white, free & (along % 0.08 < 0.04))
    elif width > 0.05:
        dashes(0, 0.005, white, free & (along % 0.06 < 0.03))
    if width > 0.1:
        for offset in (-width / 2 + 0.01, width / 2 - 0.01):
            dashes(offset, 0.004, white, free)
    if width > 0.05:
        for crossing, other in zip(met[:-1], across, strict=True):
            for side in (-1, 1):
                index = np.argmin(np.abs(along - (crossing + side * (other / 2 + 0.04)) % travelled[-1]))
                for offset in np.arange(-width / 2 + 0.012, width / 2 - 0.006, 0.017):
                    middle = points[index] + offset * aside[index]
                    town.stroke(np.stack([middle - 0.017 * ahead[index], middle + 0.017 * ahead[index]]), 0.008, white)


def wood(rng: np.random.Generator) -> np.ndarray:
    """Boards of 0.25 metres with the grain along x."""
    along_the_grain = {"axis": 1, "mode": "wrap"}
    warp = uniform_filter1d(clouds(rng, 2.0, 0.08), 200, **along_the_grain)
    grain = uniform_filter1d(rng.uniform(size=(SIZE, SIZE)), 61, **along_the_grain)
    board = np.arange(SIZE) // 64
    rings = np.sin(2 * np.pi * (np.arange(SIZE) / 22 + rng.uniform(0, 9, 16)[board])[:, None] + 14 * warp)
    tone = rng.uniform(0.5, 0.8, 16)[board][:, None]
    image = tone + 0.1 * rings + 0.9 * (grain - 0.5)
    image[np.arange(SIZE) % 64 < 2] *= 0.4
    return image.clip(0, 1).astype(np.float32)


SENTENCES = (
    "A pixel speaks only when its light has changed.",
    "What does not move is not seen, and what moves fast is seen best.",
    "Between two frames a camera is blind; between two events nothing happened.",
    "The brighter the edge and the faster the hand, the more events a second.",
    "Every event is a short line: where, when, and whether brighter or darker.",
    "Read this from a metre away while the camera shakes.",
    "The quick brown fox jumps over the lazy dog.",
    "Sphinx of black quartz, judge my vow.",
    "Pack my box with five dozen liquor jugs.",
    "How vexingly quick daft zebras jump!",
    "Numbers: 0 1 2 3 4 5 6 7 8 9, 3.14159, 2.71828, 1.41421.",
    "A logarithm turns shares into steps.",
)


def page(rng: np.random.Generator) -> Float32[np.ndarray, "2048 2048"]:
    """A printed page, to be shown 4 wide by 3 high: title, alphabet, columns of text in six sizes, and an eye chart."""
    fonts = Path(get_data_path()) / "fonts" / "ttf"
    width, height = 2732, 2049
    image = Image.new("L", (width, height), 255)
    draw = ImageDraw.Draw(image)

    def font(name: str, size: float) -> ImageFont.FreeTypeFont:
        return ImageFont.truetype(str(fonts / f"{name}.ttf"), size)

    def paragraph(left: float, top: float, right: float, bottom: float, name: str, size: float) -> None:
        """Draws sentences in random order, as many lines as fit."""
        face, line, space = font(name, size), "", 1.3 * size
        words = " ".join(rng.permutation(np.tile(SENTENCES, 12))).split()
        for word in words:
            if top + space > bottom:
                return
            if draw.textlength(f"{line} {word}", face) > right - left:
                draw.text((left, top), line, 0, face)
                line, top = word, top + space
            else:
                line = f"{line} {word}".strip()

    draw.rectangle((24, 24, width - 25, height - 25), outline=0, width=10)
    draw.text((width / 2, 150), "EVENTS & FRAMES", 0, font("DejaVuSans-Bold", 190), "mm")
    draw.line((90, 265, width - 90, 265), 0, 8)
    for middle, letters in ((340, string.ascii_uppercase), (450, string.ascii_lowercase)):
        draw.text((width / 2, middle), " ".join(letters), 0, font("DejaVuSans", 92), "mm")
    draw.text((width / 2, 550), "0123456789 +-*/= (.,;:!?) @#%&", 0, font("DejaVuSansMono", 92), "mm")
    draw.line((90, 620, width - 90, 620), 0, 5)
    for left, right, sizes in ((90, 960, (64, 48, 36)), (1010, 1880, (42, 30, 22))):
        tops = np.linspace(650, height - 70, len(sizes) + 1)
        for top, bottom, size in zip(tops[:-1], tops[1:], sizes, strict=True):
            paragraph(left, top, right, bottom - 20, "DejaVuSerif", size)
    draw.line((1930, 650, 1930, height - 90), 0, 4)
    top = 670.0
    for size in (210, 150, 110, 80, 60, 46, 36, 26, 18):
        letters = "".join(rng.choice(list("CDEFHKLNOPRSTUVZ"), min(2 + round(170 / size), 14)))
        draw.text((2300, top + size / 2), " ".join(letters), 0, font("DejaVuSans-Bold", size), "mm")
        top += 1.35 * size
    for row, column in np.ndindex(4, 10):
        if (row + column) % 2:
            x, y = 2050 + 50 * column, 1760 + 50 * row
            draw.rectangle((x, y, x + 49, y + 49), 0)
    return square(np.asarray(image, np.float32)[..., None] / 255, 2048)[..., 0]


MOON_EXTENT = 6.0
"""Metres after which the textures of `moon` repeat."""


def moon(
    rng: np.random.Generator,
) -> tuple[Float32[np.ndarray, "2048 2048"], Float32[np.ndarray, "2048 2048"]]:
    """Heights in metres and brightness of a landscape of craters; downwards in both arrays is the direction -y.

    The number of craters decreases with the square of their radius. Between them the ground is fractal, with boulders.
    The sun stands 24 degrees above the horizon in the direction of -x and casts shadows.
    """
    size = 2048
    cell = MOON_EXTENT / size
    frequency = np.hypot(fft.rfftfreq(size, cell), fft.fftfreq(size, cell)[:, None])
    spectrum = np.asarray(fft.rfft2(rng.standard_normal((size, size), np.float32)))
    rough = np.asarray(fft.irfft2(spectrum * np.maximum(frequency, 0.5).astype(np.float32) ** -2.15))
    heights = (0.03 * (rough - rough.mean()) / rough.std()).astype(np.float32)

    def around(centre: np.ndarray, radius: float, reach: float) -> tuple[tuple, np.ndarray]:
        """Indices of the texels within `reach` radii of a centre, and their distance from it in radii.

        The outline of large circles is ragged.
        """
        half = int(np.ceil(reach * radius / cell))
        offsets = np.arange(-half, half + 1)
        column, row = np.floor(centre / cell).astype(int)
        shift = offsets * cell / radius
        distance = np.hypot(shift, shift[:, None])
        if half < 20:  # its outline is too small to be visible
            return np.ix_((row + offsets) % size, (column + offsets) % size), distance
        angle = np.arctan2(shift[:, None], shift)
        waves, phases = rng.uniform(0, 0.06, 3), rng.uniform(0, 2 * np.pi, 3)
        ragged = 1 + sum(wave * np.cos((k + 2) * angle + phases[k]) for k, wave in enumerate(waves))
        return np.ix_((row + offsets) % size, (column + offsets) % size), distance * ragged

    radii = np.sort((0.012 / np.sqrt(rng.uniform(size=6500))).clip(max=0.65))[::-1]
    for radius in radii:
        texels, distance = around(rng.uniform(0, MOON_EXTENT, 2), radius, 2.7)
        fresh = rng.uniform(0.15, 1) ** 1.3
        depth, rim = 0.36 * radius * fresh, 0.1 * radius * fresh
        ground = heights[texels]
        bowl = (depth + rim) * distance**2 - depth
        blanket = rim * np.maximum(distance, 1) ** -3 * (1 - ((distance - 1) / 1.2).clip(0, 1) ** 2)
        ground += 0.7 * fresh * (ground.mean() - ground) * (1 - distance).clip(0, 1)
        heights[texels] = ground + np.where(distance < 1, bowl, blanket)
    for radius in (0.007 / np.sqrt(rng.uniform(size=180))).clip(max=0.05):
        texels, distance = around(rng.uniform(0, MOON_EXTENT, 2), radius, 1.3)
        heights[texels] += 0.7 * radius * (1 - distance**2).clip(0)

    slope_x = (np.roll(heights, -1, 1) - np.roll(heights, 1, 1)) / (2 * cell)
    slope_y = (np.roll(heights, 1, 0) - np.roll(heights, -1, 0)) / (2 * cell)
    lit = np.zeros_like(heights)
    for elevation in np.radians([23.3, 24.0, 24.7]):
        twice = np.tile(heights, 2) + (np.arange(2 * size) * cell * np.tan(elevation)).astype(np.float32)
        lit += (twice >= np.maximum.accumulate(twice, axis=1))[:, size:] / 3
    sun = np.radians(24)
    facing = (np.sin(sun) + np.cos(sun) * slope_x) / np.sqrt(1 + slope_x**2 + slope_y**2)
    soil = cv2.resize(clouds(rng, 1.5, 0.015), (size, size), interpolation=cv2.INTER_LINEAR)
    brightness = (0.8 + 0.4 * soil) * (0.035 + 0.85 * lit * facing.clip(0) ** 0.8)
    return heights, brightness.clip(0, 1).astype(np.float32)


class Procedural(NamedTuple):
    """A texture that scene files know by name: its function, and how it lies on a surface."""

    make: Callable[[np.random.Generator], np.ndarray]
    """Function that draws the texture, float32 [size, size] or [size, size, 3]."""
    extent: float | None
    """Metres after which the texture repeats; None if it is stretched once over each side of a part."""
    brightness: tuple[float, float]
    """Default linear brightness of the levels 0 and 1."""


PROCEDURAL = {
    "plain": Procedural(lambda _: plain(), EXTENT, (0.15, 0.9)),
    "clouds": Procedural(clouds, EXTENT, (0.15, 0.9)),
    "mosaic": Procedural(mosaic, EXTENT, (0.15, 0.9)),
    "bricks": Procedural(bricks, EXTENT, (0.15, 0.9)),
    "lines": Procedural(lines, EXTENT, (0.15, 0.9)),
    "text": Procedural(text, EXTENT, (0.15, 0.9)),
    "wood": Procedural(wood, EXTENT, (0.15, 0.9)),
    "page": Procedural(page, None, (0.15, 0.9)),
    "roads": Procedural(roads, EXTENT, (0, 1)),
    "moon": Procedural(lambda rng: moon(rng)[1], MOON_EXTENT, (0, 1)),
}
"""Textures by their names in scene files."""


def square(image: Float[np.ndarray, "height width channels"], size: int) -> Float32[np.ndarray, "size size channels"]:
    """An image of any size, stretched to size x size.

    Sides that shrink are averaged over areas; sides that grow are interpolated linearly.
    """
    height, width, channels = image.shape
    small = cv2.resize(image.astype(np.float32), (min(width, size), min(height, size)), interpolation=cv2.INTER_AREA)
    return cv2.resize(small, (size, size), interpolation=cv2.INTER_LINEAR).reshape(size, size, channels)


def mip_pyramid(image: Float[np.ndarray, "size size channels"]) -> Float32[np.ndarray, "texels channels"]:
    """All levels of a texture, finest first. Each level holds the means of 2 x 2 texels of the level before.

    Args:
        image: Finest level; `size` is a power of two.

    Returns:
        (4 * size**2 - 1) / 3 texels. The level of n x n texels starts at row 4 * (size**2 - n**2) / 3.
    """
    levels = [image.astype(np.float32)]
    while len(levels[-1]) > 1:
        half = len(levels[-1]) // 2
        levels.append(levels[-1].reshape(half, 2, half, 2, -1).mean((1, 3)))
    return np.concatenate([level.reshape(-1, image.shape[2]) for level in levels])
