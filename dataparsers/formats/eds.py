"""Reader of EDS, as it is unpacked or as E-NeRF's reference code prepares it; and writer of EDS as it is unpacked.

As unpacked, with absolute times:

    events.h5                         x, y, t (µs), p
    stamped_groundtruth.txt           t_s px py pz qx qy qz qw; event camera to world, OpenCV axes, metres
    images/*.png                      of the RGB camera, with images_timestamps.txt, one stamp (µs) a line (optional)
    *camchain*.yaml                   Kalibr's calibration, here or in a calibration folder beside this one (optional)

As prepared, with times from the start of the recording:

    events.h5                         x, y, t (µs), p
    stamped_groundtruth_us.txt        as above, with t_us
    rectify_map_calib0.h5             rectify_map (480, 640, 2): place of each event pixel in the undistorted image
    calib_undist_calib0.json          intrinsics_undistorted of the RGB and of the event camera
    images_undistorted_calib0/*.png   with images_timestamps_us.txt (optional)

The preparation writes into the unpacked folder and converts events.h5 in place, so that one folder may hold both
layouts. The reader uses the files that are on the clock of the events. The published files do not state to which part
of the exposure the stamp of an image belongs. The reader takes it as the middle.

Hidalgo-Carrió et al., "Event-aided direct sparse odometry", CVPR 2022.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from enerf_ns.dataparsers.formats.format import Format
from enerf_ns.dataparsers.formats.frame_folders import check_one_each, images_in
from enerf_ns.dataparsers.formats.hdf5_events import Hdf5Events, Hdf5EventsFile, read_rectified_camera
from enerf_ns.dataparsers.formats.json_values import Value, open_json
from enerf_ns.dataparsers.formats.text_tables import read_poses, read_times
from enerf_ns.dataparsers.formats.writer import EventFiles, Writer, encode_poses
from enerf_ns.dataparsers.formats.yaml_values import KALIBR_MODELS, find_calibration, kalibr_camera, read_yaml
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.files import check_image_sizes, in_colour
from enerf_ns.dataparsers.recording.recording import EventRecording, Events, Frames
from enerf_ns.dataparsers.recording.time_units import Times, check_units, check_usual_units
from enerf_ns.dataparsers.recording.trajectory import Trajectory

FILES = ("events.h5", "stamped_groundtruth*.txt", "images_timestamps*.txt")

SENSOR_SIZE = (640, 480)
"""Width and height of the event camera, and of the images, in pixels."""

RAW_POSES, PREPARED_POSES = "stamped_groundtruth.txt", "stamped_groundtruth_us.txt"
UNITS = {RAW_POSES: "s", PREPARED_POSES: "us"}
"""Unit of the times in each file of poses."""
RAW_IMAGES, PREPARED_IMAGES = "images", "images_undistorted_calib0"
STAMPS = ("images_timestamps.txt", "images_timestamps_us.txt")

CLOCK_START = 1000 * 10**9
"""Time (ns) in the files of a written recording at the simulation's time 0."""

OFFSET_TOLERANCE = 2000
"""Largest rounding of a time by the preparation, nanoseconds."""

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
"""Pose of the RGB camera in the axes of the event camera, metres. It and the two cameras above are the published
calibration of EDS, which is used if a recording has none."""

Poses = tuple[Int64[np.ndarray, " poses"], Float64[np.ndarray, "poses 3"], Float64[np.ndarray, "poses 4"]]
"""Times (ns), positions and quaternions of poses."""


