"""Problems of what a recording holds beside its events, and questions that it leaves open."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float64

from enerf_ns.dataparsers.inspection.frame_changes import FEWEST_PAIRS, FrameChanges
from enerf_ns.dataparsers.inspection.problems import OpenQuestion, Problem
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.picture_depth import brightness
from enerf_ns.dataparsers.recording.recording import EventRecording, Frames, percent
from enerf_ns.dataparsers.scene.depth_range import Parallax, recording_parallax
from enerf_ns.dataparsers.scene.edge_depth import edge_depth

SAMPLED_FRAMES = 12
"""Most frames and depth maps that are looked at, evenly taken."""

BLACK, WHITE = 0.1, 0.98
"""Brightness that the brightest pixel of all frames must reach, and that the darkest must not reach."""

LEAST_SPREAD = 0.01
"""Smallest difference of brightness between the 1st and the 99th percentile of a frame that shows something."""

FARTHEST_MOUNT = 2.0
"""Largest distance between the cameras of events and of frames, metres. Rigs on cars have less than 1 m."""

NUM_VIEWS = 6
"""Number of views whose edges are compared with depth maps: half as many as are shown, to start training sooner."""

FEWEST_EDGES = 50
"""Fewest edges whose depth is compared with depth maps."""

ALIKE, MIN_SHARE_ALIKE = 0.2, 0.4
"""Largest relative difference of ratios of depth that count as alike, and smallest share of edges with such a ratio in
depth maps that are right up to their unit."""

DEPTH_TOLERANCE = 0.2
"""Largest relative difference between depth maps and the depth of edges that is no problem."""

COARSE = 5.0
"""Largest factor between the medians of depth maps and of the parallax that is no problem, where too few edges have a
depth: edges are nearer than plain surfaces, by a factor of up to 1.7 in simulated scenes."""

UNITS = {1000.0: "millimetres", 100.0: "centimetres", 3.281: "feet", 0.001: "kilometres"}
"""Units of depth, by how many of them are a metre."""


@dataclass
class Evidence:
    """Problems of what a recording holds beside its events, and questions that nothing in it answers."""

    problems: list[Problem] = field(default_factory=list)
    unknown: list[OpenQuestion] = field(default_factory=list)

    @classmethod
    def of(cls, recording: EventRecording) -> Evidence:
        """Compares cameras, depth range, frames and depth maps with the events. Takes a second, and with depth maps
        some seconds. Without poses, depths are not compared.

        Args:
            recording: Its index is made if it is not there yet.

        Raises:
            RecordingError: The events or a frame cannot be used.
        """
        parallax = recording_parallax(recording) if recording.has_poses else None
        found = cls([*_camera_problems(recording)])
        if parallax is not None:
            found.problems += _range_problems(recording, parallax)
        shown = [*_level_problems(recording)]
        found.problems += shown
        if parallax is not None:
            found._add(_depth_maps(recording, parallax))
        found._add(_polarity(recording, parallax, "the frames show nothing" if shown else ""))
        return found

    def _add(self, answer: Problem | OpenQuestion | None) -> None:
        if isinstance(answer, Problem):
            self.problems.append(answer)
        elif answer is not None:
            self.unknown.append(answer)


def _camera_problems(recording: EventRecording) -> Iterator[Problem]:
    frames = recording.camera_frames
    cameras: dict[str, Camera] = {"event camera": recording.camera}
    if frames is not None and frames.camera != recording.camera:
        cameras["frame camera"] = frames.camera
    for name, camera in cameras.items():
        if not (-0.5 <= camera.cx <= camera.width - 0.5 and -0.5 <= camera.cy <= camera.height - 0.5):
            yield Problem(
                f"The principal point of the {name}, ({camera.cx:g}, {camera.cy:g}), lies outside of its "
                f"{camera.width} x {camera.height} pixels.",
                "Check cx and cy, and that the calibration is of this resolution. If the sensor is cropped, take the "
                "first column and row off cx and cy; then such a point can be right.",
            )
    if frames is not None and frames.trajectory is not recording.trajectory:
        time = torch.as_tensor(frames.times[len(frames.times) // 2])
        if recording.trajectory.covers(time):
            places = [owner.trajectory.poses(time).numpy()[:, 3] for owner in (recording, frames)]
            apart = float(np.linalg.norm(places[0] - places[1]))
            if apart > FARTHEST_MOUNT:
                yield Problem(
                    f"The cameras of events and of frames are {apart:,.3g} m apart.",
                    "Check that the extrinsics are in metres and not in millimetres.",
                )


def _range_problems(recording: EventRecording, parallax: Parallax) -> Iterator[Problem]:
    if recording.depth_range is not None and parallax.contradicts(recording.depth_range):
        near, far = recording.depth_range
        shown = "{:.3g} m to {:.3g} m".format(*parallax.depth_range)
        yield Problem(
            f"The recording states a depth range of {near:.3g} m to {far:.3g} m, but the parallax of the events shows "
            f"{shown}.",
            "State it in the unit of the poses, or leave it out, so that it is measured.",
        )


def _sampled(number: int) -> list[int]:
    return np.unique(np.linspace(0, number - 1, SAMPLED_FRAMES).round().astype(int)).tolist()


def _level_problems(recording: EventRecording) -> Iterator[Problem]:
    """Reports frames that are black, white or of one brightness, or all the same."""
    for name, frames in {"frames": recording.frames, "blurred frames": recording.blurred_frames}.items():
        if frames is None:
            continue
        images = [brightness(frames.image(number)) for number in _sampled(len(frames.times))]
        darkest, brightest = min(float(image.min()) for image in images), max(float(image.max()) for image in images)
        spread = max(float(np.ptp(np.percentile(image, [1, 99]))) for image in images)
        what, advice = "", "Export the frames again, or leave them out, so that events alone are learned from."
        if brightest < BLACK:
            what = f"are black: their brightest pixel has {percent(brightest)} of full brightness"
            advice = "Check the exposure and the value of full brightness (white_level), or leave the frames out."
        elif darkest > WHITE:
            what = f"are white: their darkest pixel has {percent(darkest)} of full brightness"
        elif spread < LEAST_SPREAD:
            what = f"show nothing: the brightness of a frame spreads over {percent(spread)} of full brightness"
        elif len(images) > 1 and all(np.array_equal(image, images[0]) for image in images):
            what = "are all the same picture"
        if what:
            yield Problem(f"The {name} {what}.", advice)


def _polarity(recording: EventRecording, parallax: Parallax | None, no_frames: str) -> Problem | OpenQuestion | None:
    question = "whether on and off events are exchanged, and whether events and frames are mirrored"
    frames = recording.camera_frames
    if frames is None or no_frames:
        return OpenQuestion(question, no_frames or "there are no frames")
    depths = recording.depth_range or (parallax.depth_range if parallax and parallax.is_shown else (1.0, 1.0))
    changes = FrameChanges.of(recording, frames, float(np.sqrt(depths[0] * depths[1])))
    value = f"{changes.correlation:.2f} ± {changes.error:.2f}"
    if changes.num_pairs < FEWEST_PAIRS:
        return OpenQuestion(question, f"only {changes.num_pairs} pairs of frames have enough events between them")
    if changes.contradicts:
        return Problem(
            f"The frames do not show what the events show: they correlate at most at {value}.",
            "Check that the frames are those of this recording, in the order of their stamps, and on the clock of the "
            "events.",
        )
    if not changes.tells:
        return OpenQuestion(question, f"events and the changes of the frames correlate only at {value}")
    is_inverted, is_mirrored = changes.correlation < 0, changes.orientation != "as they are"
    if is_mirrored:
        inverted = " and the polarity is inverted" if is_inverted else ""
        return Problem(
            f"Events fit the frames only if the frames are {changes.orientation}{inverted}: they then correlate with "
            f"the changes of brightness at {value}.",
            "If the poses fit the events, turn the frames; otherwise, write width - 1 - x for x, or height - 1 - y for "
            "y, of the events.",
        )
    if is_inverted:
        return Problem(
            "On and off events are exchanged: events correlate with the changes of brightness of the frames at "
            f"{value}.",
            "Exchange the polarities, so that 1 is brighter, or invert the frames if they are negatives.",
        )
    return None


def _depth_maps(recording: EventRecording, parallax: Parallax) -> Problem | OpenQuestion | None:
    frames = recording.depth_maps or recording.frames
    if frames is None or frames.depth_filenames is None:
        return None
    try:
        maps = [frames.depth(number) for number in _sampled(len(frames.times))]
    except RecordingError as error:
        return Problem(str(error), "Write depth maps in metres along the optical axis again, or leave them out.")
    known = np.concatenate([depth[depth > 0] for depth in maps if depth is not None])
    if not len(known):
        return Problem("The depth maps are 0 everywhere.", "Export them again, or leave them out.")
    if not parallax.is_shown:
        return OpenQuestion("whether the depth maps are right", "the parallax of the events does not show depths")
    ratios, tolerance, unknown = _depth_ratios(recording, frames, parallax), 1 + DEPTH_TOLERANCE, None
    if len(ratios) < FEWEST_EDGES:
        why = f"only {len(ratios)} edges of the events have a depth; their unit fits"
        unknown = OpenQuestion("whether the depth maps are exact", why)
        ratios, tolerance = np.array([np.median(known) / np.median(parallax.depths)]), COARSE
    ratio = float(np.median(ratios))
    share = float(np.mean(np.abs(ratios / ratio - 1) < ALIKE))
    if share < MIN_SHARE_ALIKE:
        return Problem(
            f"The depth maps do not fit the events: only {percent(share)} of {len(ratios):,} edges have about the same "
            "ratio of depth.",
            "Check that the maps hold depth along the optical axis in metres, and belong to these frames.",
        )
    if abs(np.log(ratio)) <= np.log(tolerance):
        return unknown
    units = [unit for factor, unit in UNITS.items() if abs(np.log(ratio / factor)) <= np.log(tolerance)]
    looks = f", as if they were in {units[0]}" if len(units) == 1 else ""
    return Problem(
        f"The depth maps show {ratio:.3g} times the depth that the events show in the unit of the poses{looks}.",
        "Write the depth maps in metres, or check that the positions of the poses are in metres.",
    )


def _depth_ratios(recording: EventRecording, frames: Frames, parallax: Parallax) -> Float64[np.ndarray, " edges"]:
    """Depth in the map of the nearest frame, as a multiple of the depth that events show, at edges."""
    camera, found = frames.picture_camera, [np.zeros(0)]
    for view in edge_depth(recording, parallax.depth_range, NUM_VIEWS):
        number = int(np.abs(frames.times - view.time).argmin())
        pose = frames.trajectory.poses(torch.as_tensor(frames.times[number])).numpy()
        seen = (view.points - pose[:, 3]) @ pose[:, :3]
        seen = seen[seen[:, 2] > 0]
        x, y = (
            np.rint(focal * place / seen[:, 2] + centre).astype(int)
            for focal, place, centre in ((camera.fx, seen[:, 0], camera.cx), (camera.fy, seen[:, 1], camera.cy))
        )
        inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        depth = frames.depth(number)
        assert depth is not None
        at = depth[y[inside], x[inside]]
        found.append(at[at > 0] / seen[inside, 2][at > 0])
    return np.concatenate(found)
