"""`enerf report`: scores, picture and video of a trained run."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import torch
import tyro
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.indexing import index_events
from enerf_ns.dataparsers.trajectory import Trajectory

if TYPE_CHECKING:
    from enerf_ns.enerf_pipeline import EnerfPipeline, HeldOutView

PICTURE_ROWS = 3
"""Held-out frames shown in the picture."""
KEY_POSES = 7
"""Held-out cameras that the video flies past."""
VIDEO_SECONDS, VIDEO_FPS = 5.0, 20


@dataclass
class Report:
    """Score a trained run on its held-out frames; write scores.json, side-by-side.png and video.mp4."""

    load_config: Annotated[Path, tyro.conf.Positional]
    """config.yml of the run."""
    output_dir: Path | None = None
    """Folder for the three files. None: the folder of the run."""

    def main(self) -> None:
        from nerfstudio.utils.eval_utils import eval_setup
        from nerfstudio.utils.rich_utils import CONSOLE

        from enerf_ns.enerf_pipeline import EnerfPipeline

        if not self.load_config.is_file():
            raise SystemExit(f"enerf: {self.load_config}: no such file; give the config.yml of a trained run")
        output_dir = self.output_dir or self.load_config.parent
        _, pipeline, _, _ = eval_setup(self.load_config)
        assert isinstance(pipeline, EnerfPipeline)
        scores = write_scores_and_picture(pipeline, output_dir)
        render_video(pipeline, self.load_config, output_dir)
        CONSOLE.print(scores)
        CONSOLE.print(f"scores.json, side-by-side.png and video.mp4 are in {output_dir.resolve()}")


def write_scores_and_picture(
    pipeline: EnerfPipeline, output_dir: Path, extra: dict[str, float] | None = None
) -> dict[str, float | None]:
    """Render the held-out frames once; write scores.json and side-by-side.png.

    Args:
        pipeline: A trained run.
        output_dir: Made if it does not exist.
        extra: Entries put into scores.json beside the scores.

    Returns:
        What scores.json holds: psnr (dB), ssim, lpips (None where its weights are missing), correlation, and with
        known depth depth_rmse and mean_depth (metres); means over the held-out frames. Without frames the first three
        are None, and event_correlation stands for them.
    """
    from enerf_ns.enerf_pipeline import view_scores

    views, summary = pipeline.held_out_views()
    per_view = [view_scores(view) for view in views]
    scores: dict[str, float | None] = {"psnr": None, "ssim": None, "lpips": None}
    scores |= {key: float(np.mean([score[key] for score in per_view])) for key in per_view[0]}
    known = [view.recorded_depth[view.recorded_depth > 0] for view in views if view.recorded_depth is not None]
    if known:
        scores["mean_depth"] = float(np.mean([float(depth.mean()) for depth in known]))
    scores |= summary | (extra or {})

    output_dir.mkdir(parents=True, exist_ok=True)
    save_picture(views, pipeline, output_dir / "side-by-side.png")
    temporary = output_dir / "scores.json.part"
    temporary.write_text(json.dumps(scores, indent=2) + "\n")
    os.replace(temporary, output_dir / "scores.json")
    return scores


def save_picture(views: list[HeldOutView], pipeline: EnerfPipeline, path: Path) -> None:
    """Frame, render, depth and events of a few held-out frames, side by side.

    Frames on a clock of their own are shown without events.
    """
    from matplotlib.figure import Figure

    from enerf_ns.dataparsers.event_index import event_picture

    recording = pipeline.datamanager.eval_dataset.recording
    titles = ["held-out frame", "render", "depth", *["events"] * (recording.held_out_frames is None)]
    chosen = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, PICTURE_ROWS).round().astype(int))]
    height, width = chosen[0].depth.shape[:2]
    figure = Figure(figsize=(13, 0.3 + 2.95 * len(chosen) * height / width), layout="constrained", dpi=100)
    axes = figure.subplots(len(chosen), len(titles), squeeze=False)
    near = min(float(view.depth.quantile(0.01)) for view in chosen)
    far = max(float(view.depth.quantile(0.99)) for view in chosen)
    for row, view in zip(axes, chosen, strict=True):
        if view.recorded is not None:
            row[0].imshow(view.recorded.clamp(0, 1).numpy())
        row[1].imshow(view.rendered.clamp(0, 1).numpy())
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
    figure.savefig(path)


def render_video(pipeline: EnerfPipeline, load_config: Path, output_dir: Path) -> None:
    """Write camera_path.json, a smooth flight past some of the held-out cameras, and render it to video.mp4.

    By `ns-render camera-path`; brightness on the left, depth on the right.
    """
    from nerfstudio.scripts.render import RenderCameraPath

    path_file = output_dir / "camera_path.json"
    path_file.write_text(json.dumps(camera_path(pipeline)))
    model = pipeline.model
    RenderCameraPath(
        load_config=load_config,
        output_path=output_dir / "video.mp4",
        rendered_output_names=["rgb", "depth"],
        camera_path_filename=path_file,
        depth_near_plane=model.config.near_plane,
        depth_far_plane=far_plane(pipeline),
    ).main()


def far_plane(pipeline: EnerfPipeline) -> float:
    """Farthest depth of the scene, in scene units."""
    near, far = pipeline.datamanager.dataparser.config.depth_range
    return float(pipeline.model.config.near_plane or 0.0) * far / near


def camera_path(pipeline: EnerfPipeline) -> dict:
    """A camera path as the viewer saves it: cubic through the places of `KEY_POSES` held-out cameras, slerp between
    their directions, with sides of the picture even, as video players want them."""
    cameras = pipeline.datamanager.eval_dataset.cameras
    chosen = np.unique(np.linspace(0, len(cameras) - 1, KEY_POSES).round().astype(int))
    poses = cameras.camera_to_worlds[chosen].double().cpu().numpy()
    if len(poses) == 1:
        poses = np.repeat(poses, 2, axis=0)
    flight = Trajectory(np.arange(len(poses)) * 10**9, poses[:, :, 3], Rotation.from_matrix(poses[:, :, :3]).as_quat())
    times = np.linspace(flight.start, flight.end, int(VIDEO_SECONDS * VIDEO_FPS)).astype(np.int64)
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
