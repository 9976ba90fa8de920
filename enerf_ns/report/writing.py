"""The report of one or several runs: an HTML page, Markdown, a CSV file, scores and pictures."""

from __future__ import annotations

import base64
import io
import json
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from enerf_ns.dataparsers.formats.registry import check_outside_recordings
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.errors import FlagError, OutputError, RecordingError, quoted
from enerf_ns.dataparsers.recording.files import fill_page, write_together
from enerf_ns.dataparsers.scene.depth_range import scene_depth_range
from enerf_ns.evaluation.display import shown_numbers
from enerf_ns.evaluation.protocols import DEFAULT_PROTOCOL, described
from enerf_ns.evaluation.scores import summary_scores
from enerf_ns.evaluation.views import EXPECTED_SCALE, aligned_views
from enerf_ns.method.held_out_views import held_out_views, scores_at_stated_poses
from enerf_ns.method.runs import Run, load
from enerf_ns.poses.findings import findings
from enerf_ns.report.figures import SCORES, Curve, error_against, step_breakdown, work_precision
from enerf_ns.report.film import Screen, render_moving, render_video
from enerf_ns.report.pictures import camera_path, side_by_side
from enerf_ns.report.pose_figure import corrections_over_time
from enerf_ns.report.run_files import RunFiles, read_run, run_names
from enerf_ns.report.scoring import DEFAULT_SCORING, Scoring
from enerf_ns.report.tables import NONE, Table, history_csv, reach_table, score_cell, step_parts, step_table
from enerf_ns.report.trade_offs import default_targets

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass
class _Reported:
    """A run with the contents of its report."""

    files: RunFiles
    name: str = ""
    prefix: str = ""
    """Beginning of the names of the run's own files: empty, or a folder."""
    scores: dict[str, Any] = field(default_factory=dict)
    protocol: str = DEFAULT_PROTOCOL
    """Name of the protocol of the scores."""
    step: int = 0
    """Training step of the field that is scored."""
    num_frames: int = 0
    """Number of held-out frames that are scored."""
    over_all_frames: bool = False
    seconds: float | None = None
    """Training time up to the scored step, s."""
    events: int | None = None
    verdict: str = ""
    """Sentence on whether the events are explained; empty if the run did not learn from events."""
    picture: tuple[str, bytes] | None = None
    """Name and content of the file with the held-out frames."""
    video: bytes | None = None
    video_note: str = ""
    """Caption of the video."""
    poses: list[dict[str, Any]] = field(default_factory=list)
    """Errors that were found in clock, poses and lens, as `Finding.as_dict` gives them."""
    corrections: bytes | None = None
    """PNG of the corrections of the poses."""
    at_stated_poses: dict[str, float] = field(default_factory=dict)
    """Scores at the poses of the recording, if the run refined them."""
    captions: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    """Sentences about missing parts of the report, with advice."""

    def entry(self) -> dict[str, Any]:
        """The entry of the run in scores.json."""
        entry: dict[str, Any] = {"state": self.files.state, "step": self.step, "train_seconds": self.seconds}
        entry |= {"events": self.events} if self.events is not None else {}
        entry |= {"verdict": self.verdict} if self.verdict else {}
        over = {"protocol": self.protocol, "num_frames": self.num_frames} if self.scores else {}
        return entry | over | {"over_all_frames": self.over_all_frames} | self.scores


