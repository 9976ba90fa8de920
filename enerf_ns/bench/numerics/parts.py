"""Numerical errors of the parts of a trained run, to find the part that limits a result."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Int64
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.evaluation.metrics import psnr
from enerf_ns.evaluation.protocols import DEFAULT_PROTOCOL
from enerf_ns.evaluation.views import aligned_views
from enerf_ns.method.datamanager import DIRECTIONS_NORM
from enerf_ns.method.held_out_poses import rotation_angles
from enerf_ns.method.held_out_views import held_out_views
from enerf_ns.rendering.ray_samplers import PairedProposalSampler
from enerf_ns.sensor.response import linlog, luma
from enerf_ns.supervision.event_supervision import brightness_change

if TYPE_CHECKING:
    from enerf_ns.method.model import EnerfModel
    from enerf_ns.method.runs import Run

SAMPLES = (8, 16, 32, 64, 128, 256, 512)
"""Numbers of samples on each ray whose errors are measured."""

CONVERGED = 2048
"""Number of even samples on each ray of the render that counts as converged."""

NUM_RAYS = 1024
"""Number of random pixels of held-out views that are rendered."""

RAYS_AT_ONCE = 128
"""Number of rays that are rendered at a time."""

NUM_PAIRS = 512
"""Number of event pairs whose changes of log brightness are computed."""

THINNINGS = (2, 4, 8, 16, 32)
"""Factors by which poses are thinned to measure the error of interpolation."""

FEWEST_POSES = 8
"""Least number of poses of a thinned trajectory."""

NUM_VIEWS = 8
"""Most held-out views, evenly chosen, for the error of the brightness fit."""


@dataclass(frozen=True)
class PartError:
    """Numerical error of one part of a run."""

    name: str
    """Name of the part with its setting."""
    compared: str
    """Reference of the comparison."""
    error: float
    """Root mean square error, or PSNR in dB."""
    unit: str
    """Unit of the error."""


def error_of_parts(run: Run) -> list[PartError]:
    """Errors of quadrature, of pose interpolation, of float32 and of the brightness fit of a run.

    Args:
        run: Trained; it is as before afterwards.
    """
    pipeline = run.pipeline
    manager, model = pipeline.datamanager, pipeline.model
    pipeline.eval()
    rays = _random_rays(run)
    rows, distance = _quadrature(model, rays)
    metres = distance / rays.metadata[DIRECTIONS_NORM].cpu() / manager.train_dataparser_outputs.dataparser_scale
    recording = manager.recording
    rows += pose_interpolation(recording.trajectory, recording.stretches, recording.camera, float(metres.median()))
    if "events" in manager.config.supervision:
        rows += _brightness_changes(run)
    if manager.eval_dataset.are_frames:
        rows += _brightness_fit(run)
    pipeline.train()
    return rows


def pose_interpolation(
    trajectory: Trajectory, stretches: Int64[np.ndarray, "stretches 2"], camera: Camera, depth: float
) -> list[PartError]:
    """Errors of poses that are interpolated between the poses of thinned trajectories.

    Args:
        trajectory: All poses.
        stretches: First and last instant (ns) of each used part of the trajectory.
        camera: Camera for errors in pixels, as the motion of points in its whole picture.
        depth: Depth of these points, metres.
    """
    rows = []
    directions = camera.pixel_directions()[:: max(camera.height // 4, 1), :: max(camera.width // 4, 1)].reshape(-1, 3)
    for keep in THINNINGS:
        times = trajectory.times[::keep]
        if len(times) < FEWEST_POSES:
            break
        thinned = Trajectory(times, trajectory.positions[::keep], trajectory.quaternions[::keep])
        left_out = np.flatnonzero(np.arange(len(trajectory.times)) % keep)
        asked = trajectory.times[left_out]
        used = ((asked[:, None] >= stretches[:, 0]) & (asked[:, None] <= stretches[:, 1])).any(axis=1)
        asked = torch.from_numpy(asked[used & thinned.covers(asked)])
        if not len(asked):
            break
        true, found = trajectory.poses(asked).numpy(), thinned.poses(asked).numpy()
        distances = np.linalg.norm(true[..., 3] - found[..., 3], axis=-1)
        points = np.einsum("nij,pj->npi", true[..., :3], depth * directions) + (true[..., 3] - found[..., 3])[:, None]
        seen = np.einsum("nji,npj->npi", found[..., :3], points)
        moved = (seen[..., :2] / seen[..., 2:] - directions[:, :2]) * [camera.fx, camera.fy]
        name = f"pose interpolation, one of {keep} poses"
        for errors, unit in (
            (distances, "m"),
            (np.degrees(rotation_angles(true[..., :3], found[..., :3])), "degrees"),
            (np.linalg.norm(moved, axis=-1), f"pixels at {depth:.3g} m"),
        ):
            rows.append(PartError(name, "the omitted poses", _rms(errors), unit))
    return rows


def _rms(errors: Tensor | np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(np.asarray(errors, np.float64)))))


def _random_rays(run: Run) -> RayBundle:
    """Rays through random pixels of the held-out views."""
    device = run.pipeline.device
    cameras = run.pipeline.datamanager.eval_dataset.cameras
    sizes = len(cameras), int(cameras.height[0]), int(cameras.width[0])
    generator = torch.Generator().manual_seed(0)
    camera, row, column = (torch.randint(size, (NUM_RAYS, 1), generator=generator).to(device) for size in sizes)
    return cameras.to(device).generate_rays(camera, torch.cat([row, column], dim=-1) + 0.5)


@torch.no_grad()
def _rendered(model: EnerfModel, rays: RayBundle) -> tuple[Tensor, Tensor]:
    """Brightness (rays, 3), and distance along each ray in scene units (rays, 1), on the CPU."""
    pieces = [model(rays[start : start + RAYS_AT_ONCE]) for start in range(0, len(rays), RAYS_AT_ONCE)]
    rgb, distance = (torch.cat([outputs[name].cpu() for outputs in pieces]) for name in ("rgb", "depth"))
    return rgb, distance


@contextmanager
def _samples(model: EnerfModel, number: int, even: bool) -> Iterator[None]:
    """Changes the number of samples on each ray of a model within the block.

    Samples are even, or placed as in training, where the samples of the proposal network change in proportion.
    """
    before, proposal = model.sampler, model.proposal
    sampler: Any = copy.copy(before)
    if not isinstance(sampler, PairedProposalSampler):
        sampler.num_samples = number
    elif even:
        sampler = copy.copy(sampler.initial_sampler)
        sampler.num_samples, model.proposal = number, None
    else:
        share = model.config.num_proposal_samples / model.config.num_samples
        sampler.num_proposal_samples_per_ray = (max(1, round(share * number)),)
        sampler.num_nerf_samples_per_ray = number
    model.sampler = sampler
    try:
        yield
    finally:
        model.sampler, model.proposal = before, proposal


def _quadrature(model: EnerfModel, rays: RayBundle) -> tuple[list[PartError], Tensor]:
    """Errors of fewer samples on each ray, and the converged distance along each ray in scene units."""
    with _samples(model, CONVERGED, even=True):
        converged, distance = _rendered(model, rays)
    trained = model.config.num_samples
    settings = [(number, False) for number in sorted({*SAMPLES, trained})] + [(CONVERGED // 2, True)]
    rows = []
    for number, even in settings:
        with _samples(model, number, even):
            rgb, _ = _rendered(model, rays)
        name = f"quadrature, {number} {'even ' if even else ''}samples a ray"
        name += " (as trained)" if number == trained and not even else ""
        levels = [model.sensor.response(luma(picture.double())) for picture in (rgb, converged)]
        score = psnr(rgb, converged)
        if not isinstance(score, str):
            rows.append(PartError(name, f"{CONVERGED} even samples", score, "dB"))
            rows.append(PartError(name, f"{CONVERGED} even samples", _rms(levels[0] - levels[1]), "log brightness"))
    return rows, distance


def _brightness_changes(run: Run) -> list[PartError]:
    """Errors of rendered changes of log brightness of event pairs, in thresholds."""
    manager, model = run.pipeline.datamanager, run.pipeline.model
    sensor = model.sensor
    generator = torch.Generator(run.pipeline.device).manual_seed(0)
    batch = manager.pair_sampler.sample(NUM_PAIRS, generator)
    rays = manager.event_rays(batch, sensor)

    def changes(model: EnerfModel, rays: RayBundle) -> Tensor:
        start, end = _rendered(model, rays)[0].to(batch.pixels.device).reshape(2, NUM_PAIRS, 3)
        return brightness_change(start, end, batch, sensor).double().cpu()

    single = changes(model, rays)
    with _samples(model, CONVERGED, even=True):
        converged = changes(model, rays)
    with _float64():
        wide = RayBundle(
            origins=rays.origins.double(),
            directions=rays.directions.double(),
            pixel_area=rays.pixel_area.double(),
            metadata={name: value.double() for name, value in rays.metadata.items()},
        )
        double = changes(copy.deepcopy(model).double(), wide)
    threshold = torch.as_tensor(sensor.mean_threshold).item()
    return [
        PartError("change of log brightness in float32", "float64", _rms((single - double) / threshold), "thresholds"),
        PartError(
            f"change of log brightness, {model.config.num_samples} samples a ray (as trained)",
            f"{CONVERGED} even samples",
            _rms((single - converged) / threshold),
            "thresholds",
        ),
    ]


@contextmanager
def _float64() -> Iterator[None]:
    """Makes float64 the default type of new tensors within the block."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def _brightness_fit(run: Run) -> list[PartError]:
    """Error that remains after the brightness fit of the default protocol; empty if no view has a fit."""
    number = len(run.pipeline.datamanager.eval_dataset)
    chosen = np.unique(np.linspace(0, number - 1, NUM_VIEWS).round().astype(int)).tolist()
    views, _ = aligned_views(held_out_views(run.pipeline, chosen, evidence=False)[0])
    errors = [
        (linlog(view.rendered.double()) - linlog(view.recorded.double())).flatten()
        for view in views
        if view.recorded is not None and view.not_aligned is None and view.rendered.isfinite().all()
    ]
    if not errors:
        return []
    name = f"brightness after the fit ({DEFAULT_PROTOCOL}, {len(errors)} frames)"
    return [PartError(name, "held-out frames", _rms(torch.cat(errors)), "log brightness")]
