"""Tables and a page of figures about a recording, and its problems."""

from __future__ import annotations

import base64
import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from jaxtyping import Float64, Int64, UInt8
from PIL import Image
from rich.console import Console
from rich.table import Table
from rich.text import Text
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.index.event_index import event_picture
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.inspection.agreement import (
    FITS,
    HARMFUL_SHIFT,
    MILLISECOND,
    SHOWN_DELAYS,
    Agreement,
    shown_hypotheses,
    why_no_search,
)
from enerf_ns.dataparsers.inspection.evidence import Evidence
from enerf_ns.dataparsers.inspection.focus import AS_READ, AS_STATED, Hypothesis
from enerf_ns.dataparsers.inspection.frame_bursts import FrameBursts
from enerf_ns.dataparsers.inspection.problems import (
    EventStatistics,
    OpenQuestion,
    Problem,
    event_statistics,
    find_problems,
    pose_gaps,
    unusual_rates,
)
from enerf_ns.dataparsers.inspection.sensor_survey import SensorSurvey
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import printable
from enerf_ns.dataparsers.recording.files import fill_page
from enerf_ns.dataparsers.recording.picture_depth import in_8_bits
from enerf_ns.dataparsers.recording.recording import EventRecording, Frames, percent
from enerf_ns.dataparsers.recording.trajectory import evenly_spaced
from enerf_ns.dataparsers.scene.depth_range import (
    UnknownDepthError,
    recording_parallax,
    scene_depth_range,
    share_beyond,
)
from enerf_ns.dataparsers.scene.edge_depth import edge_depth
from enerf_ns.dataparsers.scene.scene_box import scene_normalisation

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NUM_INSTANTS = 6
"""Number of instants at which events are shown, each beside the frame of the same time."""
NUM_OVERLAYS = 4
"""Number of frames that edges of events are drawn on."""
NUM_EDGE_VIEWS = 3
"""Number of views in which the depth of edges is shown."""
NUM_COMPENSATED = 3
"""Number of windows whose motion-compensated events are shown: with slow, usual and fast motion."""
BLACK_PERCENTILE = 99.5
"""Percentile of the counts of motion-compensated events that is drawn black."""
NUM_FRUSTA = 16
"""Number of cameras drawn along the trajectory."""
PICTURE_WIDTH = 640
"""Largest width of a picture on the page, pixels."""
NAMED_HOT_PIXELS = 8
"""Number of hot pixels that are listed one by one. The heat map marks all of them."""

OVERLAY_DELAYS = [0, *(delay * MILLISECOND for delay in SHOWN_DELAYS)]
"""Delays (ns) of the events that are laid over frames."""

BLUE, GREEN, RED, GREY = "#3b6fb6", "#3a9d6a", "#d9352a", "#5a6272"


@dataclass(frozen=True)
class Instant:
    """Pictures of one time, as data URIs."""

    time: str
    """Time with its unit."""
    events: str
    frame: str | None = None
    """Frame of this time. None without frames."""
    frame_name: str = ""
    """Name of the frame's file."""


@dataclass(frozen=True)
class Overlay:
    """A frame, and events of different times to lay over it, as data URIs."""

    time: str
    """Time of the frame, with its unit."""
    frame: str
    events: list[str]
    """Events for each delay that the page offers."""


@dataclass(frozen=True)
class Compensated:
    """Motion-compensated events of a window under one hypothesis."""

    words: str
    """The hypothesis, and the sharpness of the events."""
    picture: str
    """Picture of the events as a data URI."""


