"""Rows of the scene's extent: the lens, the box, the space beyond it, and the grid within it."""

from __future__ import annotations

import math

from enerf_ns.choices.poses import corrected_recording
from enerf_ns.choices.scene import DATAPARSER, Scene
from enerf_ns.dataparsers.inspection.causes import depth_range_or_cause, why_not_explained
from enerf_ns.dataparsers.scene.depth_range import recording_parallax, share_beyond
from enerf_ns.dataparsers.scene.scene_box import scene_normalisation

SHARE_BEYOND = 0.05
"""Smallest share of the events from beyond the box for which the space there is rendered."""

EVEN_RANGE = 4.0
"""Ratio of depths up to which space is not contracted. A pixel covers more of what is farther, and depth is less exact
there, so that cells and samples of even size are too coarse for what is near, or finer than needed for what is far."""

LARGEST_RESOLUTION = 4096
"""Largest number of cells along the box that is chosen for the finest level of the hash grid."""

MOST_LEVELS = 10
"""Largest number of levels that is chosen for the hash grid."""

SMALLEST_GROWTH = 1.4
"""Smallest factor by which a level of the hash grid is finer than the one before; closer levels hold nearly the
same."""

ENTRIES_BY_ROOT_OF_PIXELS = 2000
"""Entries of each level of the hash grid, divided by the square root of the number of the sensor's pixels. With fewer,
cells that share an entry lose fine detail. With more, a step takes longer, and small sensors gain little."""

SMALLEST_TABLE, LARGEST_TABLE = 17, 20
"""Base-2 logarithms of the smallest and of the largest number of entries that is chosen for a level."""


def undistortion(scene: Scene) -> None:
    """Are rays and frames undistorted?"""
    lens = scene.recording.camera.model
    why = "the calibration states it" if scene.parser.undistort else "set by flag"
    scene.row("undistortion", lens != "pinhole", lens, why, f"{DATAPARSER}.undistort")


def box(scene: Scene) -> None:
    """Where does the scene lie?"""
    name, half_cube = f"{DATAPARSER}.depth_range", scene.use(f"{DATAPARSER}.box", lambda: None)
    scene.use(name, lambda: scene.once(depths))
    near, far = scene.once(depths)
    scene.use("model.near_plane", lambda: near * scene.once(scale))
    if scene.value("model.panorama") and half_cube is None:
        return  # the box holds nothing
    if half_cube is None:
        value = f"depths {near:.2f} m to {far:.2f} m"
        why = "the recording states them" if scene.recording.depth_range else "measured from the events"
        why = scene.why(name, why)
    else:
        name = f"{DATAPARSER}.box"
        value, why = f"cube of {2 * half_cube[3]:g} m", scene.why(name, "")
    scene.row("box", True, value, why, name)


def panorama(scene: Scene) -> None:
    """Does the camera only turn, so that nothing shows how far surfaces are?"""
    name, depths_name = "model.panorama", f"{DATAPARSER}.depth_range"
    is_stated = scene.given(depths_name) is not None or depths_name in scene.preset_values
    parallax = recording_parallax(scene.once(corrected_recording))
    kept = scene.use(name, lambda: parallax.is_ruled_out and not is_stated)
    why = f"the camera only turns: {parallax.why_ruled_out}" if parallax.is_ruled_out else "the camera moves"
    why = scene.why(name, "a depth range is stated" if is_stated else why)
    value = "a scene at infinity: it has no depth and no mesh, and looks the same from every place" * kept
    scene.row("panorama", kept, value, why, name)


def depths(scene: Scene) -> tuple[float, float]:
    """Nearest and farthest depth of the scene, m."""
    stated = scene.value(f"{DATAPARSER}.depth_range")
    if scene.given("model.panorama") and stated is None and scene.recording.depth_range is None:
        return recording_parallax(scene.once(corrected_recording)).panorama_range
    return depth_range_or_cause(scene.once(corrected_recording), stated, scene.recording)


def explainable(scene: Scene) -> None:
    """Can poses, calibration and depth range explain the events? If not, the answer is the `cause`, and no row."""
    if scene.use_events:
        scene.cause = why_not_explained(scene.once(corrected_recording), scene.once(depths), scene.recording) or ""


def scale(scene: Scene) -> float:
    """Units of the network per metre."""
    limits = scene.value(f"{DATAPARSER}.box"), scene.once(contraction_depth)
    return scene_normalisation(scene.recording, *scene.once(depths), *limits)[1]


def contraction_depth(scene: Scene) -> float:
    """Depth from which space is contracted, m; the farthest if the cells of all of the box are of even size."""
    near, far = scene.once(depths)
    is_even = scene.given("model.contraction") is False or scene.value("model.panorama")
    is_even = is_even or scene.value(f"{DATAPARSER}.box") is not None or far <= EVEN_RANGE * near
    end = scene.use(f"{DATAPARSER}.contraction_depth", lambda: None if is_even else EVEN_RANGE * near)
    return far if end is None else min(end, far)


def contraction(scene: Scene) -> None:
    """Does the scene go on beyond the box, or is its depth of so large a range that cells may not be even?"""
    name, (near, far) = "model.contraction", scene.once(depths)
    if scene.value("model.panorama"):
        scene.use(name, lambda: False)
        return
    is_set, end = scene.value(f"{DATAPARSER}.box") is not None, scene.once(contraction_depth)
    share = 0.0 if is_set else share_beyond(scene.once(corrected_recording), (near, far))
    kept = scene.use(name, lambda: share > SHARE_BEYOND or end < far)
    why = f"{100 * share:.1f} % of the events come from beyond {far:.3g} m"
    if end < far:
        why = f"the farthest depth is {far / near:.3g} times the nearest, and {why}"
    depth_name = f"{DATAPARSER}.contraction_depth"
    why = "the box is set" if is_set else why
    why = scene.why(name if scene.given(depth_name) is None else depth_name, why)
    scene.row("contraction", kept, f"space beyond a depth of {end:.3g} m" * kept, why, name)


def hash_grid(scene: Scene) -> None:
    """How fine is the hash grid?"""
    near, end, coarsest = scene.once(depths)[0], scene.once(contraction_depth), scene.config.model.base_res
    distance = 2.0 if scene.value("model.panorama") else math.sqrt(near * end) * scene.once(scale)
    footprint = distance / scene.recording.camera.fx
    finest = 2 ** round(math.log2(2.0 * 2.0 / footprint))
    resolution = scene.use("model.max_res", lambda: min(max(finest, 2 * coarsest), LARGEST_RESOLUTION))
    pixels = scene.recording.camera.width * scene.recording.camera.height
    sought = round(math.log2(ENTRIES_BY_ROOT_OF_PIXELS * math.sqrt(pixels)))
    log2_entries = scene.use("model.log2_table_size", lambda: min(max(sought, SMALLEST_TABLE), LARGEST_TABLE))
    name = "model.num_levels"
    ratio = max(resolution / coarsest, 1.0)
    levels = scene.use(name, lambda: min(1 + round(math.log(ratio) / math.log(SMALLEST_GROWTH)), MOST_LEVELS))
    growth = ratio ** (1 / (levels - 1)) if levels > 1 else 1.0
    why = f"as fine as the sensor's pixels, each level {growth:.2f} times as fine as the one before"
    given = (one for one in ("model.max_res", "model.log2_table_size") if scene.given(one) is not None)
    why = scene.why(next(given, name), why)
    value = f"{levels} levels of 2^{log2_entries} entries, {coarsest} to {resolution} cells"
    scene.row("hash grid", True, value, why, name)
