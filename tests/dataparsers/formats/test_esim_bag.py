from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from recordings import joined
from test_esim_npz import (
    DISTORTIONS,
    HEIGHT,
    MATRIX,
    MODELS,
    NUM_EVENTS,
    NUM_VIEWS,
    WIDTH,
    check_events,
    check_reprojection,
    events,
    trajectory,
    write_npz,
    write_views,
)

from enerf_ns.dataparsers.formats import esim_bag, esim_npz
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError

rosbag1 = pytest.importorskip("rosbags.rosbag1", reason="rosbags is an optional extra of the project")
typesys = pytest.importorskip("rosbags.typesys")

STORE = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
STORE.register(typesys.get_types_from_msg("uint16 x\nuint16 y\ntime ts\nbool polarity", "dvs_msgs/msg/Event"))
STORE.register(
    typesys.get_types_from_msg(
        "std_msgs/Header header\nuint32 height\nuint32 width\ndvs_msgs/Event[] events", "dvs_msgs/msg/EventArray"
    )
)

CONF = """--random_seed=50
# --contrast_threshold_pos=9
--contrast_threshold_pos=0.3
-contrast_threshold_neg=0.25
--contrast_threshold_sigma_pos=0.03
--refractory_period_ns=8000000

--contrast_threshold_pos=0.375
--simulate_color_events=true
--path_to_output_bag=/tmp/out.bag
"""


def message(name: str, **fields: object) -> object:
    return STORE.types[name](**fields)


def time(nanoseconds: int) -> object:
    return message("builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


def header(nanoseconds: int, frame: str = "map") -> object:
    return message("std_msgs/msg/Header", seq=0, stamp=time(nanoseconds), frame_id=frame)


def event_arrays(size: tuple[int, int] = (WIDTH, HEIGHT), per_message: int = 300) -> list[tuple[str, int, object]]:
    """The events in messages, as ESIM sends them: each stamped with the time of its last event."""
    columns, messages = events(), []
    rows = list(zip(columns["position"].tolist(), columns["timestamp"].tolist(), columns["polarity"], strict=True))
    for start in range(0, NUM_EVENTS, per_message):
        piece = [
            message("dvs_msgs/msg/Event", x=x, y=y, ts=time(t), polarity=bool(p))
            for (x, y), t, p in rows[start : start + per_message]
        ]
        stamp = rows[min(start + per_message, NUM_EVENTS) - 1][1]
        array = message("dvs_msgs/msg/EventArray", header=header(stamp), height=size[1], width=size[0], events=piece)
        messages.append((esim_bag.EVENTS, stamp, array))
    return messages


def pose_messages(order: np.ndarray | None = None) -> list[tuple[str, int, object]]:
    times, positions, quaternions = trajectory()
    messages = []
    for i in range(len(times)) if order is None else order:
        pose = message(
            "geometry_msgs/msg/Pose",
            position=message("geometry_msgs/msg/Point", **dict(zip("xyz", positions[i].tolist(), strict=True))),
            orientation=message(
                "geometry_msgs/msg/Quaternion", **dict(zip("xyzw", quaternions[i].tolist(), strict=True))
            ),
        )
        stamped = message("geometry_msgs/msg/PoseStamped", header=header(int(times[i])), pose=pose)
        messages.append((esim_bag.POSES, int(times[i]), stamped))
    return messages


def camera_info(model: str = "plumb_bob", size: tuple[int, int] = (WIDTH, HEIGHT)) -> tuple[str, int, object]:
    region = message("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    info = message(
        "sensor_msgs/msg/CameraInfo",
        header=header(int(trajectory()[0][0]), ""),
        width=size[0],
        height=size[1],
        distortion_model=model or "plumb_bob",
        D=DISTORTIONS[model],
        K=MATRIX.ravel(),
        R=np.eye(3).ravel(),
        P=np.eye(3, 4).ravel(),
        binning_x=0,
        binning_y=0,
        roi=region,
    )
    return esim_bag.CAMERA, int(trajectory()[0][0]), info


def write_bag(
    path: Path, messages: list[tuple[str, int, object]], compression: str | None = None, sort: bool = True
) -> None:
    writer = rosbag1.Writer(path)
    writer.chunk_threshold = 20_000
    if compression:
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression])
    with writer:
        connections = {}
        for topic, stamp, content in sorted(messages, key=lambda entry: entry[1]) if sort else messages:
            kind = content.__msgtype__  # type: ignore[attr-defined]
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], stamp, STORE.serialize_ros1(content, kind))


