"""Checks of a simulated camera: it must stay outside of solids, on one side of the walls of rooms, and see something.

Solids, whose faces look outwards, and rooms, whose faces look inwards, have winding numbers of opposite sign. Open3D's
`RaycastingScene.compute_occupancy` is no replacement: it calls the inside of a room occupied, gets open meshes wrong,
and needs system libraries that bare machines lack.
"""

from __future__ import annotations

from bisect import bisect
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.simulator.sources import RenderedScene

PATH_STEP, MOST_PATH_STEPS = 2_000_000, 10_000
"""Nanoseconds of the trajectory that are taken for a straight line, and the most of these lines."""

LOOK_STEP, MOST_LOOKS = 10_000_000, 1000
"""Nanoseconds from one look at the scene to the next, and the most looks."""

FEWEST_STEPS = 50
"""Fewest lines of the trajectory, and fewest looks."""

PLACES = 20
"""Number of positions at which every surface around the camera is checked. Between them only surfaces that the camera
passes through are checked."""

INSIDE = 0.5
"""Winding number above which a camera is inside. A closed surface has 1 inside and 0 outside."""

SAME_PLACE = 1e-6
"""Part of a line of the trajectory within which two crossings of surfaces are taken for one."""

GRID_BITS = 21
"""Bits of each coordinate of a corner. Corners that are equal in these bits are taken for one."""


