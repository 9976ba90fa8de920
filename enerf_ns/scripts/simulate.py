"""`enerf simulate`: a recording of an event camera, with frames, depth and poses, of a scene made from a seed."""

from __future__ import annotations

import json
import os
import shutil
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
import torch
import tyro
from rich.console import Console
from rich.progress import track

from enerf_ns.dataparsers.recording import RecordingError
from enerf_ns.dataparsers.trajectory import Trajectory
from enerf_ns.simulator.esim import EventGenerator
from enerf_ns.simulator.render import HAS_EMBREE, Renderer
from enerf_ns.simulator.scenes import SCENES
from enerf_ns.simulator.trajectories import MOTIONS

CONSOLE = Console(width=120)


@dataclass
class Simulate:
    """Simulate a recording of an event camera, in the folder layout of E-NeRF's ESIM sequences."""

    scene: Annotated[Literal["shapes", "carpet"], tyro.conf.Positional]
    """What is seen: a room with boxes and balls, or a plane with lines."""
    output_dir: Path
    """New folder for the recording."""
    motion: Literal["shake", "spiral"] = "shake"
    """How the camera moves: forward-facing with abrupt turns, or an inward spiral."""
    duration: float = 1.0
    """Length of the recording in seconds."""
    num_frames: int = 41
    """Frames, at regular times."""
    exposure_ms: float = 20.0
    """Exposure of the blurred frames in milliseconds, centred at the time of the frame."""
    width: int = 160
    """Of events and frames, in pixels."""
    height: int = 120
    """Of events and frames, in pixels."""
    field_of_view: float = 60.0
    """Horizontal, in degrees."""
    contrast_thresholds: tuple[float, float] = (0.25, 0.25)
    """Change of log brightness that makes an on event, and an off event."""
    log_eps: float = 0.001
    """Added to the brightness, which lies in [0, 1], before its logarithm is taken."""
    max_displacement: float = 0.5
    """Pixels that the picture may move at most from one render to the next."""
    seed: int = 0
    """Draws the textures and the motion."""

    def main(self) -> None:
        output_dir = self.output_dir.expanduser().resolve()
        self._check(output_dir)
        partial = output_dir.with_name(f".{output_dir.name}.partial-{os.getpid()}")
        partial.mkdir(parents=True)
        try:
            summary = self._write(partial)
            if output_dir.exists():
                output_dir.rmdir()
            partial.rename(output_dir)
        except OSError as error:
            raise RecordingError(
                f"{output_dir} could not be written ({error}), and nothing was left there; is the disk full?"
            ) from error
        finally:
            shutil.rmtree(partial, ignore_errors=True)
        CONSOLE.print(f"{summary} are in {output_dir}")

    def _check(self, output_dir: Path) -> None:
        interval_ms = 1000 * self.duration / self.num_frames
        for flag, value, fine, expected in (
            ("--duration", self.duration, self.duration > 0, "seconds above 0"),
            ("--num-frames", self.num_frames, self.num_frames > 10, "at least 11, which the layout needs"),
            ("--exposure-ms", self.exposure_ms, 0 < self.exposure_ms <= interval_ms,
             f"above 0 and at most the time from frame to frame, {interval_ms:.1f} ms"),
            ("--width", self.width, self.width > 0, "pixels above 0"),
            ("--height", self.height, self.height > 0, "pixels above 0"),
            ("--field-of-view", self.field_of_view, 0 < self.field_of_view < 180, "degrees between 0 and 180"),
            ("--contrast-thresholds", self.contrast_thresholds, min(self.contrast_thresholds) > 0, "two above 0"),
            ("--log-eps", self.log_eps, self.log_eps > 0, "above 0"),
            ("--max-displacement", self.max_displacement, self.max_displacement > 0, "pixels above 0"),
        ):  # fmt: skip
            if not fine:
                raise RecordingError(f"{flag} is {value}, but must be {expected}.")
        if output_dir.exists() and (not output_dir.is_dir() or any(output_dir.iterdir())):
            raise RecordingError(
                f"{output_dir} exists already and is not an empty folder; give another --output-dir or move it away."
            )

    def _write(self, folder: Path) -> str:
        """Renders everything into an empty folder and says what is in it."""
        scene_rng, motion_rng = np.random.default_rng(self.seed).spawn(2)
        scene = SCENES[self.scene](scene_rng)
        focal_length = self.width / 2 / np.tan(np.radians(self.field_of_view / 2))
        renderer = Renderer(scene, self.width, self.height, focal_length)

        end = round(self.duration * 1e9)
        trajectory = MOTIONS[self.motion](end, scene.camera, scene.target, motion_rng)
        frame_times = ((np.arange(self.num_frames) + 0.5) * end / self.num_frames).astype(np.int64)
        half_exposure = int(self.exposure_ms * 1e6 / 2)
        opens, closes = frame_times - half_exposure, frame_times + half_exposure
        stops = np.unique(np.concatenate([frame_times, opens, closes, [end]]))
        times = render_times(renderer, trajectory, stops, self.max_displacement)
        poses = trajectory.poses(torch.from_numpy(times)).numpy()

        for name in ("images", "images_corrupted", "events", "depth"):
            (folder / name).mkdir()
        if not HAS_EMBREE:
            CONSOLE.print("embreex is not installed: casting rays without Embree, several times slower.")
        generator: EventGenerator | None = None
        events: list[np.ndarray] = []
        blurred = last = np.zeros((self.height, self.width))
        last_time = 0
        num_events, near, far = 0, np.inf, 0.0
        with ThreadPoolExecutor(2) as threads:
            images = _ahead(threads, renderer.brightness, poses)
            steps = zip(times.tolist(), poses, images, strict=True)
            for time, pose, image in track(steps, f"Simulating {self.scene}", len(times), console=CONSOLE):
                exposing = np.flatnonzero((opens <= last_time) & (time <= closes))
                if exposing.size:
                    blurred = blurred + (last + image) / 2 * (time - last_time)
                    if time == closes[exposing[0]]:
                        _write_image(folder / f"images_corrupted/{exposing[0]:05d}.png", blurred / (2 * half_exposure))
                        blurred = np.zeros_like(blurred)

                log_brightness = np.log(self.log_eps + image)
                if generator:
                    events.append(generator.advance(log_brightness, time))
                frame = int(np.searchsorted(frame_times, time))
                at_frame = frame < self.num_frames and time == frame_times[frame]
                if at_frame:
                    _write_image(folder / f"images/{frame:05d}.png", image)
                    depth = renderer.depth(pose)
                    np.save(folder / f"depth/{frame:05d}.npy", depth)
                    near, far = min(near, depth[depth > 0].min()), max(far, depth.max())
                if at_frame and frame == 0:
                    generator = EventGenerator(log_brightness, time, self.contrast_thresholds)
                elif at_frame or time == end:
                    interval = np.concatenate(events)
                    np.save(folder / f"events/{frame - 1:05d}.npy", interval)
                    num_events += len(interval)
                    events = []
                last, last_time = image, time

        for name in ("images", "images_corrupted"):
            np.savetxt(folder / name / "image_stamps_ns.txt", frame_times, "%d")
        rows = np.column_stack([trajectory.positions, trajectory.quaternions])
        with open(folder / "poses_all.txt", "w") as file:
            file.write("# t_ns px py pz qx qy qz qw\n")
            for time, row in zip(trajectory.times, rows, strict=True):
                file.write(f"{time} {' '.join(map(repr, row.tolist()))}\n")
        frame_poses = trajectory.poses(torch.from_numpy(frame_times)).numpy()
        size = [self.height, self.width, focal_length]
        np.save(folder / "poses_bounds.npy", _llff_rows(frame_poses, size, (near, far)))
        settings = asdict(self)
        del settings["output_dir"]
        principal_point = {"cx": self.width / 2, "cy": self.height / 2}
        camera = {"width": self.width, "height": self.height, "fx": focal_length, "fy": focal_length, **principal_point}
        about = {**settings, "camera": camera, "depth_range": [float(near), float(far)], "num_events": num_events}
        (folder / "simulation.json").write_text(json.dumps(about, indent=2) + "\n")
        return f"{num_events:,} events and {self.num_frames} frames of {self.duration:g} s"