def read(folder: Path) -> EventRecording:
    """Reads everything but the events, which are read when they are needed.

    As unpacked, the recording's zero of time is the earliest first stamp among events, frames and poses. As prepared,
    it is the zero of the files.

    Args:
        folder: The folder with the files that the module describes.

    Raises:
        RecordingError: A file is missing, empty or cannot be used, or the files share no clock.
    """
    notes: list[str] = []
    events = Hdf5Events(folder / "events.h5")
    poses_file, (pose_times, positions, quaternions) = _read_poses(folder, events, notes)
    prepared = poses_file.name == PREPARED_POSES
    poses_in = poses_file, UNITS[poses_file.name]
    image_files, image_times, stamps_file = _read_image_list(
        folder, prepared, events, Times.of_rows("poses", *poses_in, pose_times), notes
    )
    zero = 0 if prepared else int(min(events.first_time, pose_times[0], *image_times[:1]))
    trajectory = Trajectory(pose_times - zero, positions, quaternions)

    camchain = find_calibration(folder, "*camchain*.yaml")
    rgb_camera, camera, event_from_rgb = PUBLISHED_RGB_CAMERA, PUBLISHED_EVENT_CAMERA, PUBLISHED_EXTRINSICS
    if camchain is not None:
        rgb_camera, camera, event_from_rgb = _read_camchain(camchain)
    rectify_map_file = folder / "rectify_map_calib0.h5"
    raw_events = not (prepared and rectify_map_file.exists())
    if not raw_events:
        camera = read_rectified_camera(rectify_map_file, _read_undistorted_camera(folder, 1))
    frames = None
    if image_files:
        if image_files[0].parent.name == PREPARED_IMAGES:
            rgb_camera = _read_undistorted_camera(folder, 0)
        check_image_sizes(image_files, rgb_camera.width, rgb_camera.height)
        frames = Frames(image_files, image_times - zero, rgb_camera, trajectory.of_mounted(event_from_rgb))
    if frames is not None or raw_events:
        if camchain is None:
            notes.append(
                f"The published calibration of EDS is used, since there is no Kalibr camchain (*camchain*.yaml) in "
                f"{folder.name} or in a calibration folder beside it."
            )
        elif camchain.parent != folder:
            notes.append(f"The calibration is read from {camchain}.")
    return EventRecording(
        path=folder,
        format="eds",
        camera=camera,
        trajectory=trajectory,
        stream_events=lambda: events.stream(zero),
        event_files=(events.path,),
        zero=zero,
        frames=frames,
        notes=tuple(notes),
        num_events=events.num_events,
        times_in={"events": (events.path, "us"), "poses": poses_in, "frames": (stamps_file, "us")},
    )


def _read_poses(folder: Path, events: Hdf5Events, notes: list[str]) -> tuple[Path, Poses]:
    """Returns the file of the poses on the clock of the events, and these poses."""
    found: dict[Path, Poses] = {}
    notes_of: dict[Path, list[str]] = {}
    for name, unit in UNITS.items():
        if (path := folder / name).exists():
            found[path] = read_poses(path, unit, notes_of.setdefault(path, []))
    if not found:
        raise RecordingError(
            f"{folder} holds neither {RAW_POSES} (t_s px py pz qx qy qz qw) nor {PREPARED_POSES}, which hold the poses "
            "of the event camera; add one."
        )
    times = {path: poses[0] for path, poses in found.items()}
    best = _on_the_clock_of(events, "poses", times)
    if len(found) == 2:
        raw_times, prepared_times = times.values()
        _check_offset(folder, int(raw_times[0] - prepared_times[0]))
        both = all(_overlap(events, rows) > 0 for rows in times.values())
        if both and raw_times[0] > prepared_times[-1]:
            raise RecordingError(
                f"{events.path} holds times of the clock of {RAW_POSES} and of {PREPARED_POSES}, as an interrupted "
                "preparation leaves them; unpack it again."
            )
        notes.append(f"Of {RAW_POSES} and {PREPARED_POSES}, {best.name} is used, which is on the clock of events.h5.")
    notes += notes_of[best]
    return best, found[best]


def _check_offset(folder: Path, offset: int) -> None:
    """Checks the time (ns) between both tables of poses against the offset that the preparation noted."""
    path = folder / "t_offset_us.txt"
    if path.exists():
        stated = int(read_times(path, "us")[0])
        if abs(stated - offset) > OFFSET_TOLERANCE:
            raise RecordingError(
                f"{path} states {stated / 1000:.0f} µs between {RAW_POSES} and {PREPARED_POSES}, but their first times "
                f"are {offset / 1000:.0f} µs apart; remove the files of another recording."
            )


def _read_image_list(
    folder: Path, prepared: bool, events: Hdf5Events, poses: Times, notes: list[str]
) -> tuple[tuple[Path, ...], Int64[np.ndarray, " images"], Path]:
    """Returns the images that are used, their stamps on the clock of the events, and the file of the stamps."""
    images = {folder / name: images_in(folder / name) for name in (RAW_IMAGES, PREPARED_IMAGES)}
    images = {path: files for path, files in images.items() if path.is_dir()}
    of_clock, other = (PREPARED_IMAGES, RAW_IMAGES) if prepared else (RAW_IMAGES, PREPARED_IMAGES)
    place = next((folder / name for name in (of_clock, other) if images.get(folder / name)), next(iter(images), None))
    stamps = {folder / name: read_times(folder / name, "us") for name in STAMPS if (folder / name).exists()}
    if place is None or not (images[place] or stamps):
        if stamps:
            notes.append(
                f"There are stamps of images, but no folder {RAW_IMAGES}/ or {PREPARED_IMAGES}/, so no frame is used."
            )
        return (), np.zeros(0, np.int64), folder
    if not stamps:
        raise RecordingError(
            f"{folder} holds {len(images[place]):,} images, but {' and '.join(STAMPS)} are missing; add the one that "
            "holds their stamps (t_us)."
        )
    path = _on_the_clock_of(events, "frames", stamps, poses)
    check_one_each(place, len(images[place]), path, len(stamps[path]), "stamps")
    return images[place], stamps[path], path