def write_report(
    runs: Sequence[Run | Path],
    output_dir: Path,
    reach: Sequence[float] | None = None,
    scoring: Scoring = DEFAULT_SCORING,
    video: bool = True,
) -> dict[str, dict[str, Any]]:
    """Writes a report of runs.

    The files are report.html, report.md, error-against-time.csv, scores.json and the plots. Each run that can be loaded
    adds side-by-side.png, camera_path.json, video.mp4 and moving.webp. With several runs, each has a folder for these.

    Scores of a finished run are those at the end of its history. Scores of another run are those of its newest whole
    checkpoint, or, if there is none, those of the last row of its history that has scores, over a few frames.

    Args:
        runs: At least one run, folder of a run, or config.yml. A run that cannot be read becomes a row with the reason.
        output_dir: Folder, made if it does not exist.
        reach: Values of PSNR in dB for the table of times. None: up to four values that a run reaches.
        scoring: Scoring of held-out frames. With other values than the defaults, they are rendered again.
        video: Whether to render video.mp4 and moving.webp.

    Returns:
        The contents of scores.json: state, step, train_seconds, events and scores by the name of each run.

    Raises:
        RecordingError: No run can be read.
        FlagError: The crop of the scoring is larger than the frames.
        OutputError: The folder cannot be written to, or the disk is full, or the folder lies within a recording.
    """
    reported, unread = _read(runs)
    check_outside_recordings("--output-dir", output_dir, *(one.files.config.data for one in reported))
    with _writing_to(output_dir):
        output_dir.mkdir(parents=True, exist_ok=True)
    loaded = {run.config_file.resolve(): run for run in runs if isinstance(run, Run)}
    for one in reported:
        _look_at(one, loaded.get(one.files.config_file), output_dir, scoring, video)
    entries = {one.name: one.entry() for one in reported} | {name: {"state": fault} for name, fault in unread.items()}
    files = _files(reported, unread, reach, entries)
    with _writing_to(output_dir):
        write_together(output_dir, files)
    return entries


def _read(runs: Sequence[Run | Path]) -> tuple[list[_Reported], dict[str, str]]:
    """The runs without duplicates, and, by path, the reasons why other runs cannot be read."""
    if not runs:
        raise FlagError("No run is given; give the folder of a run, or of several.")
    read: dict[Path, RunFiles] = {}
    unread: dict[str, str] = {}
    for run in runs:
        path = run.config_file if isinstance(run, Run) else run
        try:
            files = read_run(path)
        except RecordingError as error:
            unread[str(path)] = str(error)
        else:
            read[files.config_file] = files
    if not read:
        faults = list(unread.values())
        raise RecordingError(faults[0] if len(faults) == 1 else "No run can be read: " + " ".join(faults))
    reported = [_Reported(files, notes=list(files.notes)) for files in read.values()]
    for one, name in zip(reported, run_names(list(read.values())), strict=True):
        one.name = name
    if len(reported) > 1:
        prefixes: set[str] = set()
        for number, one in enumerate(reported, 1):
            plain = re.sub(r"[^A-Za-z0-9_.-]+", "-", one.name).strip("-.") or "run"
            one.prefix = f"{plain if plain not in prefixes else f'{plain}-{number}'}/"
            prefixes.add(one.prefix[:-1])
    return reported, unread


@contextmanager
def _writing_to(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"--output-dir {folder} could not be written to ({error.strerror}); give another folder."
        ) from error


