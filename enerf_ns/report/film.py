"""The two films of a trained run, video.mp4 and moving.webp, at a brightness that suits a screen."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from nerfstudio.cameras.camera_paths import get_path_from_json
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image
from rich.progress import track
from torch import Tensor

from enerf_ns.dataparsers.index.event_index import OFF_COLOUR, ON_COLOUR, event_picture
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.errors import OutputError
from enerf_ns.dataparsers.recording.files import partial_of, write_whole
from enerf_ns.evaluation.display import Display
from enerf_ns.evaluation.views import HeldOutView
from enerf_ns.method.pipeline import EnerfPipeline

VIDEO_SIDE, MOVING_SIDE = 480, 240
"""Least width of each picture in video.mp4, and width of each picture in moving.webp, pixels."""
VIDEO_QUALITY, MOVING_QUALITY, PICTURE_QUALITY = 6, 40, 85
"""Quality of video.mp4 from 0 to 10, and of moving.webp and other WebP pictures from 0 to 100."""
MOVING_FRAMES, MOVING_MS, MOVING_PIXELS = 40, 90, 160 * 120
"""Pictures of moving.webp, milliseconds that each is shown, and most pixels of each that are rendered."""
GAP = 8
"""Pixels between two pictures side by side."""


@dataclass(frozen=True)
class Screen(Display):
    """Display of brightness and depth."""

    depth_range: tuple[float, float] | None
    """Depths in metres at the ends of the colours; None for a panorama, whose depth is not shown."""

    @classmethod
    def of(cls, views: Sequence[HeldOutView], depth_range: tuple[float, float] | None) -> Screen:
        """A display that suits views, whose brightness is not aligned, and a depth range in metres, if there is one."""
        shown = Display.of_views(views)
        return cls(shown.correct, shown.exponent, depth_range)

    @property
    def scale_of_depth(self) -> dict[str, tuple[float, float]]:
        """The depths at the ends of the colours by the title of the picture; empty if depth is not shown."""
        return {} if self.depth_range is None else {"depth, metres": self.depth_range}

    def brightness(self, rendered: Float[Tensor, "height width 3"]) -> UInt8[np.ndarray, "height width 3"]:
        """The field's linear brightness as displayed, 0 to 255."""
        return (255.0 * self.shown(rendered.cpu())).round().byte().numpy()

    def depth(self, metres: Float[Tensor, "height width 1"]) -> UInt8[np.ndarray, "height width 3"]:
        """Depth in metres in the colours of viridis."""
        from matplotlib import colormaps

        assert self.depth_range is not None
        near, far = self.depth_range
        share = (metres[..., 0].cpu().nan_to_num(far).numpy() - near) / max(far - near, 1e-9)
        return np.rint(255.0 * colormaps["viridis"](share.clip(0.0, 1.0))[..., :3]).astype(np.uint8)


def render_video(pipeline: EnerfPipeline, screen: Screen, path: dict[str, Any], output: Path) -> None:
    """Renders a flight: brightness beside depth, with a scale of depth in metres, if depth is shown.

    Args:
        pipeline: Pipeline of a trained run.
        screen: Display of brightness and depth.
        path: Camera path in the format of Nerfstudio's viewer.
        output: The .mp4 file. If rendering fails, the previous file stays.

    Raises:
        OutputError: The file cannot be written.
    """
    cameras = get_path_from_json(path)
    width = max(VIDEO_SIDE, int(path["render_width"]))
    strip = _strip(width, {screen.gamma: None, **screen.scale_of_depth})

    def pictures() -> Iterator[np.ndarray]:
        for number in track(range(len(cameras)), "Rendering the video", console=CONSOLE, transient=True):
            rays = cameras[number : number + 1].to(pipeline.device).generate_rays(camera_indices=0, keep_shape=True)
            yield _below([_scaled(side, width) for side in _sides(pipeline, screen, rays)], strip)

    partial = partial_of(output)
    try:
        _write_mp4(partial, pictures(), int(path["fps"]))
        partial.replace(output)
    finally:
        with suppress(OSError):  # as of a folder that cannot be written to
            partial.unlink(missing_ok=True)


