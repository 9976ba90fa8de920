"""Rows of the rays: their samples, their opacity, the viewing direction, and their number."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from enerf_ns.choices.events import hides_changes
from enerf_ns.choices.extent import depths
from enerf_ns.choices.poses import corrected_recording
from enerf_ns.choices.scene import Scene, path_extent
from enerf_ns.dataparsers.scene.edge_depth import edge_depth
from enerf_ns.events.statistics import border_rate

SILENT_BORDER = 0.02
"""Share of a sensor's mean events a pixel below which its border is silent, as around an object before nothing."""

MANY_EDGES = 0.05
"""Share of the pixels with an edge of known depth above which a field starts from edges. Of recordings with fewer,
pictures lose by such a start (benchmarks/README.md, start from edges)."""

SEEN_AROUND = math.radians(30)
"""Angle (rad) over which the middle of the scene must be seen before gloss is looked for. Over a smaller angle, gloss
looks like texture."""

SMALLEST_GAIN = 0.02
"""Smallest share by which a part must lower the error of held-out pairs to be kept."""

Probe = Callable[[Any], "tuple[float, float]"]  # Any: the class of the config stands above this room
"""Measures what a part of the model gains. For a config in which all but that part is decided, it returns the share by
which the part lowers the error of held-out pairs, and the standard error of that share."""


def proposal_network(scene: Scene) -> None:
    """Where are rays sampled?"""
    model, (near, far), name = scene.config.model, scene.once(depths), "model.sampling"
    if scene.value("model.panorama"):
        scene.use(name, lambda: "uniform")
        return
    nearness = 1 / near - (0.0 if scene.value("model.contraction") else 1 / far)
    disparity = scene.recording.camera.fx * path_extent(scene.recording) * nearness
    # also for a small disparity: even samples lost 2 to 5 dB at 11 pixels
    sampling = scene.use(name, lambda: "proposal")
    value = f"{model.num_proposal_samples} + {model.num_samples} samples a ray"
    if sampling == "uniform":
        value = f"{model.num_samples} samples a ray, evenly spaced"
    why = f"the path moves the nearest point by {disparity:.0f} pixels against the farthest"
    scene.row("proposal network", sampling == "proposal", value, scene.why(name, why), name)


def opacity_loss(scene: Scene) -> None:
    """Does every ray meet a surface?"""
    name = "model.opacity_loss_weight"
    why, before_nothing = "the field learns from frames alone", False
    if scene.use_events:
        share = border_rate(scene.index, scene.recording.camera.height)
        before_nothing = share < SILENT_BORDER
        what = "an object before nothing" if before_nothing else "rays meet surfaces there too"
        why = f"pixels at the sensor's border fired {share:.2g} times as often as the others: {what}"
    weight = scene.use(name, lambda: 0.0 if before_nothing else 1.0)
    scene.row("opacity loss", bool(weight), f"weight {weight:g}" if weight else "", scene.why(name, why), name)


def edge_start(scene: Scene) -> None:
    """Does the field start from the depth of edges that events show before training?"""
    name = "model.edge_start"
    if not scene.use_events or scene.value("model.panorama"):
        scene.use(name, lambda: False)
        return
    kept, why = False, ""
    if scene.use_frames:
        why = "frames show surfaces, too"
    elif scene.once(hides_changes):
        why = "blind pixels miss edges"
    elif scene.given(name) is None:
        share = scene.once(edge_share)
        kept, why = share > MANY_EDGES, f"{100 * share:.1f} % of the pixels see an edge of known depth"
    kept = scene.use(name, lambda: kept)
    scene.row("start from edges", kept, "", scene.why(name, why), name)


def edge_share(scene: Scene) -> float:
    """Share of the pixels with an edge of known depth, a mean over views along the trajectory; 0 without a view."""
    views = edge_depth(scene.once(corrected_recording), scene.once(depths))
    return float(np.mean([np.count_nonzero(view.depth) / view.depth.size for view in views])) if views else 0.0


def view_direction(scene: Scene, probe: Probe | None) -> None:
    """Does brightness depend on the direction from which a point is seen?"""
    near, far = scene.once(depths)
    width = 2.0 * math.atan(0.5 * path_extent(scene.recording) / math.sqrt(near * far))
    name = "model.view_direction"
    why, kept = f"the camera goes {math.degrees(width):.0f} degrees around the scene", False
    if scene.given(name) is None:
        if width < SEEN_AROUND:
            why += ", too little to distinguish gloss from texture"
        elif probe is None:
            why += ", but no short training measured the gain"
        else:
            gain, error = probe(scene.resolved())
            kept = gain > max(SMALLEST_GAIN, 2.0 * error)
            why += f", and it lowers the error of held-out pairs by {100 * gain:.1f} ± {100 * error:.1f} %"
    kept = scene.use(name, lambda: kept)
    scene.row("view direction", kept, "", scene.why(name, why), name)


def larger_batch(scene: Scene, batch_factor: Callable[[Any], int]) -> None:
    """Do more rays fit into a step, if neither the user nor a preset nor the paper sets their number?"""
    numbers = ("event_pairs", "instant_pairs", "silent_pairs", "train_num_rays_per_batch")
    names = [f"datamanager.{name}" for name in numbers]
    chosen = [name for name in names if name in scene.values and name not in scene.preset_values]
    if scene.defaults.whole_preset or chosen != names:
        return
    factor = batch_factor(scene.resolved())
    if factor > 1:
        scene.values |= {name: factor * scene.values[name] for name in names}
        value = f"{factor} times the pairs and rays of the method"
        scene.row("larger batch", True, value, "a step takes hardly longer with them", names[0])