def _look_at(one: _Reported, run: Run | None, output_dir: Path, scoring: Scoring, video: bool) -> None:
    """Fills in scores, pictures and video of a run, as far as its files allow."""
    history = one.files.history
    scored = next((row for row in reversed(history) if row.scores or row.not_scored), None)
    at_end = bool(scored and scored.final)
    if scored:
        one.step, one.num_frames, one.over_all_frames = scored.step, scored.num_frames, scored.final
        one.scores = {**dict.fromkeys(("psnr", "ssim", "lpips")), **scored.scores}
        one.scores |= {"not_scored": scored.not_scored} if scored.not_scored else {}
        one.protocol, one.verdict = scored.protocol, scored.verdict
    else:
        one.step = one.files.steps
    if run is None:
        run = _loaded(one)
    if run is not None:
        dataset = run.pipeline.datamanager.eval_dataset
        one.events = len(index_events(dataset.recording))
        shown = shown_numbers(len(dataset))
        anew = not at_end or scoring != DEFAULT_SCORING
        views, summary = held_out_views(run.pipeline, None if anew else shown)
        stored = int(run.config.load_step or 0) + 1
        if anew:
            one.step, one.over_all_frames = stored, True
            one.num_frames = sum(view.recorded is not None for view in views)
            one.scores = summary_scores(views, summary, False, scoring.protocol, scoring.lpips, scoring.crop)
            one.protocol = one.scores.pop("protocol")
            views = [views[number] for number in shown]
        figure = corrections_over_time(dataset.recording)
        if figure is not None:
            one.corrections, one.at_stated_poses = _png(figure), scores_at_stated_poses(run.pipeline)
        refiner, distance = run.pipeline.poses, run.pipeline.datamanager.distance
        if refiner is not None and refiner.looks:
            one.poses = [row.as_dict() for row in findings(refiner, distance)]
        depth_range = scene_depth_range(dataset.recording, run.pipeline.datamanager.config.dataparser.depth_range)
        screen = Screen.of(views, depth_range)
        views, _ = aligned_views(views, scoring.protocol)
        one.captions.append(
            f"Held-out frames {', '.join(map(str, shown))} of {len(dataset)} (numbers start at 0) after {stored:,} "
            "training steps. In the column of errors, orange means that the render is too bright, and purple that it "
            f"is too dark. Brightness is displayed as {screen.gamma}."
        )
        picture = _png(side_by_side(views, dataset.recording, screen.exponent))
        path = camera_path(dataset.cameras)
        one.picture = f"{one.prefix}side-by-side.png", picture
        with _writing_to(output_dir):
            write_together(
                output_dir,
                {one.picture[0]: picture, f"{one.prefix}camera_path.json": json.dumps(path).encode()},
            )
            if video:
                folder = output_dir / one.prefix
                render_moving(run.pipeline, screen, folder / "moving.webp")
                render_video(run.pipeline, screen, path, folder / "video.mp4")
                one.video_note = (
                    f"Flight past the held-out cameras: {screen.gamma} on the left, depth on the right. The file "
                    "moving.webp shows events, render and depth along the recorded path."
                )
                one.video = (folder / "video.mp4").read_bytes()
    else:
        _take_preview(one)
    if history:
        one.seconds = float(np.interp(one.step, [row.step for row in history], [row.seconds for row in history]))
    elif run is not None:
        one.seconds = run.train_seconds


def _loaded(one: _Reported) -> Run | None:
    """The loaded run. If it cannot be loaded, None, and a note with the reason is added."""
    left_out = "so pictures, video and new scores are left out"
    recording = one.files.config.data
    if recording is not None and not recording.exists():
        one.notes.append(
            f"The recording {recording} is not there any more, {left_out}; put it back, or a link to it (ln -s NEW "
            f"{quoted(recording)}), and run enerf report again."
        )
        return None
    if not one.files.stored:
        one.notes.append(f"No whole checkpoint is stored, {left_out}; wait for one, or train again.")
        return None
    try:
        return load(one.files.config_file)
    except RecordingError as error:
        one.notes.append(f"{str(error).rstrip('.')}; {left_out}.")
        return None


def _take_preview(one: _Reported) -> None:
    """Takes the newest preview that training wrote, if there is one."""
    previews = sorted((one.files.folder / "previews").glob("step-*.png"))
    if previews:
        one.picture = f"{one.prefix}preview.png", previews[-1].read_bytes()
        one.captions.append(f"Newest preview that training wrote: {previews[-1].name}.")


