"""Measurements of a finished run: scores of held-out frames, depth errors, the cost of a step."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from enerf_ns.bench.experiments import NEAR
from enerf_ns.evaluation.lpips import Net
from enerf_ns.evaluation.metrics import depth_rmse
from enerf_ns.evaluation.scores import NotScored, mean_scores
from enerf_ns.evaluation.views import HeldOutView, aligned_views, save_pictures
from enerf_ns.method.event_dataset import EventDataset
from enerf_ns.method.held_out_views import expected_brightness_scale, held_out_views
from enerf_ns.method.memory import kept_bytes
from enerf_ns.method.pipeline import EnerfPipeline
from enerf_ns.method.runs import Run
from enerf_ns.method.stopwatch import seconds_of
from enerf_ns.sensor.sensor_model import SensorModel
from enerf_ns.simulator.event_sensor import SensorSettings

REPEATS = 9
"""Number of timings of each part of a step, of which the median is taken."""

TRUTH = "truth.json"
"""Name of the file with the settings of the simulation, in a recording that does not state its sensor."""

VIEW = "view"
"""Folder in that of a run, with eval_img_0000.png: a held-out frame beside the render, aligned by the first
protocol."""

ProtocolScores = dict[str, dict[str, float]]
"""Scores by protocol."""


def evaluate(
    run: Run, protocols: Sequence[str], measures: Sequence[str], nets: Sequence[Net] = ("alex",)
) -> tuple[ProtocolScores, dict[str, NotScored]]:
    """Scores of a run. A picture of its middle held-out frame beside the render is stored in its folder `VIEW`.

    Args:
        run: Trained run.
        protocols: Names of protocols.
        measures: Names of `MEASURES`, whose values are added to the scores of each protocol.
        nets: Networks of LPIPS.

    Returns:
        By protocol, mean scores over held-out frames with the values of the measures, ms_a_step and, if depths are
        known, depth_rmse_all_poses (metres); and by protocol, the missing scores with their reasons.
    """
    views, _ = held_out_views(run.pipeline)
    added = _depth_rmse_all_poses(run.pipeline, views) | {"ms_a_step": milliseconds_a_step(run)}
    for name in measures:
        added |= MEASURES[name](run, views)
    shown = aligned_views(views, protocols[0])[0][len(views) // 2]
    save_pictures([shown], run.config_file.parent / VIEW)
    scores, not_scored = {}, {}
    for protocol in protocols:
        means, not_scored[protocol] = mean_scores(views, False, protocol, nets)
        scores[protocol] = means | added
    return scores, not_scored


def _depth_rmse_all_poses(pipeline: EnerfPipeline, views: Sequence[HeldOutView]) -> dict[str, float]:
    """Mean depth error in metres over all held-out and training poses; nothing for a panorama."""
    dataset = pipeline.datamanager.train_dataset
    if pipeline.model.config.panorama:
        return {}
    pairs = [(view.depth, view.recorded_depth) for view in views]
    if dataset.are_frames and dataset.frames.depth_filenames is not None:
        pairs += [(_depth(pipeline, dataset, index), dataset[index]["depth"]) for index in range(len(dataset))]
    errors = [depth_rmse(depth, recorded) for depth, recorded in pairs if depth is not None and recorded is not None]
    known = [error for error in errors if not isinstance(error, str)]
    return {"depth_rmse_all_poses": float(np.mean(known))} if known else {}


@torch.no_grad()
def _depth(pipeline: EnerfPipeline, dataset: EventDataset, index: int) -> torch.Tensor:
    """Rendered depth (height, width, 1) at the pose of a frame, in metres along the optical axis, on the CPU."""
    pipeline.eval()
    rays = dataset.cameras[index : index + 1].to(pipeline.device).generate_rays(camera_indices=0, keep_shape=True)
    depth = pipeline.model.get_outputs_for_camera_ray_bundle(rays)["depth"] / rays.metadata["directions_norm"]
    return (depth / pipeline.datamanager.train_dataparser_outputs.dataparser_scale).cpu()


def _near_depth(run: Run, views: Sequence[HeldOutView]) -> dict[str, float]:
    """Median depth error in metres of near surfaces in the unbounded scene."""
    errors = []
    for view in views:
        assert view.depth is not None and view.recorded_depth is not None
        near = (view.recorded_depth > 0) & (view.recorded_depth < NEAR[1])
        errors.append((view.depth - view.recorded_depth)[near].abs())
    return {"near_depth_error": float(torch.cat(errors).median())}


def _memory(run: Run, views: Sequence[HeldOutView]) -> dict[str, float]:
    """Megabytes that a step keeps for its backward pass, plus parameters, gradients and moments of Adam."""
    run.pipeline.train()
    kept = kept_bytes(lambda: run.pipeline.get_train_loss_dict(0)[1], run.pipeline.model)
    parameters = sum(parameter.nbytes for parameter in run.pipeline.model.parameters())
    return {"megabytes_a_step": (kept + 4 * parameters) / 1e6}


def _step(run: Run, views: Sequence[HeldOutView]) -> dict[str, float]:
    """Shares of a training step in percent: sampling of events, their poses, other work on rays, pixels of frames, and
    the remaining forward and backward pass."""
    manager, sensor = run.pipeline.datamanager, run.pipeline.model.sensor
    supervision = manager.config.supervision
    parts: dict[str, float] = dict.fromkeys(("sample", "poses", "rays", "images"), 0.0)
    learnt_from: dict[str, Literal["events", "frames"]] = {"sample": "events", "images": "frames"}
    for part, name in learnt_from.items():
        if name in supervision:
            manager.config.supervision = name
            parts[part] = _milliseconds(lambda: manager.next_batch(sensor), run)
    manager.config.supervision = supervision
    batch = manager.next_batch(sensor)
    if batch.events is not None:
        times = torch.cat([batch.events.start, batch.events.end])
        parts["poses"] = _milliseconds(lambda: manager.event_camera.trajectory.poses(times), run)
    parts["rays"] = _milliseconds(lambda: manager.rays(batch, sensor), run) - parts["poses"]
    step = milliseconds_a_step(run)
    shares = {part: 100.0 * value / step for part, value in parts.items()}
    return shares | {"forward_and_backward": 100.0 - sum(shares.values())}


def _sensor(run: Run, views: Sequence[HeldOutView]) -> dict[str, float]:
    """Sensor parameters and brightness scale of the run, with the true or expected values as true_NAME, and the
    correlation of its threshold map with the true thresholds of the pixels."""
    sensor, recording = run.pipeline.model.sensor, run.config.data
    assert recording is not None
    simulated = SensorSettings(**json.loads((recording / TRUTH).read_text())["sensor"])
    on, off = (torch.as_tensor(threshold).mean().item() for threshold in sensor.contrast_thresholds)
    found = {
        "contrast_threshold_on": on,
        "contrast_threshold_off": off,
        "threshold_ratio": on / off,
        "refractory_ms": 1e-6 * torch.as_tensor(sensor.refractory_period).item(),
    }
    found |= {"leak_rate": torch.as_tensor(sensor.leak_rate).item(), "cutoff_frequency": sensor.cutoff_frequency}
    true_on, true_off = simulated.contrast_thresholds
    truth = {
        "contrast_threshold_on": true_on,
        "contrast_threshold_off": true_off,
        "threshold_ratio": true_on / true_off,
        "refractory_ms": 1e-6 * simulated.refractory_period,
        "leak_rate": simulated.leak_rate,
        "cutoff_frequency": simulated.cutoff_frequency or math.inf,
    }
    scale = aligned_views(views)[1].get("brightness_scale")
    if scale is not None:
        found["brightness_scale"] = scale
        truth["brightness_scale"] = expected_brightness_scale(simulated.contrast_thresholds, sensor)
    return found | _map_correlation(sensor, recording) | {f"true_{name}": truth[name] for name in found}


def _map_correlation(sensor: SensorModel, recording: Path) -> dict[str, float]:
    """Correlation over pixels for each polarity; empty if the sensor has no map or all pixels have one threshold."""
    thresholds, found = recording / "thresholds.npy", sensor.threshold_map
    if found is None or not thresholds.exists():
        return {}
    pairs = zip(("on", "off"), found.deviations.T.cpu().numpy(), np.load(thresholds), strict=True)
    return {f"threshold_map_{name}": float(np.corrcoef(a.ravel(), b.ravel())[0, 1]) for name, a, b in pairs if a.std()}


def _events(run: Run, views: Sequence[HeldOutView]) -> dict[str, float]:
    """Available scores over held-out events, and the brightness scale."""
    found = {name: float(score) for name, score in run.pipeline.event_scores().items() if not isinstance(score, str)}
    scale = aligned_views(views)[1].get("brightness_scale")
    return found if scale is None else {**found, "brightness_scale": float(scale)}


def milliseconds_a_step(run: Run) -> float:
    """Mean time of a training step, ms."""
    assert run.train_seconds is not None
    return 1e3 * run.train_seconds / run.config.max_num_iterations


def _milliseconds(call: Callable[[], object], run: Run) -> float:
    """Median wall time of a call in ms, after one warm-up call."""
    times = [seconds_of(call, run.pipeline.device) for _ in range(REPEATS + 1)]
    return 1e3 * statistics.median(times[1:])


MEASURES: dict[str, Callable[[Run, Sequence[HeldOutView]], dict[str, float]]] = {
    "near_depth": _near_depth,
    "memory": _memory,
    "step": _step,
    "sensor": _sensor,
    "events": _events,
}
"""Measurements that can be added to scores, by name."""
