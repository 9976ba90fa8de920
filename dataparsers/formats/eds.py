"""Reader of EDS, as it is unpacked and as E-NeRF's reference code prepares it, and writer of the former.

As unpacked, on a clock of absolute times:

    events.h5                         x, y, t (µs), p
    stamped_groundtruth.txt           t_s px py pz qx qy qz qw; event camera to world, OpenCV axes, metres
    images/*.png                      of the RGB camera, with images_timestamps.txt, one stamp (µs) a line (optional)
    *camchain*.yaml                   Kalibr's calibration, here or in a calibration folder beside this one (optional)

As prepared, on a clock that starts with the recording:

    events.h5                         x, y, t (µs), p
    stamped_groundtruth_us.txt        as above, with t_us
    rectify_map_calib0.h5             rectify_map (480, 640, 2): undistorted place of each pixel of the event camera
    calib_undist_calib0.json          intrinsics_undistorted of the RGB and of the event camera
    images_undistorted_calib0/*.png   with images_timestamps_us.txt (optional)

The preparation writes into the unpacked folder and converts events.h5 in place, so that both layouts may lie in one
folder: what is on the clock of the events is used. The published files do not tell to which part of the exposure the
stamp of an image belongs; it is taken for the middle.

Hidalgo-Carrió et al., "Event-aided direct sparse odometry", CVPR 2022.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from enerf_ns.dataparsers.formats.format import Format
from enerf_ns.dataparsers.formats.hdf5_events import Hdf5Events, Hdf5EventsFile, read_rectify_map
from enerf_ns.dataparsers.formats.json_values import parse_array
from enerf_ns.dataparsers.formats.text_tables import read_poses, read_times
from enerf_ns.dataparsers.formats.writer import EventFiles, Writer, encode_poses
from enerf_ns.dataparsers.recording.camera import Camera, CameraModel, check_rotation
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.files import (
    check_image_size,
    check_is_folder,
    in_colour,
    of_file,
    read_json,
    read_text,
)
from enerf_ns.dataparsers.recording.recording import EventRecording, Events, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

FILES = ("events.h5", "stamped_groundtruth*.txt", "images_timestamps*.txt")

SENSOR_SIZE = (640, 480)
"""Width and height of the event camera, and of the images, in pixels."""

RAW_POSES, PREPARED_POSES = "stamped_groundtruth.txt", "stamped_groundtruth_us.txt"
RAW_IMAGES, PREPARED_IMAGES = "images", "images_undistorted_calib0"
STAMPS = ("images_timestamps.txt", "images_timestamps_us.txt")

CLOCK_START = 1000 * 10**9
"""What the clock of a recording that is written shows (ns) when the simulation's is at 0."""

OFFSET_TOLERANCE = 2000
"""Nanoseconds by which the preparation may round a time."""

KALIBR_MODELS: dict[str, CameraModel] = {"radtan": "radtan", "equidistant": "fisheye", "none": "pinhole"}
"""This package's names of the distortion models, by Kalibr's."""