@dataclass(frozen=True)
class Inspection:
    """A recording with its statistics, measurements and problems."""

    recording: EventRecording
    statistics: EventStatistics
    depth_range: tuple[float, float] | None
    """Nearest and farthest depth of the scene, metres. None if it is neither stated nor measurable, if the camera only
    turns, or without poses."""
    problems: list[Problem]
    sensor: SensorSurvey
    """Sensor parameters, stated and measured."""
    agreement: Agreement | None = None
    """Agreement of clocks, poses and focal length with the events. None if there are too few events, or no poses."""
    as_stated: Agreement | None = None
    """The same with the clocks, poses and focal length as stated. None unless a training refined them."""
    unknown: tuple[OpenQuestion, ...] = ()
    """Questions that nothing in the recording answers."""

    @classmethod
    def of(cls, recording: EventRecording) -> Inspection:
        """Counts events, looks for problems, measures sensor and depth, compares events with poses and frames.

        Without poses, depth is not measured, and events are compared with frames alone.

        Raises:
            RecordingError: The events or a frame cannot be used.
        """
        statistics = event_statistics(recording)
        sensor = SensorSurvey.of(recording)
        if not recording.has_poses:
            evidence = Evidence.of(recording)
            problems = [*evidence.problems, *sensor.problems(), *find_problems(recording, None, statistics)]
            questions = OpenQuestion(FITS, "there are no poses yet"), *evidence.unknown
            return cls(recording, statistics, None, problems, sensor, unknown=questions)
        near_far, unknown = None, []
        try:
            near_far = scene_depth_range(recording)
        except UnknownDepthError as error:
            unknown = [f"The depth range of the scene cannot be measured, because {error.reason}."]
        agreement = Agreement.of(recording, near_far)
        shown = None if recording_parallax(recording).is_ruled_out else near_far
        contradictions = agreement.problems() if agreement else []
        evidence = Evidence.of(recording)
        problems = [*contradictions, *evidence.problems, *sensor.problems()]
        questions = agreement.unknown() if agreement else [why_no_search(recording, near_far)]
        mend = "State the range with --depth-range NEAR FAR of the data parser (metres), which training needs."
        if contradictions:
            mend = "Mend the first problem of this list. The wrong poses, clock or calibration can be the cause."
        problems += [*find_problems(recording, shown, statistics), *(Problem(what, mend) for what in unknown)]
        as_read = recording.as_read
        as_stated = None if as_read is None else Agreement.of(as_read, near_far)
        open_questions = tuple(one for one in [*questions, *evidence.unknown] if one is not None)
        return cls(recording, statistics, shown, problems, sensor, agreement, as_stated, open_questions)

    def print_tables(self, console: Console) -> None:
        """Prints all tables, notes in yellow and problems in red."""
        for title, rows in self._tables():
            if not rows:
                continue
            table = Table(title=title, show_header=False, title_justify="left")
            for name, value in rows.items():
                table.add_row(name, Text(printable(value)))
            console.print(table)
        for note in self.notes():
            console.print(Text(f"note: {printable(note)}", "yellow"))
        for one in self.unknown:
            console.print(Text(printable(one.sentence), "yellow"))
        console.print(problems_table(self.problems, self.no_problems))

    @property
    def no_problems(self) -> str:
        """The verdict where no problems were found."""
        return "No problems were found in what can be measured." if self.unknown else "No problems were found."

    def notes(self) -> list[str]:
        """Sentences on what was left out of the recording, mended or assumed."""
        return [*self.recording.notes, *index_events(self.recording).notes]

    def found(self) -> dict[str, str]:
        """The parts of the recording in words, by name."""
        recording, (first, *_, last) = self.recording, self.statistics.edges
        times = recording.trajectory.times
        interval = float(np.median(np.diff(times))) * 1e-9
        poses = f"{len(times):,}, {_span(times[0], times[-1])}, usually every {1e3 * interval:.3g} ms"
        rows = {
            "format": recording.format,
            "events": f"{self.statistics.num_events:,}, {_span(first, last)}",
            "poses": poses if recording.has_poses else "none yet",
        }
        for name, frames in {"frames": recording.frames, "blurred frames": recording.blurred_frames}.items():
            rows[name] = "none"
            if frames is not None:
                depth = ", with depth" if frames.depth_filenames else ""
                rows[name] = (
                    f"{len(frames.times):,}, {_span(frames.times[0], frames.times[-1])}{depth}{frames.white_in_words}"
                )
        if recording.zero:
            rows["time 0"] = f"{recording.zero} ns on the clock of the files"
        rows["event camera"] = _camera(recording.camera)
        frames = self._frames
        if frames is not None:
            rows["frame camera"] = "the same" if frames.camera == recording.camera else _camera(frames.camera)
            rows["extrinsics"] = _extrinsics(recording, frames)
        rows["colours"] = recording.bayer_pattern or "none: a grey sensor"
        return rows

    def numbers(self) -> dict[str, str]:
        """Counts and measurements in words, by name."""
        recording, statistics = self.recording, self.statistics
        hot = index_events(recording).hot_pixels.numpy()
        width = recording.camera.width
        places = ", ".join(f"({pixel % width}, {pixel // width})" for pixel in hot[:NAMED_HOT_PIXELS])
        more = f" and {len(hot) - NAMED_HOT_PIXELS} more" if len(hot) > NAMED_HOT_PIXELS else ""
        rows = self._numbers_of_motion() if recording.has_poses else {}
        return {
            "event rate": f"{_round(statistics.num_events / statistics.seconds)} per second on average, "
            f"{_round(statistics.rate.max())} at most",
            "per pixel": f"{statistics.events_per_pixel:.3g} events; "
            f"{100 * statistics.share_below_two:.1f} % of the pixels have fewer than two",
            "polarity": f"{100 * statistics.num_on / statistics.num_events:.1f} % on, "
            f"{100 * statistics.num_off / statistics.num_events:.1f} % off",
            "hot pixels": f"{len(hot):,} left out, (x, y) = {places}{more}" if len(hot) else "none left out",
            **rows,
        }

    def _numbers_of_motion(self) -> dict[str, str]:
        """Measurements of trajectory and scene in words, by name."""
        recording, statistics = self.recording, self.statistics
        gaps = pose_gaps(recording, statistics)
        missing = float(np.diff(gaps).sum()) * 1e-9 / statistics.seconds
        path = self._path(1000)[1][:, :, 3]
        rows = {
            "pose coverage": f"{100 * (1 - missing):.3g} % of the time with events"
            + (f", {len(gaps)} gap{'s' * (len(gaps) > 1)}" if len(gaps) else ", no gaps"),
            "path": f"{np.nansum(np.linalg.norm(np.diff(path, axis=0), axis=1)):.3g} m long, "
            f"spans {np.linalg.norm(np.nanmax(path, axis=0) - np.nanmin(path, axis=0)):.3g} m",
        }
        if self.depth_range:
            near, far = self.depth_range
            source = "stated" if recording.depth_range else "measured from the events"
            _, scale, box = scene_normalisation(recording, near, far)
            sides = " x ".join(f"{side:.3g}" for side in (box[1] - box[0]) / scale)
            rows["near and far"] = f"{near:.3g} m and {far:.3g} m, {source}"
            beyond = percent(share_beyond(recording, self.depth_range))
            rows["beyond"] = f"{beyond} of the events come from beyond the farthest depth"
            rows["box"] = f"{sides} m, around all that the camera sees; 1 m is {scale:.3g} units in Nerfstudio"
        else:
            rows["near and far"] = rows["beyond"] = rows["box"] = "unknown"
            if recording_parallax(recording).is_ruled_out:
                rows["near and far"] = "unknown: the camera only turns, so that training learns a panorama"
        return rows

    def focus(self) -> dict[str, str]:
        """Agreement of clocks, poses and focal length with the events, by name. Empty if there are too few events."""
        rows = self.agreement.rows() if self.agreement else {}
        stated = self.as_stated.rows() if self.as_stated else {}
        return rows | {f"{name}, as stated": value for name, value in stated.items() if value != rows.get(name)}

    def _tables(self) -> list[tuple[str, dict[str, str]]]:
        return [
            ("Recording", self.found()),
            ("Numbers", self.numbers()),
            ("Sensor: stated, and measured from events and frames", self.sensor.rows()),
            ("Do clocks, poses and calibration agree with the events?", self.focus()),
        ]

    def page(self, corrections: Figure | None = None) -> str:
        """One HTML file that holds all figures and loads nothing.

        Args:
            corrections: Figure of the corrections of the trajectory over time.
        """
        return fill_page(
            Path(__file__).with_name("inspection.html"),
            name=self.recording.path.name,
            path=self.recording.path,
            problems=self.problems,
            unknown=self.unknown,
            no_problems=self.no_problems,
            tables=self._tables(),
            notes=self.notes(),
            bursts=_plot(self.bursts(self.sensor.bursts)) if self.sensor.bursts else None,
            delays=self._delays(),
            flick=self._flick(),
            overlays=self._overlays(),
            compensated=self._compensated(),
            edge_depth=_plot(edges) if (edges := self.edge_depth()) else None,
            has_frames=self._frames is not None,
            corrections=_plot(corrections) if corrections else None,
            timeline=_plot(self.timeline()),
            instants=self._instants(),
            trajectory=_plot(self.trajectory()) if self.recording.has_poses else None,
            heat_map=_plot(self.heat_map()),
        )

    def timeline(self) -> Figure:
        """Figure of the times of events, frames and poses, and of the event rate, with silences and bursts in red."""
        from matplotlib.figure import Figure

        recording, statistics = self.recording, self.statistics
        edges = statistics.edges * 1e-9
        figure = Figure(figsize=(11.4, 4.2), layout="constrained", dpi=150)
        coverage, rate = figure.subplots(2, 1, sharex=True, height_ratios=[1, 2.6])
        coverage.barh(2, edges[-1] - edges[0], left=edges[0], height=0.55, color=BLUE)
        frames = self._frames
        if frames is not None:
            coverage.vlines(frames.times * 1e-9, 0.72, 1.28, color=GREEN, linewidth=0.8)
        middle, poses = 0.5 * (edges[0] + edges[-1]), recording.trajectory
        if frames is None:
            coverage.text(middle, 1, "no frames", color=GREY, ha="center", va="center")
        if recording.has_poses:
            coverage.barh(0, (poses.end - poses.start) * 1e-9, left=poses.start * 1e-9, height=0.55, color=GREY)
            for begin, end in pose_gaps(recording, statistics) * 1e-9:
                coverage.barh(0, end - begin, left=begin, height=0.55, color=RED)
        else:
            coverage.text(middle, 0, "no poses yet", color=GREY, ha="center", va="center")
        coverage.set_yticks([0, 1, 2], ["poses", "frames", "events"])
        coverage.set_ylim(-0.5, 2.5)
        coverage.tick_params(axis="both", length=0)
        coverage.spines[:].set_visible(False)

        rate.stairs(statistics.rate / 1e6, edges, fill=True, color=BLUE, alpha=0.35)
        rate.stairs(statistics.rate / 1e6, edges, color=BLUE, linewidth=0.8, baseline=None)
        silences = bursts = np.zeros((0, 2))
        if recording.has_poses:
            silences, bursts = unusual_rates(recording, statistics, self.depth_range)
        for begin, end in np.concatenate([silences, bursts]) * 1e-9:
            rate.axvspan(begin, end, color=RED, alpha=0.35)
        calm = ~((statistics.edges[:-1, None] >= bursts[:, 0]) & (statistics.edges[:-1, None] < bursts[:, 1])).any(1)
        rate.set_xlabel("seconds on the clock of the recording")
        rate.set_ylabel("million events per second")
        rate.set_ylim(0, 1.1 * statistics.rate[calm].max() / 1e6)
        rate.set_xlim(min(edges[0], poses.start * 1e-9), max(edges[-1], poses.end * 1e-9))
        rate.spines[["top", "right"]].set_visible(False)
        return figure

    def bursts(self, bursts: FrameBursts) -> Figure:
        """Figure of the event rate around the stamps of frames, with bursts in red."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(11.4, 2.6), layout="constrained", dpi=150)
        axis = figure.subplots()
        edges = bursts.edges * 1e-6
        axis.stairs(bursts.ratio, edges, fill=True, color=BLUE, alpha=0.35)
        axis.stairs(bursts.ratio, edges, color=BLUE, linewidth=0.8, baseline=None)
        for begin, end in bursts.delays * 1e-6:
            axis.axvspan(begin, end, color=RED, alpha=0.35)
        axis.set_xlim(edges[0], edges[-1])
        axis.set_ylim(0, None)
        axis.set_xlabel("milliseconds from the stamp of a frame")
        axis.set_ylabel("event rate / median")
        axis.spines[["top", "right"]].set_visible(False)
        return figure

    def edge_depth(self) -> Figure | None:
        """Figure of the depth of edges in some views, below the frames of about the same time. None if no edge has a
        depth that several views confirm."""
        from matplotlib.colors import LogNorm
        from matplotlib.figure import Figure

        views = [] if self.depth_range is None else edge_depth(self.recording, self.depth_range)
        depths = np.concatenate([np.zeros(0), *(view.depth[view.depth > 0] for view in views)])
        if not len(depths):
            return None
        near, far = np.percentile(depths, [1, 99])
        known = [i for i, view in enumerate(views) if view.depth.any()]
        shown = [views[known[i]] for i in np.unique(np.linspace(0, len(known) - 1, NUM_EDGE_VIEWS).round().astype(int))]
        frames = self._frames
        rows = 1 if frames is None else 2
        ratio = shown[0].depth.shape[0] / shown[0].depth.shape[1]
        figure = Figure(figsize=(11.4, 0.7 + rows * 3.7 * ratio), layout="constrained", dpi=150)
        axes = figure.subplots(rows, len(shown), squeeze=False)
        for view, column in zip(shown, axes.T, strict=True):
            if frames is not None:
                i = int(np.abs(frames.times - view.time).argmin())
                column[0].imshow(in_8_bits(frames.camera.undistort(frames.image(i))), cmap="gray", vmin=0, vmax=255)
                column[0].set_title(f"frame at {_seconds(frames.times[i])}", fontsize=9)
            picture = np.ma.masked_equal(view.depth, 0)
            drawn = column[-1].imshow(picture, "turbo_r", norm=LogNorm(near, max(far, 1.001 * near)))
            column[-1].set_title(f"depth of edges at {_seconds(view.time)}", fontsize=9)
        for axis in axes.flat:
            axis.set(xticks=[], yticks=[])
        bar = figure.colorbar(drawn, ax=axes, label="metres", shrink=0.8)
        ticks = np.geomspace(near, far, 4)
        bar.set_ticks(ticks, labels=[f"{tick:.2g}" for tick in ticks], minor=False)
        bar.minorticks_off()
        return figure

    def trajectory(self) -> Figure:
        """Figure of the path, some view frusta and the box, seen along the mean up direction of the cameras."""
        from matplotlib.figure import Figure
        from matplotlib.patches import Rectangle

        transform, scale, box = scene_normalisation(self.recording, *(self.depth_range or (1.0, 2.0)))
        from_above = transform[:2, :3]
        times, poses = self._path(1000)
        places = poses[:, :, 3] @ from_above.T
        low, high = (box / scale - transform[:, 3])[:, :2]
        size = (np.nanmax(places, axis=0) - np.nanmin(places, axis=0)).max()
        figure = Figure(figsize=(5.6, 5.0), layout="constrained", dpi=150)
        axis = figure.subplots()
        if self.depth_range:
            axis.add_patch(Rectangle(tuple(low), *(high - low), fill=False, linestyle="--", edgecolor=GREY))
            size = max(size, (high - low).max())

        camera = self.recording.camera.undistorted()
        right, below = camera.width - camera.cx, camera.height - camera.cy
        x = np.array([-camera.cx, right, right, -camera.cx, -camera.cx]) / camera.fx
        y = np.array([-camera.cy, -camera.cy, below, below, -camera.cy]) / camera.fy
        corners = np.stack([x, y, np.ones(5)], axis=1)
        chosen = np.linspace(0, len(times) - 1, NUM_FRUSTA).round().astype(int)
        path = axis.scatter(*places.T, c=times * 1e-9, s=6, cmap="viridis", zorder=3)
        for i in chosen[~np.isnan(places[chosen, 0])]:
            ends = (corners * 0.1 * size @ poses[i, :, :3].T + poses[i, :, 3]) @ from_above.T
            colour = path.to_rgba(times[i] * 1e-9)
            axis.plot(*ends.T, color=colour, linewidth=0.9)
            for end in ends[:4]:
                axis.plot(*np.stack([places[i], end]).T, color=colour, linewidth=0.9)
        axis.set_aspect("equal", adjustable="datalim")
        axis.margins(0.06)
        axis.set_xlabel("metres" + "; dashed: the box around the scene" * bool(self.depth_range))
        axis.spines[["top", "right"]].set_visible(False)
        figure.colorbar(path, ax=axis, label="seconds", shrink=0.8)
        return figure

    def heat_map(self) -> Figure:
        """Figure of the number of events of each pixel on a logarithmic scale, with hot pixels circled."""
        from matplotlib import colormaps
        from matplotlib.colors import LogNorm
        from matplotlib.figure import Figure

        counts, width = self.statistics.counts, self.recording.camera.width
        figure = Figure(figsize=(5.6, 5.0), layout="constrained", dpi=150)
        axis = figure.subplots()
        colours = colormaps["inferno"].with_extremes(bad="#c9ced8")
        shown = axis.imshow(np.ma.masked_equal(counts, 0), cmap=colours, norm=LogNorm(1, max(int(counts.max()), 2)))
        hot = index_events(self.recording).hot_pixels.numpy()
        if len(hot):
            axis.scatter(hot % width, hot // width, s=40, facecolors="none", edgecolors="#22c7e8", linewidths=1.2)
        axis.set_xlabel("grey: no events" + "; circled: hot, left out" * bool(len(hot)))
        figure.colorbar(shown, ax=axis, label="events", location="bottom", shrink=0.8)
        return figure

    def _path(self, number: int) -> tuple[Int64[np.ndarray, " number"], Float64[np.ndarray, "number 3 4"]]:
        """Evenly spaced times (ns) from the first event to the last, and the poses, which are NaN in gaps of the
        poses."""
        first, last = self.statistics.edges[[0, -1]]
        times = evenly_spaced(first, last, number)
        poses = self.recording.trajectory.poses(torch.from_numpy(times)).numpy()
        poses[self.recording.trajectory.in_gaps(times)] = np.nan
        return times, poses

    @property
    def _frames(self) -> Frames | None:
        return self.recording.frames or self.recording.blurred_frames

    def _instants(self) -> list[Instant]:
        first, last = self.statistics.edges[[0, -1]]
        frames = self._frames
        during = np.flatnonzero((frames.times >= first) & (frames.times <= last)) if frames is not None else []
        if frames is None or not len(during):
            times = evenly_spaced(first, last, NUM_INSTANTS + 2)[1:-1]
            return [Instant(_seconds(time), self._events_at(time)) for time in times]
        chosen = during[np.unique(np.linspace(0, len(during) - 1, NUM_INSTANTS + 2)[1:-1].round().astype(int))]
        return [
            Instant(
                _seconds(frames.times[i]),
                self._events_at(frames.times[i]),
                _picture(in_8_bits(frames.camera.undistort(frames.image(i))), "JPEG"),
                frames.filenames[i].name,
            )
            for i in chosen
        ]

    def _delays(self) -> list[str]:
        """The delays of `_delays_ns` in words."""
        return [
            "as stamped" if not delay else f"{delay / MILLISECOND:+.3g} ms" + " (best)" * (delay not in OVERLAY_DELAYS)
            for delay in self._delays_ns()
        ]

    def _delays_ns(self) -> list[int]:
        """Delays (ns) of the events that are laid over frames: `OVERLAY_DELAYS`, and the best one if it is another."""
        best = self.agreement.frame_delay if self.agreement else None
        found = round(-best.value) * MILLISECOND if best and best.is_identifiable else 0
        return OVERLAY_DELAYS + [found] * (found not in OVERLAY_DELAYS)

    def _flick(self) -> int:
        """Number of the delay that the page flicks to: the best one if the stated one is wrong, else a wrong one."""
        delays = self._delays_ns()
        is_wrong = self.agreement and self.agreement.pixels(delays[-1] / MILLISECOND) > HARMFUL_SHIFT
        return len(delays) - 1 if is_wrong else len(SHOWN_DELAYS)

    def _overlays(self) -> list[Overlay]:
        if self.agreement is None or self.agreement.edges is None:
            return []
        edges, plane = self.agreement.edges, self.agreement.plane
        chosen = np.unique(np.linspace(0, len(edges.frames.times) - 1, NUM_OVERLAYS + 2)[1:-1].round().astype(int))
        return [
            Overlay(
                _seconds(edges.frames.times[i]),
                _picture(edges.picture(i), "JPEG"),
                [
                    _picture(edges.events_at(int(edges.frames.times[i]) + delay, plane), "PNG")
                    for delay in self._delays_ns()
                ],
            )
            for i in chosen.tolist()
        ]

    def _compensated(self) -> list[tuple[str, list[Compensated]]]:
        """For some windows, time and speed in words, and pictures of motion-compensated events."""
        if self.agreement is None:
            return []
        focus, readings = self.agreement.focus, self.agreement.readings
        pose_delay = self.agreement.pose_delay
        delay = round(pose_delay.value) * MILLISECOND if pose_delay.is_identifiable else 0
        best = Hypothesis(delay, 1.0, AS_READ if AS_READ in readings else readings[0])
        hypotheses = [AS_STATED, *(shown for shown in shown_hypotheses() if focus.allows(shown.focal_scale))]
        hypotheses += [best] if best not in hypotheses else []
        by_speed = sorted(focus.windows, key=lambda window: window.speed)
        shown = []
        for i in np.unique(np.linspace(0, len(by_speed) - 1, NUM_COMPENSATED).round().astype(int)):
            window = by_speed[i]
            pictures = [focus.picture(window, hypothesis) for hypothesis in hypotheses]
            black = float(np.percentile(pictures[0][0], BLACK_PERCENTILE)) or 1.0
            as_fired, _ = focus.picture(window, None)
            row = [Compensated("without compensation", _density(as_fired, black))]
            for hypothesis, (picture, sharpness) in zip(hypotheses, pictures, strict=True):
                words = hypothesis.words + (" (best)" if hypothesis is best else "")
                row.append(Compensated(f"{words}: {100 * sharpness / pictures[0][1]:.0f} %", _density(picture, black)))
            title = (
                f"{_seconds(window.instant)}: {1e-6 * (window.end - window.start):.0f} ms of events; the picture moves "
                f"at {window.speed:.0f} pixels per second"
            )
            shown.append((title, row))
        return shown

    def _events_at(self, time: int) -> str:
        return _picture(event_picture(index_events(self.recording), self.recording.camera, int(time)), "PNG")


def problems_table(problems: list[Problem], none: str) -> Table | str:
    """Problems in red, each with advice, for the terminal; or the words for their absence, in green."""
    if not problems:
        return f"[green]{none}[/green]"
    table = Table(title=f"[red]Problems ({len(problems)})[/red]", title_justify="left", show_lines=True)
    table.add_column("problem", style="red", ratio=1)
    table.add_column("what to do", ratio=1)
    for problem in problems:
        table.add_row(Text(printable(problem.what)), Text(printable(problem.advice)))
    return table


def _round(number: float) -> str:
    """A number as text, rounded to three digits."""
    return f"{float(f'{number:.3g}'):,.0f}"


def _seconds(time: int) -> str:
    return f"{time * 1e-9:.3f} s"


def _span(first: int, last: int) -> str:
    return f"{_seconds(first)} to {_seconds(last)}"


def _camera(camera: Camera) -> str:
    seen = camera.undistorted()
    across, down = (
        math.degrees(2 * math.atan(pixels / (2 * focal_length)))
        for pixels, focal_length in ((seen.width, seen.fx), (seen.height, seen.fy))
    )
    return f"{camera.width} x {camera.height} pixels, {camera.model}, field of view {across:.0f} x {down:.0f} degrees"


def _extrinsics(recording: EventRecording, frames: Frames) -> str:
    if frames.trajectory is recording.trajectory:
        return "none: frames and events come from one camera"
    middle = torch.tensor(int(frames.times[len(frames.times) // 2]))
    if not recording.trajectory.covers(middle):
        return "unknown"
    events, pictures = (trajectory.poses(middle).numpy() for trajectory in (recording.trajectory, frames.trajectory))
    turn = Rotation.from_matrix(events[:, :3].T @ pictures[:, :3]).magnitude()
    offset = events[:, :3].T @ (pictures[:, 3] - events[:, 3])
    x, y, z = 1e3 * offset
    return (
        f"frame camera {x:.1f} mm right of, {y:.1f} mm below and {z:.1f} mm in front of the event camera, "
        f"turned by {math.degrees(turn):.2g} degrees"
    )


def _plot(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return _data_uri(buffer, "png")


def _picture(pixels: UInt8[np.ndarray, "height width channels"], format: Literal["PNG", "JPEG"]) -> str:
    image = Image.fromarray(pixels[..., 0] if pixels.shape[2] == 1 else pixels)
    if image.width > PICTURE_WIDTH:
        image = image.resize((PICTURE_WIDTH, round(image.height * PICTURE_WIDTH / image.width)), Image.Resampling.BOX)
    buffer = io.BytesIO()
    image.save(buffer, format=format)
    return _data_uri(buffer, format.lower())


def _density(counts: Float64[np.ndarray, "rows columns"], black: float) -> str:
    """Counts as a picture in which large counts are dark."""
    return _picture((255 * (1 - np.sqrt(np.minimum(counts / black, 1))))[..., None].astype(np.uint8), "PNG")


def _data_uri(buffer: io.BytesIO, format: str) -> str:
    return f"data:image/{format};base64,{base64.b64encode(buffer.getvalue()).decode()}"