def _overlap(events: Hdf5Events, times: Int64[np.ndarray, " rows"]) -> int:
    """Returns for how many ns there are both events and these times, or minus the time between both."""
    return int(min(times[-1], events.last_time) - max(times[0], events.first_time))


def _on_the_clock_of(
    events: Hdf5Events, kind: str, tables: dict[Path, Int64[np.ndarray, " rows"]], *known: Times
) -> Path:
    """Returns the file whose times (ns) overlap most with the times of the events.

    Args:
        events: The events.
        kind: "poses" or "frames".
        tables: The times in each file.
        known: Other times on this clock.
    """
    best = max(tables, key=lambda path: _overlap(events, tables[path]))
    if _overlap(events, tables[best]) < 0:
        rows = Times.of_rows(kind, best, UNITS.get(best.name, "us"), tables[best])
        columns = [events.times(SENSOR_SIZE[0] * SENSOR_SIZE[1]), *known, rows]
        check_units(best.parent, columns)
        check_usual_units(best.parent, columns)
        ranges = " and ".join(f"{path.name} times from {_span(rows[0], rows[-1])}" for path, rows in tables.items())
        raise RecordingError(
            f"{best.parent} holds {ranges}, but events.h5 times from {_span(events.first_time, events.last_time)}; "
            f"they must be on one clock, in µs except {RAW_POSES}, which is in seconds."
        )
    return best


def _span(first: int, last: int) -> str:
    return f"{first * 1e-9:.6f} s to {last * 1e-9:.6f} s"


def _read_camchain(path: Path) -> tuple[Camera, Camera, Float64[np.ndarray, "4 4"]]:
    """Returns the RGB camera, the event camera, and the pose of the RGB camera in the axes of the event camera."""
    text, camchain = read_yaml(path, "a Kalibr camchain")
    rgb_camera, camera = (kalibr_camera(camchain[name]) for name in ("cam0", "cam1"))
    event_from_rgb = camchain["cam1"]["T_cn_cnm1"].pose()
    if _event_camera(text, camchain) == "cam0":
        rgb_camera, camera, event_from_rgb = camera, rgb_camera, np.linalg.inv(event_from_rgb)
    if (camera.width, camera.height) != SENSOR_SIZE:
        raise RecordingError(
            f"{path} calibrates an event camera of {camera.width} x {camera.height} pixels, but that of EDS has "
            f"{SENSOR_SIZE[0]} x {SENSOR_SIZE[1]}; give the calibration of this recording."
        )
    return rgb_camera, camera, event_from_rgb


def _event_camera(text: str, camchain: Value) -> str:
    """Returns cam1, or cam0 if a comment, a topic, or the flip that only RGB has, says so."""
    named = set()
    for name, other in (("cam0", "cam1"), ("cam1", "cam0")):
        comment = re.search(rf"^{name}:[ \t]*#(.*)$", text, re.MULTILINE)
        hint = f"{comment[1] if comment else ''} {camchain.found[name].get('rostopic')}".lower()
        if "event" in hint or "dvs" in hint:
            named.add(name)
        if "rgb" in hint or camchain.found[name].get("flip") is True:
            named.add(other)
    if len(named) > 1:
        raise RecordingError(
            f"{camchain.path} names both cam0 and cam1 as the event camera (by comment, rostopic or flip), but one is "
            "RGB; correct it."
        )
    return named.pop() if named else "cam1"


def _read_undistorted_camera(folder: Path, number: int) -> Camera:
    """Returns the RGB camera (0) or the event camera (1) after the preparation."""
    entry = open_json(folder / "calib_undist_calib0.json")["intrinsics_undistorted"].values(2)[number]
    return entry.camera(SENSOR_SIZE, entry.each("fx", "fy", "cx", "cy"))


class EdsWriter(Writer):
    """Writer of EDS as it is unpacked. Only simulation.json states the exposure, since the published files do not."""

    layout = "eds"
    start = CLOCK_START
    published_rig = (PUBLISHED_EVENT_CAMERA, PUBLISHED_RGB_CAMERA, PUBLISHED_EXTRINSICS)

    def add_events(self, events: Events) -> None:
        """Adds events up to 1 µs before the last frame, since E-NeRF's loader expects the last frame to be last."""
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