def write_recording(folder: Path, model: str = "plumb_bob", compression: str | None = None) -> Path:
    folder.mkdir(parents=True)
    write_bag(folder / "esim.bag", [camera_info(model), *pose_messages(), *event_arrays()], compression)
    (folder / "esim.conf").write_text(CONF)
    return folder


@pytest.mark.parametrize("model", list(MODELS))
@pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
def test_reads_what_was_written(tmp_path: Path, model: str, compression: str | None):
    recording = esim_bag.read(write_recording(tmp_path / "easy", model, compression))
    check_events(recording)
    check_reprojection(recording, model)
    times, positions, quaternions = trajectory()
    np.testing.assert_array_equal(recording.trajectory.times, times)
    np.testing.assert_array_equal(recording.trajectory.positions, positions)
    np.testing.assert_allclose(recording.trajectory.quaternions, quaternions, atol=1e-15)
    distortion = tuple(DISTORTIONS[model].tolist())
    assert recording.camera == Camera(WIDTH, HEIGHT, 150.0, 152.0, 80.5, 58.5, distortion, MODELS[model])
    assert recording.contrast_thresholds == (0.375, 0.25)
    assert recording.refractory_period == 8_000_000
    assert recording.bayer_pattern == "RGGB"
    assert recording.frames is recording.blurred_frames is recording.held_out_frames is None
    assert list(recording.notes) == []
    assert len(index_events(recording)) == NUM_EVENTS


def test_bag_and_npz_of_a_recording_are_the_same(tmp_path: Path):
    """But for the single precision of the .npz files' calibration."""
    bag = esim_bag.read(write_recording(tmp_path / "scene/raw"))
    npz = esim_npz.read(write_npz(tmp_path / "scene/prepared"))
    for name in "xytp":
        np.testing.assert_array_equal(
            getattr(joined(bag.stream_events()), name), getattr(joined(npz.stream_events()), name)
        )
    for name in ("times", "positions", "quaternions"):
        np.testing.assert_array_equal(getattr(bag.trajectory, name), getattr(npz.trajectory, name))
    np.testing.assert_allclose(bag.camera.pixel_directions(), npz.camera.pixel_directions(), rtol=0, atol=1e-7)
    for name in ("contrast_thresholds", "refractory_period", "bayer_pattern"):
        assert getattr(bag, name) == getattr(npz, name)


def test_the_views_of_the_scene_are_held_out(tmp_path: Path):
    folder = write_recording(tmp_path / "scene/easy")
    write_views(tmp_path / "scene/views", "val")
    frames = esim_bag.read(folder).held_out_frames
    assert frames is not None and len(frames.filenames) == NUM_VIEWS


