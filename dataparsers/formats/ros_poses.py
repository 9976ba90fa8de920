"""Poses from ROS bags: messages of poses, and the tree of frames of tf. The package rosbags reads ROS 1 and ROS 2."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.columns import unit_quaternions
from enerf_ns.dataparsers.formats.json_values import in_words
from enerf_ns.dataparsers.formats.ros_bags import messages_on, open_bag
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.trajectory import Trajectory

PATH = "nav_msgs/msg/Path"

POSE_TYPES: dict[str, Callable[[Any], list[tuple[Any, Any]]]] = {
    "geometry_msgs/msg/PoseStamped": lambda message: [(message.header.stamp, message.pose)],
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: [(message.header.stamp, message.pose.pose)],
    "geometry_msgs/msg/TransformStamped": lambda message: [(message.header.stamp, message.transform)],
    "nav_msgs/msg/Odometry": lambda message: [(message.header.stamp, message.pose.pose)],
    PATH: lambda message: [(pose.header.stamp, pose.pose) for pose in message.poses],
}
"""Stamps and poses, or transformations, of a message, by the type of the message."""

TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

Rows = tuple[Int64[np.ndarray, " poses"], Float64[np.ndarray, "poses 3"], Float64[np.ndarray, "poses 4"]]
"""Times (ns), positions (metres) and quaternions of poses, in order of time."""


@dataclass(frozen=True)
class PoseFlagNames:
    """Flags that choose the poses of a bag, as errors name them."""

    topic: str = "--poses-topic"
    frames: str = "--poses-frames"
    otherwise: str = ""
    """Words for another way to poses where a bag has none, such as ", or do so"."""


def read_bag(
    path: Path,
    topic: str | None,
    frames: tuple[str, str] | None,
    notes: list[str],
    flags: PoseFlagNames = PoseFlagNames(),
) -> Rows:
    """Returns the poses of a bag as they are written.

    Args:
        path: File of ROS 1, or folder or file of ROS 2.
        topic: Topic of the poses. Default: the only one with poses.
        frames: Names of the world and of the camera in the tree of tf. Default: the poses of a topic.
        notes: Gets sentences on repeated stamps and renormalised quaternions.
        flags: Names of the flags of topic and frames.

    Raises:
        RecordingError: The bag is damaged or lacks such poses, or rosbags is not installed.
        FlagError: The topic or the frames must be chosen, or are not in the bag.
    """
    if frames is not None:
        if topic is not None:
            raise FlagError(f"{flags.topic} and {flags.frames} were both given, but one is enough; leave one out.")
        return _between_frames(path, *frames, notes, flags)
    found: list[tuple[int, list[float]]] = []
    of_paths: dict[int, list[float]] = {}
    for kind, message in _messages(path, POSE_TYPES, topic, flags):
        rows = (_row(stamp, pose) for stamp, pose in POSE_TYPES[kind](message))
        if kind == PATH:  # each path repeats the poses of the one before, corrected by what was seen since
            of_paths.update(rows)
        else:
            found.extend(rows)
    return _in_order(path, [*found, *of_paths.items()], notes)


def _messages(
    path: Path, kinds: Collection[str], topic: str | None = None, flags: PoseFlagNames = PoseFlagNames()
) -> Iterator[tuple[str, Any]]:
    """Yields type and content of the messages of these types: on one topic, or of tf on all topics.

    A path is left out if a longer one follows, which holds its poses too.
    """
    with open_bag(path) as bag:
        able = [connection for connection in bag.connections if connection.msgtype in kinds]
        if kinds is POSE_TYPES:
            topics = sorted({connection.topic for connection in able})
            if topic not in topics if topic else len(topics) != 1:
                what = f"no poses on {topic}" if topic else f"{len(topics)} topics with poses"
                choice = (
                    f"give {flags.topic} as one of {in_words(topics)}" if topics else _of_tf(bag.connections, flags)
                )
                raise FlagError(f"{path} holds {what}; {choice}.")
            able = [connection for connection in able if connection.topic == (topic or topics[0])]
        messages = ((connection.msgtype, data) for connection, data in messages_on(bag, able))
        for (kind, data), (_, following) in pairwise(chain(messages, [("", b"")])):
            if kind != PATH or len(following) <= len(data):
                yield kind, bag.deserialize(data, kind)


def _of_tf(connections: Collection[Any], flags: PoseFlagNames) -> str:
    if any(connection.msgtype in TF_TYPES for connection in connections):
        return f"give {flags.frames} WORLD CAMERA, two frames of its tf"
    return f"record one of {in_words([*POSE_TYPES])}, or tf{flags.otherwise}"


def _row(stamp: Any, pose: Any) -> tuple[int, list[float]]:
    """Returns time (ns), position and quaternion of a pose or a transformation of ROS."""
    time = stamp.sec * 10**9 + stamp.nanosec
    is_pose = hasattr(pose, "position")
    position, turn = (pose.position, pose.orientation) if is_pose else (pose.translation, pose.rotation)
    return time, [position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w]


def _in_order(path: Path, found: list[tuple[int, list[float]]], notes: list[str]) -> Rows:
    times, first = np.unique(np.array([time for time, _ in found], np.int64), return_index=True)
    if len(times) < 2:
        raise RecordingError(f"{path} holds poses of {len(times)} different stamps, but at least 2 were expected.")
    if len(times) < len(found):
        notes.append(
            f"{len(found) - len(times):,} of {len(found):,} poses in {path.name} repeat a stamp and are left out."
        )
    values = np.array([row for _, row in found])[first]
    quaternions = unit_quaternions(path, values[:, :3], values[:, 3:], notes, lambda row: f"stamp {times[row]} ns")
    return times, values[:, :3], quaternions


def _between_frames(path: Path, world: str, camera: str, notes: list[str], flags: PoseFlagNames) -> Rows:
    """Returns the poses of a frame of tf in another one, at the stamps of the frame between them that moves most often.

    The other frames between them are interpolated at these stamps.
    """
    parents: dict[str, str] = {}
    found: dict[str, list[tuple[int, list[float]]]] = {}
    for _, message in _messages(path, TF_TYPES):
        for one in message.transforms:
            child = one.child_frame_id.strip("/")
            parents[child] = one.header.frame_id.strip("/")
            found.setdefault(child, []).append(_row(one.header.stamp, one.transform))
    if not parents:
        raise RecordingError(
            f"{path} holds no tf, but {flags.frames} names two of its frames; record /tf, or leave it out."
        )
    ways = []
    for name, flag in ((world, "The first"), (camera, "The second")):
        way = [name.strip("/")]
        while way[-1] in parents and parents[way[-1]] not in way:
            way.append(parents[way[-1]])
        if way[0] not in parents and way[0] not in parents.values():
            known = in_words(sorted({*parents, *parents.values()}))
            raise FlagError(
                f"{flag} of {flags.frames} is {name}, but {path} holds the frames {known}; give two of them."
            )
        ways.append(way)
    up, down = ways
    if up[-1] != down[-1]:
        raise RecordingError(
            f"{path} holds no transformations that join {world} and {camera}; record those between them."
        )
    apart = [[name for name in way if name not in other] for way, other in ((up, down), (down, up))]
    edges = {name: found[name] for names in apart for name in names}
    moving = {name: _in_order(path, rows, notes) for name, rows in edges.items() if len({row[0] for row in rows}) > 1}
    if not moving:
        raise RecordingError(
            f"{path} holds no motion between {world} and {camera}; give the frame of the moving camera."
        )
    times = max((rows[0] for rows in moving.values()), key=len)
    first, last = max(rows[0][0] for rows in moving.values()), min(rows[0][-1] for rows in moving.values())
    times = times[(times >= first) & (times <= last)]
    if len(times) < 2:
        raise RecordingError(f"{path} holds transformations between {world} and {camera} at different times only.")

    def along(names: list[str]) -> Float64[np.ndarray, "poses 4 4"]:
        """Poses of the first frame in the parent of the last one."""
        product = np.tile(np.eye(4), (len(times), 1, 1))
        for name in names:
            matrix = np.tile(np.eye(4), (len(times), 1, 1))
            if name in moving:
                matrix[:, :3] = Trajectory(*moving[name]).poses(torch.from_numpy(times)).numpy()
            else:
                values = np.array(edges[name][0][1])
                matrix[:, :3, :3], matrix[:, :3, 3] = Rotation.from_quat(values[3:]).as_matrix(), values[:3]
            product = matrix @ product
        return product

    poses = np.linalg.inv(along(apart[0])) @ along(apart[1])
    return times, poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()