def render_moving(pipeline: EnerfPipeline, screen: Screen, output: Path) -> None:
    """Renders a small animated WebP: events, brightness and, if it is shown, depth along the recorded path.

    Args:
        pipeline: Pipeline of a trained run.
        screen: Display of brightness and depth.
        output: The .webp file. If rendering fails, the previous file stays.

    Raises:
        OSError: The file cannot be written.
    """
    manager = pipeline.datamanager
    recording = manager.recording
    index, camera = index_events(recording), recording.camera
    first, last = index.span
    step = math.ceil(math.sqrt(camera.width * camera.height / MOVING_PIXELS))
    rows, columns = torch.arange(step // 2, camera.height, step), torch.arange(step // 2, camera.width, step)
    pixels = (rows[:, None] * camera.width + columns).flatten().to(pipeline.device)
    posed = manager.event_camera_without_distortion
    strip = _strip(
        MOVING_SIDE,
        {"events": ((ON_COLOUR, "brighter"), (OFF_COLOUR, "darker")), "render": None, **screen.scale_of_depth},
    )  # fmt: skip
    pictures = []
    times = np.linspace(first, last, MOVING_FRAMES + 2).astype(np.int64)[1:-1]
    for time in track(times.tolist(), "Rendering the moving picture", console=CONSOLE, transient=True):
        rays = posed.rays(pixels, torch.full_like(pixels, time)).reshape((len(rows), len(columns)))
        sides = [event_picture(index, camera, time), *_sides(pipeline, screen, rays)]
        pictures.append(_below([_scaled(side, MOVING_SIDE) for side in sides], strip))
    write_whole(output, animated(pictures))


def animated(pictures: Sequence[UInt8[np.ndarray, "height width 3"]]) -> bytes:
    """An animated WebP of pictures of one size, each shown for `MOVING_MS`, over and over."""
    first, *others = map(Image.fromarray, pictures)
    content = io.BytesIO()
    first.save(
        content, "webp", save_all=True, append_images=others, duration=MOVING_MS, loop=0, quality=MOVING_QUALITY,
        method=4,
    )  # fmt: skip
    return content.getvalue()


def poster_of(video: Path) -> bytes:
    """The picture in the middle of a video that `render_video` made, as a WebP file."""
    opened = cv2.VideoCapture(str(video))
    opened.set(cv2.CAP_PROP_POS_FRAMES, opened.get(cv2.CAP_PROP_FRAME_COUNT) // 2)
    return webp(opened.read()[1][..., ::-1])


def webp(picture: UInt8[np.ndarray, "height width 3"]) -> bytes:
    """A picture as a WebP file."""
    content = io.BytesIO()
    Image.fromarray(picture).save(content, "webp", quality=PICTURE_QUALITY)
    return content.getvalue()


@torch.no_grad()
def _sides(pipeline: EnerfPipeline, screen: Screen, rays: RayBundle) -> list[np.ndarray]:
    """Pictures of brightness, and of depth if it is shown, along rays (height, width)."""
    pipeline.eval()
    outputs = pipeline.model.get_outputs_for_camera_ray_bundle(rays)
    scale = pipeline.datamanager.train_dataparser_outputs.dataparser_scale
    metres = outputs["depth"] / rays.metadata["directions_norm"] / scale
    shown = [screen.brightness(outputs["rgb"])]
    return shown if screen.depth_range is None else [*shown, screen.depth(metres)]


def _scaled(picture: UInt8[np.ndarray, "height width 3"], width: int) -> UInt8[np.ndarray, "tall wide 3"]:
    """The picture scaled to another width, by Lanczos interpolation if it grows."""
    size = width, round(picture.shape[0] * width / picture.shape[1])
    return cv2.resize(picture, size, interpolation=cv2.INTER_LANCZOS4 if width > picture.shape[1] else cv2.INTER_AREA)


def _below(sides: Sequence[np.ndarray], strip: np.ndarray) -> np.ndarray:
    """Pictures side by side above their legend, with an even width and height, which players require."""
    gap = np.full((len(sides[0]), GAP, 3), 255, np.uint8)
    row = np.concatenate([part for side in sides for part in (gap, side)][1:], axis=1)
    whole = np.concatenate([row, strip], axis=0)
    return np.pad(whole, ((0, len(whole) % 2), (0, whole.shape[1] % 2), (0, 0)), constant_values=255)


def _strip(width: int, explained: dict[str, Any]) -> UInt8[np.ndarray, "height wide 3"]:
    """The legend below pictures of this width: for each its title, and its colours or its scale of depth."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    number, dpi, height = len(explained), 100, 54
    total = number * width + (number - 1) * GAP
    figure = Figure(figsize=(total / dpi, height / dpi), dpi=dpi)
    for place, (title, what) in enumerate(explained.items()):
        left = (place * (width + GAP) + 0.5 * width) / total
        figure.text(left, 0.92, title, ha="center", va="top", fontsize=9)
        if what is not None and isinstance(what[0], float):
            bar = figure.add_axes((left - 0.4 * width / total, 0.36, 0.8 * width / total, 0.16))
            figure.colorbar(ScalarMappable(Normalize(*what), "viridis"), cax=bar, orientation="horizontal")
            bar.tick_params(labelsize=8, pad=1, length=2)
        elif what is not None:
            handles = [Patch(facecolor="#{:02x}{:02x}{:02x}".format(*colour), label=name) for colour, name in what]
            figure.legend(handles=handles, loc="upper center", bbox_to_anchor=(left, 0.62), ncols=2, fontsize=8,
                          frameon=False, borderpad=0, handlelength=1)  # fmt: skip
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    drawn = np.asarray(canvas.buffer_rgba())[..., :3]
    fitting = np.full((height, total, 3), 255, np.uint8)
    fitting[: len(drawn), : drawn.shape[1]] = drawn[:height, :total]
    return fitting


def _write_mp4(file: Path, pictures: Iterator[np.ndarray], fps: int) -> None:
    """Encodes pictures of one size as H.264 in an MP4 file.

    Raises:
        OutputError: The file cannot be written.
    """
    from imageio_ffmpeg import write_frames

    unwritten = OutputError(f"{file.parent} could not take a video; make room on the disk.")
    first = next(pictures)
    video = write_frames(
        str(file), first.shape[1::-1], fps=fps, codec="libx264", quality=VIDEO_QUALITY, macro_block_size=2,
        ffmpeg_log_level="quiet",
    )  # fmt: skip
    video.send(None)
    try:
        video.send(np.ascontiguousarray(first).tobytes())
        for picture in pictures:
            video.send(np.ascontiguousarray(picture).tobytes())
        video.close()
    except OSError as error:
        raise unwritten from error
    if not cv2.VideoCapture(str(file)).isOpened():
        raise unwritten