@pytest.mark.parametrize("at_a_time", [1, 1000, 1200, 10**6])
def test_messages_are_put_together_to_pieces(tmp_path: Path, at_a_time: int, monkeypatch: pytest.MonkeyPatch):
    recording = esim_bag.read(write_recording(tmp_path / "easy"))
    monkeypatch.setattr(esim_bag, "EVENTS_AT_A_TIME", at_a_time)
    sizes = [len(piece) for piece in recording.stream_events()]
    per_piece = -(-at_a_time // 300) * 300
    assert sizes == [min(per_piece, NUM_EVENTS - start) for start in range(0, NUM_EVENTS, per_piece)]
    check_events(recording)


def test_poses_that_come_late_or_twice_are_mended(tmp_path: Path):
    folder = write_recording(tmp_path / "easy")
    (folder / "esim.bag").unlink()
    poses = pose_messages()
    late = esim_bag.POSES, poses[12][1], poses[7][2]
    twice = esim_bag.POSES, poses[30][1], poses[30][2]
    write_bag(folder / "esim.bag", [camera_info(), *poses[:7], *poses[8:], late, twice, *event_arrays()])
    recording = esim_bag.read(folder)
    assert list(recording.notes) == [
        "The poses in esim.bag go back in time 1 times and are sorted.",
        "1 of 41 poses in esim.bag follow another one within 1 µs and are left out.",
    ]
    np.testing.assert_array_equal(recording.trajectory.times, trajectory()[0])
    check_reprojection(recording, "plumb_bob")


def test_without_esim_conf_the_sensor_is_grey_and_its_thresholds_are_unknown(tmp_path: Path):
    folder = write_recording(tmp_path / "easy")
    (folder / "esim.conf").unlink()
    recording = esim_bag.read(folder)
    assert recording.contrast_thresholds is recording.bayer_pattern is None
    assert recording.refractory_period == 0
    assert len(recording.notes) == 1 and "no esim.conf" in recording.notes[0]


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ("", ((1.0, 1.0), 0, None)),
        ("--simulate_color_events", ((1.0, 1.0), 0, "RGGB")),
        ("--simulate_color_events=1\r\n--refractory_period_ns=5\r\n", ((1.0, 1.0), 5, "RGGB")),
        ("-simulate_color_events\n--nosimulate_color_events", ((1.0, 1.0), 0, None)),
        ("--simulate_color_events=False\n--contrast_threshold_neg=.1", ((1.0, 0.1), 0, None)),
        ("#--simulate_color_events\n", ((1.0, 1.0), 0, None)),
    ],
)
def test_flags_as_the_simulator_reads_them(tmp_path: Path, flags: str, expected: tuple):
    path = tmp_path / "esim.conf"
    path.write_bytes(flags.encode())
    assert esim_bag._read_flags(path) == expected


def test_without_rosbags_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = write_recording(tmp_path / "easy")
    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)
    with pytest.raises(RecordingError, match=r"pip install 'enerf-ns\[bag\]'\."):
        esim_bag.read(folder)


def bag_of(make: Callable[[], list[tuple[str, int, object]]]) -> Callable[[Path], None]:
    def written(folder: Path) -> None:
        (folder / "esim.bag").unlink()
        write_bag(folder / "esim.bag", make())

    return written


def cut(share: float) -> Callable[[Path], object]:
    def truncated(folder: Path) -> None:
        data = (folder / "esim.bag").read_bytes()
        (folder / "esim.bag").write_bytes(data[: int(share * len(data))])

    return truncated