def render_times(renderer: Renderer, trajectory: Trajectory, stops: np.ndarray, max_displacement: float) -> np.ndarray:
    """Times of rendering, so close that no point of the scene moves further than `max_displacement` in between.

    Adds up, from pose to pose of the trajectory, the displacement of the pixel that moves most (of a grid over the
    picture), and divides the sum evenly between two stops.

    Args:
        renderer: of the camera that moves.
        trajectory: its poses.
        stops: int64 [S] nanoseconds, sorted, times to render at in any case.
        max_displacement: pixels.

    Returns:
        int64 [N] nanoseconds, strictly increasing, from the first stop to the last, all stops among them.
    """
    poses = trajectory.poses(torch.from_numpy(trajectory.times)).numpy()
    columns, rows = np.linspace(0, renderer.width - 1, 24), np.linspace(0, renderer.height - 1, 18)
    rays = renderer.rays(*np.meshgrid(columns, rows)).reshape(-1, 3)
    displacement = [0.0]
    for pose, following in pairwise(poses):
        depth = renderer.depth(pose, rays)[:, None]
        world = rays * depth @ pose[:, :3].T + pose[:, 3]
        moved = (world - following[:, 3]) @ following[:, :3]
        shift = renderer.focal_length * (moved[:, :2] / moved[:, 2:] - rays[:, :2])[depth[:, 0] > 0]
        displacement.append(np.linalg.norm(shift, axis=1).max(initial=0))
    travelled = np.cumsum(displacement)
    at_stops = np.interp(stops, trajectory.times, travelled)
    times = [stops]
    for first, second in pairwise(at_stops):
        steps = int(np.ceil((second - first) / max_displacement))
        between = np.linspace(first, second, steps + 1)[1:-1]
        times.append(np.interp(between, travelled, trajectory.times).astype(np.int64))
    return np.unique(np.concatenate(times))