def _files(
    reported: Sequence[_Reported],
    unread: dict[str, str],
    reach: Sequence[float] | None,
    entries: dict[str, dict[str, Any]],
) -> dict[str, bytes]:
    """The files of a report by name, except those of single runs."""
    histories = [(one.name, one.files.history) for one in reported]
    curves = [
        Curve(one.name, one.files.history, one.seconds, _numbers(one.scores), one.over_all_frames) for one in reported
    ]
    targets = default_targets([history for _, history in histories], "psnr") if reach is None else list(reach)
    steps = [(name, parts) for name, history in histories if (parts := step_parts(history))]
    tables = [_scores_table(reported, unread), _runs_table(reported)]
    if targets and any("psnr" in row.scores for _, history in histories for row in history):
        tables.append(reach_table(histories, targets))
    if steps:
        tables.append(step_table(steps))
    plots = {
        "error-against-seconds.png": ("Error against training time", error_against("seconds", curves)),
        "error-against-steps.png": ("Error against training steps", error_against("step", curves)),
        "work-precision.png": ("Final error against training time", work_precision(curves)),
        "step.png": ("Time of a training step by part", step_breakdown(steps) if steps else None),
    }
    figures = {name: (title, _png(figure)) for name, (title, figure) in plots.items() if figure is not None}
    tables += [_poses_table(one, len(reported) > 1) for one in reported if one.poses]
    figures |= {
        f"{one.prefix}corrections.png": (_of_run("Corrections of the poses", one, len(reported) > 1), one.corrections)
        for one in reported
        if one.corrections is not None
    }
    return {
        "report.html": _page(reported, tables, figures).encode(),
        "report.md": _markdown(reported, tables, {name: title for name, (title, _) in figures.items()}).encode(),
        "error-against-time.csv": history_csv(histories).encode(),
        "scores.json": (json.dumps(entries, indent=2) + "\n").encode(),
        **{name: content for name, (_, content) in figures.items()},
        **{one.picture[0]: one.picture[1] for one in reported if one.picture},
    }


def _numbers(scores: dict[str, Any]) -> dict[str, float]:
    return {name: float(value) for name, value in scores.items() if isinstance(value, (int, float))}


def _scores_table(reported: Sequence[_Reported], unread: dict[str, str]) -> Table:
    """Scores, time and state of each run. Columns without any value are left out."""
    rows = [
        {
            "run": one.name,
            "state": one.files.state,
            "scored after": f"{one.step:,} steps" if one.scores else NONE,
            "training time": NONE if one.seconds is None else f"{one.seconds:,.4g} s",
            **{label: score_cell(name, one.scores.get(name)) for name, label in SCORES.items()},
            "brightness scale": _brightness_scale(one),
            "scored frames": f"{'all' if one.over_all_frames else 'a few,'} {one.num_frames}"
            if one.num_frames
            else NONE,
            "on the path": f"{on_path:.0f}" if (on_path := one.scores.get("held_out_on_path")) else NONE,
            "protocol": one.protocol if one.scores else NONE,
        }
        for one in reported
    ]
    rows += [dict.fromkeys(rows[0], NONE) | {"run": path, "state": fault} for path, fault in unread.items()]
    header = [name for name in rows[0] if any(row[name] != NONE for row in rows)]
    protocols = dict.fromkeys(one.protocol for one in reported if one.scores)
    note = " ".join(
        [
            "Scores are means over held-out frames. Training time is that of the training steps alone, up to the "
            "scored step.",
            "A held-out frame is on the path if its pose lies among the training poses." * ("on the path" in header),
            "The brightness scale is the factor by which the fit multiplies the contrast of renders. The expected "
            "value is in brackets, if the recording states it: the sensor's mean contrast threshold divided by the one "
            "that training used." * ("brightness scale" in header),
            *map(described, protocols),
        ]
    )
    return Table("Scores", header, [[row[name] for name in header] for row in rows], note)


def _brightness_scale(one: _Reported) -> str:
    """Brightness scale of each fitted channel, and in brackets the expected one.

    Only a run that learns from events has it, because the contrast of its field is in units of the thresholds.
    """
    names = [name for name in one.scores if name.startswith("brightness_scale") and name != EXPECTED_SCALE]
    if not names or one.protocol != DEFAULT_PROTOCOL or "events" not in one.files.learns_from:
        return NONE
    expected = one.scores.get(EXPECTED_SCALE)
    brackets = [] if expected is None else [f"({score_cell(EXPECTED_SCALE, expected)})"]
    return " ".join([*(score_cell(name, one.scores[name]) for name in names), *brackets])


def _runs_table(reported: Sequence[_Reported]) -> Table:
    """Method, recording, seed, device and folder of each run."""
    rows = []
    for one in reported:
        config = one.files.config
        events = NONE if one.events is None else f"{one.events:,}"
        recording = NONE if config.data is None else config.data.name
        rows.append(
            [one.name, config.method_name, one.files.learns_from, recording, events, str(config.machine.seed),
             config.machine.device_type, str(one.files.folder)]
        )  # fmt: skip
    return Table("Runs", ["run", "method", "training data", "recording", "events", "seed", "device", "folder"], rows)


