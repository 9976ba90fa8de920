"""Cases of the scene: distant origins, gaps of the poses, pure rotation, points beyond the box."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from enerf_ns.bench.numerics.case import case
from enerf_ns.bench.numerics.points import CAMERA, TURNING, noisy, points_between, recording_of_points, shaking
from enerf_ns.bench.numerics.small_run import small_recording
from enerf_ns.dataparsers.event_dataparser import EventDataParserConfig
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.dataparsers.scene.depth_range import measure_parallax, measure_share_beyond
from enerf_ns.events.samplers import EventPairSampler, SilentPixelSampler
from enerf_ns.poses.posed_camera import PosedCamera


def _rays_apart(origin: float) -> float:
    """Largest distance in metres between origins of event rays and Nerfstudio's cameras at the same times."""
    recording = read_recording(small_recording())
    assert recording.frames is not None
    old = recording.trajectory
    moved = Trajectory(old.times, old.positions + origin * np.array([0.6, -0.8, 0.1]), old.quaternions)
    recording = replace(
        recording, trajectory=moved, frames=replace(recording.frames, trajectory=moved), blurred_frames=None
    )
    parser: Any = EventDataParserConfig(data=recording.path).setup()
    outputs = parser.outputs(recording, "train")
    scale, frames = outputs.dataparser_scale, outputs.metadata["frames"]
    camera = PosedCamera(frames.camera, moved, outputs.metadata["transform"], scale)
    times = torch.from_numpy(frames.times)
    rays = camera.rays(torch.zeros_like(times), times)
    return float((rays.origins - outputs.cameras.camera_to_worlds[:, :, 3]).norm(dim=-1).max()) / scale


@case("a world whose origin is 5e6 m away", "event rays from where the frames' cameras are", 1e-5, "m")
def far_world() -> float:
    return max(_rays_apart(origin) for origin in (0.0, 1e4, 1e5, 1e6, 5e6))


@case("two seconds without poses", "no event pair or silent pair begins or ends there", 0, "pairs")
def pose_gap() -> float:
    events, whole, _ = recording_of_points(points_between(1, 3), shaking(0.1), TURNING)
    times = whole.times * 4  # eight seconds, of which two are cut
    known = (times <= 3 * 10**9) | (times >= 5 * 10**9)
    trajectory = Trajectory(times[known], whole.positions[known], whole.quaternions[known])
    events = replace(events, t=events.t * 4)
    recording = EventRecording(Path("memory"), "", CAMERA, trajectory, lambda: iter([events]), ())
    index = EventIndex.from_events(events, CAMERA.width, CAMERA.height)
    stretches, generator = torch.from_numpy(recording.stretches), torch.Generator().manual_seed(0)
    batches = [
        EventPairSampler(index, mode, stretches=stretches).sample(20_000, generator)
        for mode in ("successor", "partner", "window")
    ]
    batches.append(SilentPixelSampler(index, *index.span, 10**6, 10**8, stretches).sample(20_000, generator))
    begin, end = 3 * 10**9, 5 * 10**9
    return sum(
        int(((instants > begin) & (instants < end)).sum()) for batch in batches for instants in (batch.start, batch.end)
    )


@case("a camera that only turns, poses off by 1e-6 to 1e-2 m", "no depth is estimated from noise", 0, "depths")
def rotation() -> float:
    events, still, _ = recording_of_points(points_between(1, 3), np.zeros((2000, 3)), TURNING)
    wrong = 0
    for noise in (1e-6, 1e-4, 1e-3, 1e-2):
        positions = noisy(still.positions, noise, "white", seed=0)
        parallax = measure_parallax(events, CAMERA, Trajectory(still.times, positions, still.quaternions))
        wrong += int(parallax.is_shown or not parallax.is_ruled_out)
    return wrong


@case("60 % of the points at 300 m, the others at 1 to 2 m", "the share of events from beyond the depth range", 0.05)
def beyond() -> float:
    generator = np.random.default_rng(4)
    depths = np.exp(generator.uniform(0.0, np.log(2.0), (400, 1)))
    depths[:240] = 300.0
    points = depths * np.append(generator.uniform(-0.6, 0.6, (400, 2)), np.ones((400, 1)), axis=1)
    events, trajectory, seen = recording_of_points(points, shaking(0.1), TURNING)
    share = measure_share_beyond(events, CAMERA, trajectory, measure_parallax(events, CAMERA, trajectory).depth_range)
    return abs(share - float(np.mean(seen > 100)))