def check_view(name: str, what: str, source: RenderedScene, start: int, end: int, notes: list[str]) -> None:
    """Refuses a camera that is inside of a solid, passes through a wall, or never sees a surface.

    Args:
        name: Name of the scene, for errors and notes.
        what: Name of the camera, for errors and notes.
        source: The scene as the camera sees it.
        start, end: Beginning and end of the recording, ns.
        notes: Gets a sentence if there are times at which the camera sees nothing.

    Raises:
        RecordingError: The camera is inside of a closed surface that looks outwards, passes through a closed surface
            that looks inwards, or never sees anything.
    """
    path_times, look_times = (
        np.linspace(start, end, int(np.clip((end - start) // step, FEWEST_STEPS, most)) + 1).astype(np.int64)
        for step, most in ((PATH_STEP, MOST_PATH_STEPS), (LOOK_STEP, MOST_LOOKS))
    )
    _check_outside(name, what, source.renderer.scene.triangles, source.trajectory, path_times)
    _check_sight(name, what, source, look_times, notes)


def _check_outside(name: str, what: str, triangles: np.ndarray, trajectory: Trajectory, times: np.ndarray) -> None:
    """Refuses a camera inside of a solid, or one that passes from inside of a room to outside, or back.

    Inside is decided by the generalised winding number (Jacobson, Kavan, Sorkine-Hornung, SIGGRAPH 2013), which also
    suits surfaces with holes. Each connected part of the triangles has a winding number of its own: inside of a room
    that of the room is -1, so that the sum with a solid's would be 0.
    """
    parts = _Parts(triangles)
    positions = _poses(trajectory, times)[:, :, 3]
    some = np.linspace(0, len(times) - 1, PLACES).astype(int)
    found = [(float(at), part) for at in some for part in parts.around(positions[at])]
    crossings, walls = _crossings(parts, positions), []
    stops = [0.0, *(at for at, _ in crossings), len(times) - 1.0]
    for at, part in crossings:
        before = (at + stops[bisect(stops, at - SAME_PLACE) - 1]) / 2
        after = (at + stops[min(bisect(stops, at + SAME_PLACE), len(stops) - 1)]) / 2
        found.append((after, part))
        ends = [winding_number(parts.corners(part), _position(positions, end)) for end in (before, after)]
        if min(ends) < -INSIDE < max(ends):
            walls.append((at, part))
    for at, part in sorted(found):
        position, corners = _position(positions, at), parts.corners(part)
        if winding_number(corners, position) > INSIDE:
            seconds = (np.interp(at, np.arange(len(times)), times) - times[0]) * 1e-9
            lower, upper = corners.min((0, 1)), corners.max((0, 1))
            raise RecordingError(
                f"{name}: {seconds:.3f} s after the beginning {what} is at {_shown(position)} m, inside of a surface "
                f"that looks outwards and reaches from {_shown(lower)} to {_shown(upper)} m; move the camera or what "
                "it is in, or, if that is a room, turn its faces to look inwards."
            )
    for at, _ in walls:
        seconds = (np.interp(at, np.arange(len(times)), times) - times[0]) * 1e-9
        raise RecordingError(
            f"{name}: {seconds:.3f} s after the beginning {what} passes through a wall, at "
            f"{_shown(_position(positions, at))} m; keep it on one side of it."
        )


def _check_sight(name: str, what: str, source: RenderedScene, times: np.ndarray, notes: list[str]) -> None:
    """Refuses a camera that never sees a surface, and notes when it sees none."""
    blind = np.array([not source.depth(time).any() for time in times.tolist()])
    if blind.all():
        pose = _poses(source.trajectory, times[:1])[0]
        triangles = source.renderer.scene.triangles
        lower, upper = triangles.min((0, 1)), triangles.max((0, 1))
        raise RecordingError(
            f"{name}: {what} never sees anything, since all surfaces lie between {_shown(lower)} and {_shown(upper)} "
            f"m, but at the beginning it is at {_shown(pose[:, 3])} m and looks along {_shown(pose[:, 2])}; move or "
            "turn it."
        )
    if blind.any():
        first = (times[blind][0] - times[0]) * 1e-9
        notes.append(
            f"{name}: {what} sees nothing for {100 * blind.mean():.3g} % of the time, first {first:.3f} s after the "
            "beginning."
        )


def winding_number(corners: Float64[np.ndarray, "faces 3 3"], point: Float64[np.ndarray, "3"]) -> float:
    """The generalised winding number of a point: how many times triangles surround it.

    Sum of the solid angles (van Oosterom and Strackee, 1983) over 4 pi.

    Args:
        corners: In metres, counter-clockwise as seen from outside.
        point: In metres.
    """
    a, b, c = np.moveaxis(corners - point, 1, 0)
    lengths = np.linalg.norm(corners - point, axis=2)
    la, lb, lc = lengths.T
    volume = (a * np.cross(b, c)).sum(1)
    rest = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    return float(np.arctan2(volume, rest).sum() / (2 * np.pi))


class _Parts:
    """The triangles of a scene, by connected part; triangles that share the place of a corner are connected."""

    def __init__(self, triangles: Float32[np.ndarray, "faces 3 3"]):
        corners = triangles.reshape(-1, 3).astype(np.float64)
        grid = (corners - corners.min(0)) * ((2**GRID_BITS - 1) / np.ptp(corners, axis=0).max())
        places = np.rint(grid).astype(np.int64) @ (1 << GRID_BITS * np.arange(3))
        _, vertices = np.unique(places, return_inverse=True)
        first, second, third = vertices.reshape(-1, 3).T
        edges = np.concatenate([first, first]), np.concatenate([second, third])
        _, part = connected_components(coo_array((np.ones(len(edges[0])), edges), shape=2 * (vertices.max() + 1,)))
        part = part[first]
        order = np.argsort(part, kind="stable")
        self.triangles, self.number = corners.reshape(-1, 3, 3)[order], part[order]
        self.starts = np.append(np.flatnonzero(np.diff(self.number, prepend=-1)), len(order))
        self.lower = np.minimum.reduceat(self.triangles.min(1), self.starts[:-1])
        self.upper = np.maximum.reduceat(self.triangles.max(1), self.starts[:-1])

    def corners(self, part: int) -> Float64[np.ndarray, "faces 3 3"]:
        return self.triangles[self.starts[part] : self.starts[part + 1]]

    def around(self, point: Float64[np.ndarray, "3"]) -> list[int]:
        """Numbers of the parts whose bounding box holds a point, which can be inside of no other part."""
        return np.flatnonzero(((self.lower <= point) & (point <= self.upper)).all(1)).tolist()


def _crossings(parts: _Parts, positions: Float64[np.ndarray, "positions 3"]) -> list[tuple[float, int]]:
    """The places where the lines from position to position cross triangles, in order, with the number of the part.

    The place 0.5 is halfway from the first position to the second.
    """
    lower, upper = parts.triangles.min(1), parts.triangles.max(1)
    near = ((lower <= positions.max(0)) & (upper >= positions.min(0))).all(1)
    triangles, number, lower, upper = parts.triangles[near], parts.number[near], lower[near], upper[near]
    crossings = []
    for i, (start, end) in enumerate(pairwise(positions)):
        close = np.flatnonzero(((lower <= np.maximum(start, end)) & (upper >= np.minimum(start, end))).all(1))
        if len(close):
            passed = _passed(triangles[close], start, end)
            there = (passed >= 0) & (passed <= 1)
            crossings += zip((i + passed[there]).tolist(), number[close][there].tolist(), strict=True)
    return sorted(crossings)


def _passed(
    triangles: Float64[np.ndarray, "faces 3 3"], start: Float64[np.ndarray, "3"], end: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, " faces"]:
    """The place where a line crosses each triangle: 0 at the start of the line, 1 at its end; nan where it does not.

    Method of Möller and Trumbore, Journal of Graphics Tools 1997.
    """
    first, direction = triangles[:, 0], end - start
    one, other = triangles[:, 1] - first, triangles[:, 2] - first
    across, offset = np.cross(direction, other), start - first
    turned = np.cross(offset, one)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / (one * across).sum(1)
        u, v = scale * (offset * across).sum(1), scale * (turned @ direction)
        passed = scale * (other * turned).sum(1)
    slack = 1e-9
    return np.where((u >= -slack) & (v >= -slack) & (u + v <= 1 + slack), passed, np.nan)


def _position(positions: Float64[np.ndarray, "positions 3"], at: float) -> Float64[np.ndarray, "3"]:
    """The position at a place, such as 0.5 for halfway from the first position to the second."""
    return np.array([np.interp(at, np.arange(len(positions)), axis) for axis in positions.T])


def _poses(trajectory: Trajectory, times: Int64[np.ndarray, " times"]) -> Float64[np.ndarray, "times 3 4"]:
    return trajectory.poses(torch.from_numpy(times)).numpy()


def _shown(point: np.ndarray) -> str:
    return f"({', '.join(f'{value:.3g}' for value in point)})"