def _of_run(title: str, one: _Reported, of_several: bool) -> str:
    return f"{title}, {one.name}" if of_several else title


def _poses_table(one: _Reported, of_several: bool) -> Table:
    """Errors that were found in clock, poses and lens of a run."""
    rows = [
        [
            row["what"],
            "corrected" if row["is_corrected"] else "not corrected",
            row["value"] if row["is_identifiable"] else f"not identifiable ({row['value']})",
            f"{row['pixels']:.2g} pixels" if row["is_corrected"] else NONE,
            row["flag"],
        ]
        for row in one.poses
    ]
    note = (
        "Values have standard errors. A part that the events do not determine, or whose error is not significant, "
        "keeps the value of the recording."
    )
    if one.at_stated_poses:
        scores = ", ".join(f"{SCORES[name]} {score_cell(name, value)}" for name, value in one.at_stated_poses.items())
        note += (
            " All scores above are at the corrected poses, which were not fitted to held-out frames. Scores at the "
            f"poses of the recording: {scores}."
        )
    header = ["part", "correction", "error", "image motion", "flag"]
    return Table(_of_run("Clock, poses and lens", one, of_several), header, rows, note)


def _not_scored(one: _Reported) -> list[str]:
    """A sentence for each score that some frames lack, with the reason."""
    reasons: dict[str, dict[str, list[int]]] = one.scores.get("not_scored", {})
    return [
        f"No {name}" + (f" for frames {', '.join(map(str, numbers))}" if numbers else "") + f": {reason}."
        for name, by_reason in reasons.items()
        for reason, numbers in by_reason.items()
    ]


def _page(reported: Sequence[_Reported], tables: Sequence[Table], figures: dict[str, tuple[str, bytes]]) -> str:
    """One HTML file that holds all tables, pictures and videos, and loads no other file."""
    runs = []
    for one in reported:
        runs.append(
            {
                "title": one.name,
                "picture": one.picture and _data_uri("image/png", one.picture[1]),
                "captions": one.captions,
                "notes": [*one.notes, *_not_scored(one)],
                "video": one.video and _data_uri("video/mp4", one.video),
                "video_note": one.video_note,
            }
        )
    return fill_page(
        Path(__file__).with_name("report.html"),
        title=_title(reported),
        verdicts=_verdicts(reported),
        tables=tables,
        figures=[{"title": title, "uri": _data_uri("image/png", content)} for title, content in figures.values()],
        runs=runs,
    )


def _markdown(reported: Sequence[_Reported], tables: Sequence[Table], figures: dict[str, str]) -> str:
    """The contents of the page in Markdown, with links to the files."""
    parts = [f"# {_title(reported)}", *_verdicts(reported)]
    for table in tables:
        parts += [f"## {table.title}", table.markdown(), *([table.note] if table.note else [])]
    for name, title in figures.items():
        parts += [f"## {title}", f"![{title}]({name})"]
    for one in reported:
        parts.append(f"## {one.name}")
        if one.picture:
            parts.append(f"![held-out frames]({one.picture[0]})")
        parts += [*one.captions, *one.notes, *_not_scored(one)]
        if one.video is not None:
            parts.append(f"[Video]({one.prefix}video.mp4). {one.video_note}")
    return "\n\n".join(parts) + "\n"


def _verdicts(reported: Sequence[_Reported]) -> list[str]:
    """A sentence for each run that learned from events: whether its field explains them, and what to try if not."""
    return [f"{one.name}: {one.verdict}" if len(reported) > 1 else one.verdict for one in reported if one.verdict]


def _title(reported: Sequence[_Reported]) -> str:
    return reported[0].name if len(reported) == 1 else f"{len(reported)} runs"


def _png(figure: Figure) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png")
    return content.getvalue()


def _data_uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