def write(name: str, content: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_text(content)


def unfinished(folder: Path) -> None:
    """As a recorder leaves it that did not come to write the index."""
    data = (folder / "esim.bag").read_bytes()
    place = data.index(b"index_pos=") + len(b"index_pos=")
    (folder / "esim.bag").write_bytes(data[:place] + bytes(8) + data[place + 8 :])


def too_many_events(folder: Path) -> None:
    """A message that states more events than it holds."""
    size = np.array([HEIGHT, WIDTH, 300], "<u4").tobytes()
    data = (folder / "esim.bag").read_bytes()
    assert size in data
    (folder / "esim.bag").write_bytes(data.replace(size, np.array([HEIGHT, WIDTH, 301], "<u4").tobytes()))


BAD_INPUT = {
    "no bag": (lambda folder: (folder / "esim.bag").unlink(), "esim.bag is missing; a ROS 1 bag was expected there"),
    "empty": (write("esim.bag", ""), "esim.bag is empty; a ROS 1 bag was expected"),
    "no bag in it": (write("esim.bag", "hello\n"), "esim.bag cannot be read as a ROS 1 bag (it does not begin with"),
    "cut in the middle": (cut(0.5), "esim.bag cannot be read as a ROS 1 bag (Bag index looks damaged"),
    "cut near its end": (cut(0.99), "esim.bag cannot be read as a ROS 1 bag (Bag index looks damaged"),
    "cut at its beginning": (cut(0.001), "esim.bag cannot be read as a ROS 1 bag"),
    "unfinished": (unfinished, "esim.bag cannot be read as a ROS 1 bag (Bag is not indexed, reindex before reading)"),
    "no events": (
        bag_of(lambda: [camera_info(), *pose_messages()]),
        "esim.bag lacks the topic /cam0/events, and holds /cam0/camera_info, /cam0/pose",
    ),
    "no poses": (bag_of(lambda: [camera_info(), *event_arrays()]), "esim.bag lacks the topic /cam0/pose, and holds"),
    "no calibration": (
        bag_of(lambda: [*pose_messages(), *event_arrays()]),
        "esim.bag lacks the topic /cam0/camera_info, and holds /cam0/events, /cam0/pose",
    ),
    "nothing": (bag_of(list), "esim.bag lacks the topic /cam0/pose, and holds none"),
    "one pose": (
        bag_of(lambda: [camera_info(), *pose_messages()[:1], *event_arrays()]),
        "esim.bag holds 1 poses, but at least 2 were expected",
    ),
    "events of another type": (
        bag_of(lambda: [camera_info(), *pose_messages(), (esim_bag.EVENTS, 10**7, pose_messages()[0][2])]),
        "holds messages of type geometry_msgs/msg/PoseStamped on /cam0/events, but dvs_msgs/msg/EventArray",
    ),
    "too many events": (too_many_events, "esim.bag holds a message on /cam0/events whose 3,9"),
    "calibration for another resolution": (
        bag_of(lambda: [camera_info(size=(320, 240)), *pose_messages(), *event_arrays()]),
        "esim.bag holds a calibration for 320 x 240 pixels, but events of a sensor of 160 x 120",
    ),
    "events backwards": (
        bag_of(lambda: [camera_info(), *pose_messages(), *[(topic, 1, m) for topic, _, m in event_arrays()[::-1]]]),
        "esim.bag, event 101 goes back in time",
    ),
    "threshold no number": (
        write("esim.conf", "--contrast_threshold_neg=low"),
        "esim.conf holds --contrast_threshold_neg=low, where a number was expected",
    ),
    "threshold left out": (
        write("esim.conf", "--contrast_threshold_pos"),
        "esim.conf holds --contrast_threshold_pos=, where a number was expected",
    ),
    "threshold negative": (
        write("esim.conf", "--contrast_threshold_neg=-0.2"),
        "esim.conf holds the contrast thresholds 1 (of on events) and -0.2 (of off events), but both must be",
    ),
    "refractory period negative": (
        write("esim.conf", "--refractory_period_ns=-5"),
        "esim.conf holds the refractory period -5 ns, but from 0",
    ),
    "colour maybe": (
        write("esim.conf", "--simulate_color_events=maybe"),
        "esim.conf holds --simulate_color_events=maybe, where true or false was expected",
    ),
    "flags not text": (
        lambda folder: (folder / "esim.conf").write_bytes(b"\xff\xfe\x00"),
        "esim.conf cannot be read as flags of ESIM",
    ),
}


@pytest.mark.parametrize("name", list(BAD_INPUT))
def test_bad_input_gives_one_clear_sentence(tmp_path: Path, name: str):
    break_it, message = BAD_INPUT[name]
    folder = write_recording(tmp_path / "easy")
    break_it(folder)
    with pytest.raises(RecordingError) as error:
        len(index_events(esim_bag.read(folder)))
    text = str(error.value)
    assert message in text and str(folder) in text
    assert text.endswith(".") and "\n" not in text and not re.search(r"[a-z\d)]\. [A-Z]", text)


def test_a_damaged_bag_gives_a_clear_sentence_if_it_cannot_be_read(tmp_path: Path):
    """Bytes of its head, of the index at its end and between; without checksums, changed numbers may go unseen."""
    folder = write_recording(tmp_path / "easy", "")
    path = folder / "esim.bag"
    data = path.read_bytes()
    place = data.index(b"index_pos=") + len(b"index_pos=")
    index = int.from_bytes(data[place : place + 8], "little")
    rng = np.random.default_rng(5)
    places = [*rng.integers(0, 80, 20), *rng.integers(index, len(data), 60), *rng.integers(4096, index, 20)]
    refused = 0
    for position in places:
        damaged = bytearray(data)
        damaged[position] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        try:
            for _ in esim_bag.read(folder).stream_events():
                pass
        except RecordingError as error:
            refused += 1
            assert "esim.bag" in str(error)
    assert refused > 30