PUBLISHED_RGB_CAMERA = Camera(
    *SENSOR_SIZE,
    *(766.536025127154, 767.5749459126396, 291.0503512057777, 227.4060484950132),
    (-0.36965913545735024, 0.17414034009883844, 0.003915245015812422, 0.003666687416655559),
    "radtan",
)
PUBLISHED_EVENT_CAMERA = Camera(
    *SENSOR_SIZE,
    *(560.8520948927032, 560.6295819972383, 313.00733235019237, 217.32858679842997),
    (-0.09776467241921379, 0.2143738428636279, -0.004710710105172864, -0.004215916089401789),
    "radtan",
)
PUBLISHED_EXTRINSICS = np.array(
    [
        [0.9998964430808897, -0.0020335804041023736, -0.014246672065022661, -0.00011238613157578769],
        [0.001703024953250547, 0.9997299470300024, -0.023176123864880376, -0.0005981481496958399],
        [0.014289955220253567, 0.02314946137886846, 0.9996298813149167, -0.004416681577516066],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""Pose of the RGB camera in the axes of the event camera; with the two published cameras, EDS's calibration, for when
none is there."""

Poses = tuple[Int64[np.ndarray, " poses"], Float64[np.ndarray, "poses 3"], Float64[np.ndarray, "poses 4"]]
"""Times (ns), positions and quaternions of poses."""


def read(folder: Path) -> EventRecording:
    """Reads all but the events, which are read when asked for.

    The recording's zero of time is the earliest first stamp among events, frames and poses as unpacked, and that of the
    files as prepared.

    Args:
        folder: With the files that the module describes.

    Raises:
        RecordingError: A file is missing or empty, anything in it cannot be used, or the files share no clock.
    """
    notes: list[str] = []
    events = Hdf5Events(folder / "events.h5")
    prepared, (pose_times, positions, quaternions) = _read_poses(folder, events, notes)
    image_files, image_times = _read_image_list(folder, prepared, events, notes)
    first_stamps = [events.first_time, pose_times[0], *image_times[:1]]
    zero = 0 if prepared else int(min(first_stamps))
    trajectory = Trajectory(pose_times - zero, positions, quaternions)

    camchain = _find_camchain(folder)
    rgb_camera, camera, event_from_rgb = PUBLISHED_RGB_CAMERA, PUBLISHED_EVENT_CAMERA, PUBLISHED_EXTRINSICS
    if camchain is not None:
        rgb_camera, camera, event_from_rgb = _read_camchain(camchain)
    rectify_map_file = folder / "rectify_map_calib0.h5"
    raw_events = not (prepared and rectify_map_file.exists())
    if not raw_events:
        undistorted = _read_undistorted_camera(folder, 1)
        places = read_rectify_map(rectify_map_file, *SENSOR_SIZE).astype(float)
        directions = (places - undistorted.matrix[:2, 2]) / undistorted.matrix[[0, 1], [0, 1]]
        with of_file(rectify_map_file):
            camera = replace(undistorted, model="lookup", directions=directions)
    frames = None
    if image_files:
        if image_files[0].parent.name == PREPARED_IMAGES:
            rgb_camera = _read_undistorted_camera(folder, 0)
        for file in image_files:
            check_image_size(file, rgb_camera.width, rgb_camera.height)
        frames = Frames(image_files, image_times - zero, rgb_camera, trajectory.of_mounted(event_from_rgb))
    if frames is not None or raw_events:
        if camchain is None:
            notes.append(
                f"The published calibration of EDS is used, since no Kalibr camchain (*camchain*.yaml) lies in "
                f"{folder.name} or in a calibration folder beside it."
            )
        elif camchain.parent != folder:
            notes.append(f"The calibration is that of {camchain}.")
    return EventRecording(
        path=folder,
        format="eds",
        camera=camera,
        trajectory=trajectory,
        stream_events=lambda: events.stream(zero),
        event_files=(events.path,),
        frames=frames,
        notes=tuple(notes),
        locate_event=lambda index: f"{events.path}, event {index + 1}",
        num_events=events.num_events,
    )


def _read_poses(folder: Path, events: Hdf5Events, notes: list[str]) -> tuple[bool, Poses]:
    """Whether the events are on the clock of the prepared files, and the poses on this clock."""
    found: dict[Path, Poses] = {}
    notes_of: dict[Path, list[str]] = {}
    for path, unit in ((folder / RAW_POSES, "s"), (folder / PREPARED_POSES, "us")):
        if path.exists():
            notes_of[path] = []
            found[path] = read_poses(path, unit, notes_of[path])
    if not found:
        raise RecordingError(
            f"{folder} holds neither {RAW_POSES} (t_s px py pz qx qy qz qw) nor {PREPARED_POSES}, which hold the poses "
            "of the event camera; add one."
        )
    times = {path: poses[0] for path, poses in found.items()}
    best = _on_the_clock_of(events, times)
    if len(found) == 2:
        raw_times, prepared_times = times.values()
        _check_offset(folder, int(raw_times[0] - prepared_times[0]))
        both = all(_overlap(events, rows) > 0 for rows in times.values())
        if both and raw_times[0] > prepared_times[-1]:
            raise RecordingError(
                f"{events.path} holds times of {RAW_POSES} and of {PREPARED_POSES} in one, as a preparation that "
                "was interrupted leaves them; unpack it again."
            )
        notes.append(
            f"{RAW_POSES} and {PREPARED_POSES} are there; {best.name} is on the clock of events.h5 and is used."
        )
    notes += notes_of[best]
    return best.name == PREPARED_POSES, found[best]


def _check_offset(folder: Path, offset: int) -> None:
    path = folder / "t_offset_us.txt"
    if path.exists():
        stated = int(read_times(path, "us")[0])
        if abs(stated - offset) > OFFSET_TOLERANCE:
            raise RecordingError(
                f"{path} states {stated / 1000:.0f} µs between {RAW_POSES} and {PREPARED_POSES}, but their first times "
                f"are {offset / 1000:.0f} µs apart; remove those that are not of this recording."
            )


def _read_image_list(
    folder: Path, prepared: bool, events: Hdf5Events, notes: list[str]
) -> tuple[tuple[Path, ...], Int64[np.ndarray, " images"]]:
    """The images that are used, and their stamps on the clock of the events."""
    folders = [folder / RAW_IMAGES, folder / PREPARED_IMAGES]
    for path in folders:
        check_is_folder(path, "a folder of frames")
    folders = [path for path in (reversed(folders) if prepared else folders) if path.is_dir()]
    images = [tuple(sorted(path.glob("*.png")) or sorted(path.glob("*.jpg"))) for path in folders]
    files: tuple[Path, ...] = next(filter(None, images), ())
    stamps = {folder / name: read_times(folder / name, "us") for name in STAMPS if (folder / name).exists()}
    if not files and not stamps:
        return (), np.zeros(0, np.int64)
    if not folders:
        notes.append(f"There are stamps of images, but no folder {RAW_IMAGES}/ or {PREPARED_IMAGES}/ with these.")
        return (), np.zeros(0, np.int64)
    if not stamps:
        raise RecordingError(
            f"{folder} holds {len(files):,} images, but {' and '.join(STAMPS)} are missing, one of which "
            "holds their stamps (t_us); add it."
        )
    path = _on_the_clock_of(events, stamps)
    if len(stamps[path]) != len(files):
        raise RecordingError(
            f"{files[0].parent if files else folders[0]} holds {len(files):,} images, but {path} holds "
            f"{len(stamps[path]):,} stamps; give one each."
        )
    return files, stamps[path]


def _overlap(events: Hdf5Events, times: Int64[np.ndarray, " rows"]) -> int:
    """For how many ns there are both events and these times; below 0, how far they are apart."""
    return int(min(times[-1], events.last_time) - max(times[0], events.first_time))


def _on_the_clock_of(events: Hdf5Events, tables: dict[Path, Int64[np.ndarray, " rows"]]) -> Path:
    """The file whose times (ns) overlap most with those of the events."""
    best = max(tables, key=lambda path: _overlap(events, tables[path]))
    if _overlap(events, tables[best]) < 0:
        ranges = " and ".join(f"{path.name} times from {_span(rows[0], rows[-1])}" for path, rows in tables.items())
        raise RecordingError(
            f"{best.parent} holds {ranges}, but events.h5 times from {_span(events.first_time, events.last_time)}; "
            f"they must be on one clock, in µs but for {RAW_POSES}, which is in seconds."
        )
    return best


def _span(first: int, last: int) -> str:
    return f"{first * 1e-9:.6f} s to {last * 1e-9:.6f} s"


def _find_camchain(folder: Path) -> Path | None:
    """The first camchain in the folder or, without one, in the calibration folders beside it."""
    places = [folder, *sorted(folder.parent.glob("*[cC]alib*/")), *sorted(folder.parent.glob("*[cC]alib*/*/"))]
    return next((path for place in places for path in sorted(place.glob("*camchain*.yaml"))), None)


def _read_camchain(path: Path) -> tuple[Camera, Camera, Float64[np.ndarray, "4 4"]]:
    """The RGB camera, the event camera, and the pose of the first in the axes of the second."""
    import yaml

    text = read_text(path, "a Kalibr camchain")
    try:
        camchain = yaml.safe_load(text)
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}," if mark else ""
        raise RecordingError(f"{path}{line} cannot be read as YAML, but a Kalibr camchain was expected.") from error
    if not isinstance(camchain, dict) or not all(isinstance(camchain.get(name), dict) for name in ("cam0", "cam1")):
        raise RecordingError(
            f"{path} holds no cam0 and cam1, but the RGB and the event camera of a Kalibr camchain were expected."
        )
    cameras = {name: _kalibr_camera(path, name, camchain[name]) for name in ("cam0", "cam1")}
    cam1_from_cam0 = _numbers(path, "cam1", camchain["cam1"], "T_cn_cnm1", (4, 4))
    try:
        check_rotation(cam1_from_cam0[:3, :3])
    except ValueError as error:
        raise RecordingError(f"{path} holds T_cn_cnm1 of cam1, whose rotation {error}; calibrate again.") from error
    if not np.allclose(cam1_from_cam0[3], [0, 0, 0, 1]):
        raise RecordingError(f"{path} holds T_cn_cnm1 of cam1, whose last row must be 0 0 0 1; calibrate again.")
    if _event_camera(path, text, camchain) == "cam1":
        rgb_camera, camera, event_from_rgb = cameras["cam0"], cameras["cam1"], cam1_from_cam0
    else:
        rgb_camera, camera, event_from_rgb = cameras["cam1"], cameras["cam0"], np.linalg.inv(cam1_from_cam0)
    if (camera.width, camera.height) != SENSOR_SIZE:
        raise RecordingError(
            f"{path} calibrates an event camera of {camera.width} x {camera.height} pixels, but that of EDS has "
            f"{SENSOR_SIZE[0]} x {SENSOR_SIZE[1]}; give the calibration of this recording."
        )
    return rgb_camera, camera, event_from_rgb


def _event_camera(path: Path, text: str, camchain: dict) -> str:
    """cam1, unless comments, topics, or the flip that is of RGB alone, say that it is cam0."""
    said = set()
    for name, other in (("cam0", "cam1"), ("cam1", "cam0")):
        comment = re.search(rf"^{name}:[ \t]*#(.*)$", text, re.MULTILINE)
        hint = f"{comment[1] if comment else ''} {camchain[name].get('rostopic')}".lower()
        if "event" in hint or "dvs" in hint:
            said.add(name)
        if "rgb" in hint or camchain[name].get("flip") is True:
            said.add(other)
    if len(said) > 1:
        raise RecordingError(
            f"{path} says both of cam0 and of cam1 that it is the event camera (by comment, rostopic or flip), but one "
            "is RGB; correct it."
        )
    return said.pop() if said else "cam1"


def _kalibr_camera(path: Path, name: str, entry: dict) -> Camera:
    stated = (entry.get("camera_model"), entry.get("distortion_model"))
    model, distortion_model = (
        " ".join(name.lower().split()) if isinstance(name, str) else repr(name) for name in stated
    )
    if model != "pinhole" or distortion_model not in KALIBR_MODELS:
        raise RecordingError(
            f"{path} holds camera_model {model} with distortion_model {distortion_model} of {name}, but pinhole with "
            f"one of {', '.join(KALIBR_MODELS)} was expected."
        )
    fx, fy, cx, cy = _numbers(path, name, entry, "intrinsics", (4,)).tolist()
    width, height = _numbers(path, name, entry, "resolution", (2,)).tolist()
    distortion: tuple[float, ...] = ()
    if distortion_model != "none":
        distortion = tuple(_numbers(path, name, entry, "distortion_coeffs", (4,)).tolist())
    with of_file(f"{path}, {name},"):
        return Camera(width, height, fx, fy, cx, cy, distortion, KALIBR_MODELS[distortion_model])


def _numbers(path: Path, name: str, entry: dict, key: str, shape: tuple[int, ...]) -> np.ndarray:
    try:
        values = np.array(entry.get(key), dtype=float)
    except (TypeError, ValueError, OverflowError):
        values = np.zeros(0)
    is_bool = [isinstance(value, bool) for value in np.array(entry.get(key), dtype=object).flat]
    if values.shape != shape or not np.isfinite(values).all() or any(is_bool):
        found = " ".join(str(entry.get(key)).split())[:80]
        raise RecordingError(
            f"{path} holds {key}: {found} of {name}, but {' x '.join(map(str, shape))} numbers were expected."
        )
    return values


def _read_undistorted_camera(folder: Path, number: int) -> Camera:
    """RGB (0) or event camera (1) after the preparation."""
    path = folder / "calib_undist_calib0.json"
    entries = read_json(path).get("intrinsics_undistorted")
    try:
        if not isinstance(entries, list) or len(entries) != 2:
            raise ValueError("two cameras were expected")
        fx, fy, cx, cy = parse_array([entries[number][key] for key in ("fx", "fy", "cx", "cy")], (4,)).tolist()
    except (ValueError, LookupError, TypeError) as error:
        raise RecordingError(
            f"{path} holds no intrinsics_undistorted with numbers fx fy cx cy (pixels) of the RGB and the event "
            "camera; prepare the recording again."
        ) from error
    with of_file(path):
        return Camera(*SENSOR_SIZE, fx, fy, cx, cy)


class EdsWriter(Writer):
    """Writer of EDS as it is unpacked. The published files do not state exposures; simulation.json does."""

    layout = "eds"
    start = CLOCK_START
    published_rig = (PUBLISHED_EVENT_CAMERA, PUBLISHED_RGB_CAMERA, PUBLISHED_EXTRINSICS)

    def add_events(self, events: Events) -> None:
        """Adds events up to 1 µs before the last frame, since E-NeRF's loader wants that to be last.

        Else as `Writer.add_events`.
        """
        until = int(np.searchsorted(events.t, self.setup.frame_times[-1] - 1000))
        super().add_events(Events(events.x[:until], events.y[:until], events.t[:until], events.p[:until]))

    def _check(self) -> None:
        self._check_size(SENSOR_SIZE)
        for camera in (self.setup.event_camera, self.setup.frame_camera):
            if camera.model == "lookup" or (camera.model == "radtan" and len(camera.distortion) != 4):
                raise FlagError(
                    f"The layout eds holds cameras without distortion, or with 4 coefficients of it (radtan or "
                    f"fisheye), but one of {len(camera.distortion)} of {camera.model} was asked for; choose another."
                )

    def _write_calibration(self) -> None:
        setup = self.setup
        rgb = _kalibr(setup.frame_camera, "/cam0/image_raw", 1)
        event = _kalibr(setup.event_camera, "/cam1/events", 0)
        event["T_cn_cnm1"] = setup.event_from_frame.tolist()
        content = f"cam0: # This is the RGB camera\n{_yaml(rgb)}cam1: # This is the event camera\n{_yaml(event)}"
        self._replace("camchain.yaml", content.encode())

    def _write_poses(self, trajectory: Trajectory) -> None:
        times = (trajectory.times + CLOCK_START).tolist()
        stamps = [f"{time // 10**9}.{time % 10**9:09d}" for time in times]
        header = "# timestamp[s] px py pz qx qy qz qw"
        content = encode_poses(header, stamps, trajectory.positions, trajectory.quaternions)
        self._replace(RAW_POSES, content)

    def _open_events(self) -> EventFiles:
        return Hdf5EventsFile(
            self.folder / "events.h5", "", {}, lambda times: self._to_us(times) + CLOCK_START // 1000, self.events_held
        )

    def _images(self, number: int, sharp: np.ndarray, blurred: np.ndarray | None) -> dict[str, np.ndarray]:
        path = f"{RAW_IMAGES}/frame_{number:010d}.png"
        if blurred is None:
            return {path: in_colour(sharp)}
        return {path: in_colour(blurred), f"sharp_images/{self._name(number)}.png": in_colour(sharp)}

    def _stamps(self, time: int) -> dict[str, str]:
        return {"images_timestamps.txt": f"{int(self._to_us(np.array(time))) + CLOCK_START // 1000}\n"}


def _yaml(value: dict) -> str:
    import yaml

    text = yaml.safe_dump(value, default_flow_style=None)
    return "".join(f"  {line}\n" for line in text.splitlines())


def _kalibr(camera: Camera, topic: str, other: int) -> dict[str, Any]:
    models = {ours: kalibrs for kalibrs, ours in KALIBR_MODELS.items()}
    return {
        "cam_overlaps": [other],
        "camera_model": "pinhole",
        "distortion_coeffs": list(map(float, camera.distortion)),
        "distortion_model": models[camera.model],
        "intrinsics": list(map(float, (camera.fx, camera.fy, camera.cx, camera.cy))),
        "resolution": [camera.width, camera.height],
        "rostopic": topic,
    }


FORMAT = Format(
    name="eds",
    command="eds-events",
    description="Events of EDS, as published or prepared by E-NeRF's reference code.",
    files=FILES,
    read=read,
    writer=EdsWriter,
)