def _ahead(
    threads: ThreadPoolExecutor, render: Callable[[np.ndarray], np.ndarray], poses: np.ndarray
) -> Iterator[np.ndarray]:
    """The pictures of all poses in order, rendered a few ahead of the one that is asked for."""
    pending: deque[Future[np.ndarray]] = deque()
    for pose in poses:
        pending.append(threads.submit(render, pose))
        if len(pending) > 4:
            yield pending.popleft().result()
    while pending:
        yield pending.popleft().result()


def _write_image(path: Path, brightness: np.ndarray) -> None:
    grey = np.round(255 * brightness).clip(0, 255).astype(np.uint8)
    if not cv2.imwrite(str(path), np.repeat(grey[..., None], 3, axis=2)):
        raise RecordingError(f"{path} could not be written; make room on the disk or give another --output-dir.")


def _llff_rows(poses: np.ndarray, size: list[float], bounds: tuple[float, float]) -> np.ndarray:
    """Rows of poses_bounds.npy: [R | t | height width focal] with axes down, right, back, then near and far."""
    axes = np.stack([poses[:, :, 1], poses[:, :, 0], -poses[:, :, 2], poses[:, :, 3]], axis=2)
    sizes = np.broadcast_to(np.array(size)[:, None], (len(poses), 3, 1))
    rows = np.concatenate([axes, sizes], axis=2).reshape(len(poses), 15)
    return np.column_stack([rows, np.broadcast_to(bounds, (len(poses), 2))])
