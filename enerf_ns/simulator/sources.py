"""Sources of brightness for the simulated camera: rendered scenes, folders of images, videos and trained runs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, Protocol

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, Int64, Shaped, UInt8
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.text_tables import read_times
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.files import check_is_file, files_in, image_size, load_image
from enerf_ns.dataparsers.recording.picture_depth import brightness, find_white_level
from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.method.runs import load_any_method
from enerf_ns.sensor.response import Gamma, Logarithm, Response
from enerf_ns.simulator.trajectories import POSES_PER_SECOND, sampled

if TYPE_CHECKING:
    from enerf_ns.simulator.scene.render import Renderer

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")

FRAMES_KEPT = 8
"""Number of decoded frames of a video that are kept, since threads do not ask for frames strictly in order."""

CHUNK_ON_CPU = 1024
"""Most rays of a trained run that a CPU renders at once."""

SHARE_DECODED = 0.9
"""Least fraction of the stated frames of a video that must be decoded. With fewer, the end of the video is missing; the
fraction is below 1, since some videos state their number of frames only roughly."""

OPENGL_AXES = np.array([1.0, -1.0, -1.0, 1.0])
"""Factors of the columns of a pose [R | t] that convert it from OpenCV axes (x right, y down, z forward) to OpenGL axes
(x right, y up, z back), and back."""


class Source(Protocol):
    """Anything that has a linear brightness at any time."""

    start: int
    """First time of which the source has a picture, ns."""
    end: int
    """Last time of which the source has a picture, ns."""

    def brightness(self, time: int, pixels: Int64[np.ndarray, " pixels"] | None = None) -> Float[np.ndarray, "*pixels"]:
        """Linear brightness, at least 0: grey [height, width] or R G B [height, width, 3].

        Several threads may call this at once.

        Args:
            time: ns, from `start` to `end`.
            pixels: Numbers of the wanted pixels, y * width + x; the result is then grey [pixels] or R G B [pixels, 3].
                Default: all pixels.
        """
        ...


class RenderedScene:
    """A scene, seen by the camera of a renderer that moves along a trajectory."""

    def __init__(self, renderer: Renderer, trajectory: Trajectory):
        self.renderer, self.camera, self.trajectory = renderer, renderer.camera, trajectory
        self.start, self.end = trajectory.start, trajectory.end

    def brightness(self, time: int, pixels: Int64[np.ndarray, " pixels"] | None = None) -> Float[np.ndarray, "*pixels"]:
        """Linear brightness at a time; see `Source.brightness`."""
        return self.renderer.brightness(_pose(self.trajectory, time), pixels)

    def depth(self, time: int) -> Float32[np.ndarray, "height width"]:
        """z-depth in metres, 0 where no surface is seen."""
        return self.renderer.depth(_pose(self.trajectory, time))


class Pictures(ABC):
    """At least two pictures; between them log brightness is interpolated linearly in time.

    Args:
        path: Folder or file of the pictures.
        times: Times of the pictures, ns, strictly increasing from 0.
        gamma: Whether the values of the pictures are sRGB, else linear.
        response: Response that converts brightness to log brightness.
    """

    width: int
    height: int

    def __init__(self, path: Path, times: Int64[np.ndarray, " pictures"], gamma: bool, response: Response):
        self.path, self.times, self.gamma, self.response = path, times, gamma, response
        self.start, self.end = 0, int(times[-1])
        self._linear = lru_cache(maxsize=4)(self._load_linear)

    @abstractmethod
    def _load(self, index: int) -> Shaped[np.ndarray, "height width *channels"]:
        """One picture, uint8 or float32 in [0, 1], grey or R G B."""

    def brightness(
        self, time: int, pixels: Int64[np.ndarray, " pixels"] | None = None
    ) -> Float32[np.ndarray, "*pixels"]:
        """Linear brightness at a time; see `Source.brightness`.

        Raises:
            RecordingError: The picture before or after this time cannot be read, or differs from the first picture in
                its number of bits or channels.
        """
        if not self.start <= time <= self.end:
            raise ValueError(f"{self.path} was asked for {time} ns, but lasts from {self.start} to {self.end} ns.")
        before = int(np.searchsorted(self.times, time, side="right")) - 1
        first = self._linear(before)
        if time == self.times[before]:
            picture = first.copy()
        else:
            first, second = self.response(first), self.response(self._linear(before + 1))
            passed = (time - self.times[before]) / (self.times[before + 1] - self.times[before])
            picture = np.maximum(self.response.inverse(first + np.float32(passed) * (second - first)), 0)
        return picture if pixels is None else picture.reshape(-1, *picture.shape[2:])[pixels]

    def _load_linear(self, index: int) -> np.ndarray:
        picture = self._load(index)
        return linear_picture(picture) if self.gamma else brightness(picture)


class ImageFolder(Pictures):
    """The pictures of a folder, of 8 or 16 bits, in the order of their names; picture10 comes after picture9.

    Args:
        path: The folder.
        frames_per_second: Frame rate of the pictures, if `stamps` is not given.
        stamps: Text file with the time of each picture in seconds, one a line. The first picture gets time 0.
        gamma: See `Pictures`.
        response: See `Pictures`.

    Raises:
        RecordingError: The folder is missing, has fewer than two pictures, or pictures of several sizes; the first
            picture cannot be read; or there is not one time for each picture.
        FlagError: Both or neither of `frames_per_second` and `stamps` are given.
    """

    def __init__(
        self,
        path: Path,
        frames_per_second: float | None = None,
        stamps: Path | None = None,
        gamma: bool = True,
        response: Response = Logarithm(),  # noqa: B008, since it cannot be changed
    ):
        if not path.is_dir():
            raise RecordingError(f"{path} is no folder, but one with pictures was expected.")
        self.filenames = files = [file for file in files_in(path, "*") if file.suffix.lower() in PICTURE_SUFFIXES]
        if len(files) < 2:
            found = "only one picture" if files else "no pictures"
            raise RecordingError(f"{path} holds {found} ({' '.join(PICTURE_SUFFIXES)}), but at least two are needed.")
        if frames_per_second is not None and stamps is None:
            times = _regular_times(path, len(files), frames_per_second)
        elif stamps is not None and frames_per_second is None:
            times = read_times(stamps, "s")
            if len(times) != len(files):
                raise RecordingError(
                    f"{stamps} holds {len(times):,} times, but {path} {len(files):,} pictures; give one time a picture."
                )
        else:
            raise FlagError(f"{path} needs either --frames-per-second or --stamps, the times of its pictures.")
        super().__init__(path, times - times[0], gamma, response)
        self.width, self.height = image_size(self.filenames[0])
        for file in self.filenames:
            if (size := image_size(file)) != (self.width, self.height):
                raise RecordingError(
                    f"{file} has {size[0]} x {size[1]} pixels, but the first picture, {self.filenames[0].name}, has "
                    f"{self.width} x {self.height}; give pictures of one size."
                )
        first = load_image(self.filenames[0])
        self._kind = first.shape[2], first.dtype

    def _load(self, index: int) -> Shaped[np.ndarray, "height width *channels"]:
        image = load_image(self.filenames[index])
        if (image.shape[2], image.dtype) != self._kind:
            found, expected = (
                f"{'grey' if channels == 1 else 'in colour'} with {8 * dtype.itemsize} bits"
                for channels, dtype in ((image.shape[2], image.dtype), self._kind)
            )
            raise RecordingError(
                f"{self.filenames[index]} is {found}, but the first picture, {self.filenames[0].name}, is {expected}; "
                "give pictures of one kind."
            )
        if image.dtype != np.uint8:
            image = image / np.float32(find_white_level(tuple(self.filenames)))
        return image[..., 0] if image.shape[2] == 1 else image


class Video(Pictures):
    """The frames of a video, in colour.

    Frames are decoded in order. A step back by more than `FRAMES_KEPT` frames decodes the video from its start again.

    Args:
        path: The file, in any format that OpenCV decodes.
        frames_per_second: Frame rate at which the video was recorded. Default: the frame rate that it states.
        gamma: See `Pictures`.
        response: See `Pictures`.

    Raises:
        RecordingError: The file is missing, is no video, has fewer than two frames or no frame rate, or its end is
            missing.
    """

    def __init__(
        self,
        path: Path,
        frames_per_second: float | None = None,
        gamma: bool = True,
        response: Response = Logarithm(),  # noqa: B008, since it cannot be changed
    ):
        check_is_file(path, "a video")
        if not path.exists():
            raise RecordingError(f"{path} is missing; a video was expected.")
        self.path, self._lock = path, Lock()
        self._open()
        rate = self._capture.get(cv2.CAP_PROP_FPS) if frames_per_second is None else frames_per_second
        stated = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self.width = int(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        self.height = int(self._capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        count = 0
        while self._capture.grab():
            count += 1
        if count < 2 or count < SHARE_DECODED * stated:
            raise RecordingError(
                f"{path} should hold {max(2, stated):,} frames{' or more' * (stated < 2)}, but only {count:,} can be "
                "decoded; copy it again from its source."
            )
        super().__init__(path, _regular_times(path, count, rate), gamma, response)
        self._open()

    def _open(self) -> None:
        self._capture = cv2.VideoCapture(str(self.path))
        if not self._capture.isOpened():
            raise RecordingError(f"{self.path} cannot be decoded as a video; give one in a format that OpenCV reads.")
        self._next = 0
        self._recent: dict[int, np.ndarray] = {}

    def _load(self, index: int) -> UInt8[np.ndarray, "height width 3"]:
        with self._lock:
            if index < self._next and index not in self._recent:
                self._open()
            while self._next <= index:
                decoded, frame = self._capture.read()
                if not decoded or frame.shape != (self.height, self.width, 3):
                    raise RecordingError(f"{self.path}, frame {self._next} cannot be decoded; copy it again.")
                self._recent[self._next] = frame
                self._recent.pop(self._next - FRAMES_KEPT, None)
                self._next += 1
            return self._recent[index][..., ::-1]


class TrainedRun:
    """A radiance field that Nerfstudio trained, seen by a pinhole camera that moves along a trajectory.

    A run of this package renders linear brightness or, with a response of gamma, encoded brightness, which is decoded.
    Renderings of any other method are taken for sRGB.

    Args:
        config: config.yml of the run.
        trajectory: Camera to world in the coordinates of the run's data (metres for recordings), OpenCV axes. Default:
            the trajectory of the run's recording, starting at time 0. A run of another method has no recording; there
            the camera moves past the cameras of the training, from each to the next in equal times.
        duration: Duration of the motion past the cameras of the training, ns.

    Attributes:
        camera: The event camera without its distortion, or the first camera of the training; may be replaced.
        has_depth: Whether the depth has a meaning, which that of a panorama has not.

    Raises:
        RecordingError: The file is missing, Nerfstudio cannot load the run, or it has fewer than two cameras to move
            past.
    """

    def __init__(self, config: Path, trajectory: Trajectory | None = None, duration: int = 10**9):
        # These import Nerfstudio, which other sources do without.
        from enerf_ns.dataparsers.event_dataparser import go_on_without_lpips
        from enerf_ns.kernels.fast_hash_encoding import speed_up_hash_grids

        go_on_without_lpips()
        pipeline: Any = load_any_method(config, "inference")[1]
        from nerfstudio.models.splatfacto import SplatfactoModel

        self.config = config
        self._model, self._lock = pipeline.model, Lock()
        speed_up_hash_grids(self._model)
        if self._model.device.type == "cpu":  # what larger chunks compute does not fit its cache
            settings = self._model.config
            settings.eval_num_rays_per_chunk = min(settings.eval_num_rays_per_chunk, CHUNK_ON_CPU)
        self._renders_z_depth = isinstance(self._model, SplatfactoModel)
        self.has_depth = not getattr(self._model.config, "panorama", False)
        outputs = pipeline.datamanager.train_dataparser_outputs
        transform = outputs.metadata.get("transform", outputs.dataparser_transform)
        self._transform = transform[:3].double().numpy()
        self._scale = float(outputs.dataparser_scale)
        recording = outputs.metadata.get("recording")
        self._is_linear = isinstance(recording, EventRecording)
        if isinstance(recording, EventRecording):
            own = recording.trajectory
            self.camera = recording.camera.undistorted()
            self.trajectory = trajectory or Trajectory(own.times - own.start, own.positions, own.quaternions)
        else:
            self.camera = _camera(outputs.cameras[0])
            self.trajectory = trajectory or self._past(outputs.cameras, duration)
        self.start, self.end = self.trajectory.start, self.trajectory.end

    def brightness(
        self, time: int, pixels: Int64[np.ndarray, " pixels"] | None = None
    ) -> Float32[np.ndarray, "*pixels"]:
        """Linear brightness at a time, grey if the field is grey; see `Source.brightness`."""
        rgb = self._render(time, "rgb", pixels)
        if not self._is_linear:
            return linear_from_srgb(rgb.clip(0, 1)).astype(np.float32)
        response = self._model.sensor.response
        if isinstance(response, Gamma):
            rgb = rgb.clip(0) ** np.float32(response.exponent)
        return rgb[..., 0] if self._model.config.num_channels == 1 else rgb

    def depth(self, time: int) -> Float32[np.ndarray, "height width"]:
        """z-depth in the unit of the trajectory."""
        depth = self._render(time, "depth")[..., 0] / self._scale
        if not self._renders_z_depth:
            depth /= np.linalg.norm(self.camera.pixel_directions(), axis=-1)
        return depth.astype(np.float32)

    @torch.no_grad()
    def _render(self, time: int, output: str, pixels: np.ndarray | None = None) -> np.ndarray:
        """One output of the field at a time, [height, width, channels], or [pixels, channels] of the wanted pixels."""
        from nerfstudio.cameras.cameras import Cameras
        from nerfstudio.models.base_model import Model

        from enerf_ns.method.model import EnerfModel

        rotation, shift = self._transform[:, :3], self._transform[:, 3]
        pose = rotation @ _pose(self.trajectory, time)
        pose[:, 3] = self._scale * (pose[:, 3] + shift)
        camera = Cameras(
            torch.from_numpy(pose * OPENGL_AXES).float()[None],
            fx=self.camera.fx,
            fy=self.camera.fy,
            cx=self.camera.cx + 0.5,
            cy=self.camera.cy + 0.5,
            width=self.camera.width,
            height=self.camera.height,
        ).to(self._model.device)
        renders = type(self._model).get_outputs_for_camera
        casts_rays = renders in (Model.get_outputs_for_camera, EnerfModel.get_outputs_for_camera)
        with self._lock:
            if casts_rays:
                places = None
                if pixels is not None:
                    row, column = np.divmod(pixels, self.camera.width)
                    places = torch.from_numpy(np.stack([row, column], axis=-1)[:, None] + 0.5).float()
                    places = places.to(self._model.device)
                rays = camera.generate_rays(camera_indices=0, coords=places, keep_shape=True)
                outputs = self._model.get_outputs_for_camera_ray_bundle(rays)
            else:
                outputs = self._model.get_outputs_for_camera(camera)
        if output not in outputs:
            raise RecordingError(f"{self.config} is a run of a method that renders no {output}; give another run.")
        values = outputs[output].float().cpu().numpy()
        if pixels is None:
            return values
        values = values.reshape(-1, values.shape[-1])
        return values if casts_rays else values[pixels]

    def _past(self, cameras: Any, duration: int) -> Trajectory:
        """Trajectory through the cameras of the training, in the coordinates of the run's data."""
        if len(cameras) < 2:
            raise RecordingError(f"{self.config} was trained on one camera; give a --trajectory to render it along.")
        poses = cameras.camera_to_worlds.double().cpu().numpy() * OPENGL_AXES
        back = np.linalg.inv(self._transform[:, :3])
        positions = (poses[:, :, 3] / self._scale - self._transform[:, 3]) @ back.T
        times = np.linspace(0, duration, len(poses)).astype(np.int64)
        past = Trajectory(times, positions, Rotation.from_matrix(back @ poses[:, :, :3]).as_quat())
        return sampled(past, POSES_PER_SECOND) if duration > len(poses) * 10**9 // POSES_PER_SECOND else past


def linear_from_srgb(values: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Linear brightness in [0, 1] of sRGB values in [0, 1] (IEC 61966-2-1)."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def linear_picture(picture: Shaped[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
    """Linear brightness of an sRGB picture, uint8 or float32 in [0, 1]."""
    if picture.dtype == np.uint8:
        return linear_from_srgb(np.arange(256) / 255).astype(np.float32)[picture]
    return linear_from_srgb(picture)


def _pose(trajectory: Trajectory, time: int) -> np.ndarray:
    return trajectory.poses(torch.tensor(time)).numpy()


def _regular_times(path: Path, count: int, rate: float) -> np.ndarray:
    if not 0 < rate < 1e9:
        raise RecordingError(
            f"{path} has {rate:g} frames per second, which is no frame rate; give it with --frames-per-second."
        )
    return np.round(np.arange(count) * (1e9 / rate)).astype(np.int64)


def _camera(camera: Any) -> Camera:
    """Camera that corresponds to a camera of Nerfstudio, without its distortion."""
    fx, fy, cx, cy = (float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy"))
    return Camera(int(camera.width), int(camera.height), fx, fy, cx - 0.5, cy - 0.5)
