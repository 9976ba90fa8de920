"""What a trained run shows: scores.json, side-by-side.png, and a flight past its held-out cameras."""

from __future__ import annotations

import io
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.depth_range import scene_depth_range
from enerf_ns.dataparsers.errors import OutputError
from enerf_ns.dataparsers.event_index import event_picture
from enerf_ns.dataparsers.files import write_whole
from enerf_ns.dataparsers.indexing import index_events
from enerf_ns.dataparsers.recording import EventRecording
from enerf_ns.dataparsers.trajectory import Trajectory, evenly_spaced
from enerf_ns.evaluation.runs import Run
from enerf_ns.evaluation.scores import NotScored, summary_scores
from enerf_ns.evaluation.views import HeldOutView, aligned_views, held_out_views

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from nerfstudio.cameras.cameras import Cameras

PICTURE_ROWS = 3
"""Number of held-out frames shown in the picture."""
KEY_POSES = 7
"""Number of held-out cameras that the video flies past."""
VIDEO_SECONDS, VIDEO_FPS = 5.0, 20


def write_report(
    run: Run, output_dir: Path, extra: Mapping[str, float] | None = None
) -> dict[str, float | str | NotScored | None]:
    """Render the held-out frames once and write scores.json and side-by-side.png; then camera_path.json and video.mp4.

    Args:
        run: A trained run.
        output_dir: Made if it does not exist.
        extra: Entries put into scores.json beside the scores.

    Returns:
        What scores.json holds: the `summary_scores`, and the extra entries.

    Raises:
        OutputError: The folder cannot be written to, or the disk is full.
    """
    dataset = run.pipeline.datamanager.eval_dataset
    with _writing_to(output_dir):
        output_dir.mkdir(parents=True, exist_ok=True)
    views, summary = held_out_views(run.pipeline)
    scores = summary_scores(views, summary) | dict(extra or {})
    picture = io.BytesIO()
    side_by_side(aligned_views(views)[0], dataset.recording).savefig(picture, format="png")
    with _writing_to(output_dir):
        write_whole(output_dir / "side-by-side.png", picture.getvalue())
        write_whole(output_dir / "scores.json", json.dumps(scores, indent=2) + "\n")
        write_whole(output_dir / "camera_path.json", json.dumps(camera_path(dataset.cameras)))
        render_video(run, output_dir / "camera_path.json", output_dir / "video.mp4")
    return scores


@contextmanager
def _writing_to(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"--output-dir {folder} could not be written to ({error.strerror}); give another folder."
        ) from error


def side_by_side(views: Sequence[HeldOutView], recording: EventRecording) -> Figure:
    """Frame, render, depth and events of a few held-out frames, side by side.

    Args:
        views: All that there are, at least one, as `aligned_views` gives them.
        recording: Of which the events are. Of held-out frames on a clock of their own, events are not shown.
    """
    from matplotlib.figure import Figure

    titles = ["held-out frame", "render", "depth", *["events"] * (recording.held_out_frames is None)]
    chosen = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, PICTURE_ROWS).round().astype(int))]
    height, width = chosen[0].depth.shape[:2]
    figure = Figure(figsize=(13, 0.3 + 2.95 * len(chosen) * height / width), layout="constrained", dpi=100)
    axes = figure.subplots(len(chosen), len(titles), squeeze=False)
    depths = [depth for view in chosen if len(depth := view.depth[view.depth.isfinite()])]
    near = min((float(depth.quantile(0.01)) for depth in depths), default=0.0)
    far = max((float(depth.quantile(0.99)) for depth in depths), default=1.0)
    for row, view in zip(axes, chosen, strict=True):
        if view.recorded is not None:
            row[0].imshow(view.recorded.clamp(0, 1).numpy())
        row[1].imshow(view.rendered.nan_to_num().clamp(0, 1).numpy())
        depth = row[2].imshow(view.depth[..., 0].numpy(), cmap="turbo", vmin=near, vmax=far)
        if recording.held_out_frames is None:
            row[3].imshow(event_picture(index_events(recording), recording.camera, view.time))
            row[0].set_ylabel(f"{view.time * 1e-9:.2f} s")
        for axis in row:
            axis.set_xticks([])
            axis.set_yticks([])
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title)
    figure.colorbar(depth, ax=axes[:, 2], label="metres", shrink=0.8)
    return figure


def camera_path(cameras: Cameras) -> dict:
    """A smooth flight past some of the cameras, as the viewer saves it and `ns-render camera-path` reads it.

    Cubic through the places of `KEY_POSES` cameras, slerp between their directions, with sides of the picture even, as
    video players want them.
    """
    chosen = np.unique(np.linspace(0, len(cameras) - 1, KEY_POSES).round().astype(int))
    poses = cameras.camera_to_worlds[chosen].double().cpu().numpy()
    if len(poses) == 1:
        poses = np.repeat(poses, 2, axis=0)
    flight = Trajectory(np.arange(len(poses)) * 10**9, poses[:, :, 3], Rotation.from_matrix(poses[:, :, :3]).as_quat())
    times = evenly_spaced(flight.start, flight.end, int(VIDEO_SECONDS * VIDEO_FPS))
    matrices = np.concatenate(
        [flight.poses(torch.from_numpy(times)).numpy(), np.tile([[[0.0, 0.0, 0.0, 1.0]]], (len(times), 1, 1))], axis=1
    )
    height, width = (int(size[0]) // 2 * 2 for size in (cameras.height, cameras.width))
    fov = math.degrees(2.0 * math.atan(0.5 * height / float(cameras.fy[0])))
    return {
        "camera_type": "perspective",
        "render_height": height,
        "render_width": width,
        "fps": VIDEO_FPS,
        "seconds": VIDEO_SECONDS,
        "camera_path": [
            {"camera_to_world": matrix.flatten().tolist(), "fov": fov, "aspect": width / height} for matrix in matrices
        ],
    }


def render_video(run: Run, camera_path_file: Path, output: Path) -> None:
    """Render a flight by `ns-render camera-path`: brightness on the left, depth on the right.

    Depth is coloured from the nearest to the farthest of the scene.

    Args:
        run: A trained run.
        camera_path_file: JSON of a `camera_path`.
        output: The .mp4 file, which is whole afterwards, or as it was before.

    Raises:
        OSError: It cannot be written.
        OutputError: The same, where it is ffmpeg that finds out.
    """
    from nerfstudio.scripts.render import RenderCameraPath

    manager = run.pipeline.datamanager
    near, far = scene_depth_range(manager.eval_dataset.recording, manager.config.dataparser.depth_range)
    scale = manager.train_dataparser_outputs.dataparser_scale
    partial = output.with_name(f".{output.stem}.partial-{os.getpid()}{output.suffix}")
    try:
        RenderCameraPath(
            load_config=run.config_file,
            output_path=partial,
            rendered_output_names=["rgb", "depth"],
            camera_path_filename=camera_path_file,
            depth_near_plane=scale * near,
            depth_far_plane=scale * far,
        ).main()
        partial.replace(output)
    except RuntimeError as error:
        if not str(error).startswith("Error writing"):  # as mediapy says
            raise
        raise OutputError(f"{output} could not be written as a video; make room on the disk.") from error
    finally:
        partial.unlink(missing_ok=True)
