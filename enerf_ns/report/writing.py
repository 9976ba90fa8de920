"""The report of one or several runs: an HTML page, Markdown, a CSV file, scores and pictures."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from enerf_ns.dataparsers.formats.registry import check_outside_recordings
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.errors import FlagError, OutputError, RecordingError, UserError, quoted
from enerf_ns.dataparsers.recording.files import write_together, write_whole
from enerf_ns.evaluation.display import shown_numbers
from enerf_ns.evaluation.scores import summary_scores
from enerf_ns.evaluation.views import aligned_views
from enerf_ns.export.surface import VOXEL_PIXELS, fused, pixel_size, surface_views
from enerf_ns.export.turntable import turntable
from enerf_ns.method.held_out_views import held_out_views, scores_at_stated_poses
from enerf_ns.method.runs import Run, load
from enerf_ns.poses.findings import findings
from enerf_ns.report.figures import Curve, error_against, step_breakdown, work_precision
from enerf_ns.report.film import Screen, animated, poster_of, render_moving, render_video
from enerf_ns.report.page import Part, markdown, page
from enerf_ns.report.pictures import camera_path, columns_of, side_by_side
from enerf_ns.report.pose_figure import corrections_over_time
from enerf_ns.report.reported import Reported
from enerf_ns.report.run_files import RunFiles, read_run, run_names
from enerf_ns.report.score_tables import poses_table, score_tables
from enerf_ns.report.scoring import DEFAULT_SCORING, Scoring
from enerf_ns.report.tables import history_csv, reach_table, step_parts, step_table
from enerf_ns.report.trade_offs import default_targets

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from enerf_ns.method.pipeline import EnerfPipeline

LEFT_OUT = "so pictures, video and new scores are left out"
"""Words on a run whose field or recording cannot be read."""


def write_report(
    runs: Sequence[Run | Path],
    output_dir: Path,
    reach: Sequence[float] | None = None,
    scoring: Scoring = DEFAULT_SCORING,
    video: bool = True,
) -> dict[str, dict[str, Any]]:
    """Writes a report of runs.

    The files are report.html, report.md, error-against-time.csv, scores.json and the plots. Each run that can be loaded
    adds side-by-side.png, camera_path.json, video.mp4, moving.webp and mesh.webp. With several runs, each has a folder
    for these.

    Scores of a finished run are those at the end of its history. Scores of another run are those of its newest whole
    checkpoint, or, if there is none, those of the last row of its history that has scores, over a few frames.

    Args:
        runs: At least one run, folder of a run, or config.yml. A run that cannot be read becomes a row with the reason.
        output_dir: Folder, made if it does not exist.
        reach: Values of PSNR in dB for the table of times. None: up to four values that a run reaches.
        scoring: Scoring of held-out frames. With other values than the defaults, they are rendered again.
        video: Whether to render video.mp4, moving.webp and mesh.webp.

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


def _read(runs: Sequence[Run | Path]) -> tuple[list[Reported], dict[str, str]]:
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
    reported = [Reported(files, notes=list(files.notes)) for files in read.values()]
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


def _look_at(one: Reported, run: Run | None, output_dir: Path, scoring: Scoring, video: bool) -> None:
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
    if run is None:
        _take_preview(one)
    else:
        try:
            _look_at_field(one, run, at_end, output_dir, scoring, video)
        except RecordingError as error:  # of a frame, say, which is read only here
            one.notes.append(f"{str(error).rstrip('.')}; {LEFT_OUT}.")
            _take_preview(one)
    if history:
        one.seconds = one.files.seconds_at(one.step)
    elif run is not None:
        one.seconds = run.train_seconds


def _look_at_field(one: Reported, run: Run, at_end: bool, output_dir: Path, scoring: Scoring, video: bool) -> None:
    """Fills in what a loaded run shows. Its field is scored, too, unless the history has scores at its end.

    Raises:
        RecordingError: A file of the recording cannot be read.
        FlagError: The crop of the scoring is larger than the frames.
        OutputError: The folder cannot be written to, or the disk is full.
    """
    dataset = run.pipeline.datamanager.eval_dataset
    camera = dataset.recording.camera
    one.events, one.sensor = len(index_events(dataset.recording)), f"{camera.width} x {camera.height} pixels"
    one.sensor += f", {camera.model}"
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
    if refiner.looks:
        one.poses = [row.as_dict() for row in findings(refiner, distance)]
    is_panorama = run.pipeline.model.config.panorama
    screen = Screen.of(views, None if is_panorama else run.pipeline.datamanager.depth_range)
    if is_panorama:
        one.notes.append(
            "The camera only turned, so that the run is a panorama: it has no depth, no mesh and no scores of "
            "depth, and its pictures are right only for views from where the camera was."
        )
    views, _ = aligned_views(views, scoring.protocol, encoded=False)
    one.columns = columns_of(views, dataset.recording, screen.exponent)
    one.caption = _caption(shown, len(dataset), stored, dataset.are_frames, screen)
    picture = _png(side_by_side(one.columns, views))
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
            one.video_note = f"Flight past the held-out cameras: {screen.gamma}."
            if not is_panorama:
                one.video_note = one.video_note[:-1] + " on the left, depth on the right."
            one.moving, one.video = ((folder / name).read_bytes() for name in ("moving.webp", "video.mp4"))
            one.poster = poster_of(folder / "video.mp4")
            one.mesh = None if is_panorama else _turning_mesh(one, run.pipeline)
            if one.mesh is not None:
                write_whole(folder / "mesh.webp", one.mesh)


def _loaded(one: Reported) -> Run | None:
    """The loaded run. If it cannot be loaded, None, and a note with the reason is added."""
    recording = one.files.config.data
    if recording is not None and not recording.exists():
        one.notes.append(
            f"The recording {recording} is not there any more, {LEFT_OUT}; put it back, or a link to it (ln -s NEW "
            f"{quoted(recording)}), and run enerf report again."
        )
        return None
    if not one.files.stored:
        one.notes.append(f"No whole checkpoint is stored, {LEFT_OUT}; wait for one, or train again.")
        return None
    try:
        return load(one.files.config_file)
    except RecordingError as error:
        one.notes.append(f"{str(error).rstrip('.')}; {LEFT_OUT}.")
        return None


def _take_preview(one: Reported) -> None:
    """Takes the newest preview that training wrote, if there is one."""
    previews = sorted((one.files.folder / "previews").glob("step-*.png"))
    if previews:
        one.picture = f"{one.prefix}preview.png", previews[-1].read_bytes()
        one.caption = f"Newest preview that training wrote: {previews[-1].name}."


def _caption(shown: Sequence[int], number: int, steps: int, are_frames: bool, screen: Screen) -> str:
    """Sentences about the pictures of some of a number of held-out views after a number of training steps."""
    errors = "In the column of errors, orange means that the render is too bright, and purple that it is too dark."
    sentences = [
        f"Held-out {'frames' if are_frames else 'poses'} {', '.join(map(str, shown))} of {number} (numbers start at 0) "
        f"after {steps:,} training steps.",
        errors * are_frames,
        "Events are those around the time of each pose." * (not are_frames),
        f"Brightness is displayed as {screen.gamma}." * (screen.exponent < 1.0),
    ]
    return " ".join(filter(None, sentences))


def _turning_mesh(one: Reported, pipeline: EnerfPipeline) -> bytes | None:
    """Animated WebP of the mesh that `enerf export mesh` makes; None, and a note, if there is no mesh."""
    try:
        camera, views = surface_views(pipeline)
        mesh = fused(camera, views, VOXEL_PIXELS * pixel_size(camera, views))
        if len(mesh.faces):
            return animated(turntable(mesh, camera, views[len(views) // 2].pose))
        one.notes.append("The mesh has no surface, so it is left out; train longer.")
    except UserError as error:
        one.notes.append(f"The mesh is left out: {str(error).rstrip('.')}.")
    return None


def _files(
    reported: Sequence[Reported],
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
    first, others = score_tables(reported, unread)
    plots = {
        "error-against-seconds.png": error_against("seconds", curves),
        "work-precision.png": work_precision(curves),
        "error-against-steps.png": error_against("step", curves),
        "step.png": step_breakdown(steps) if steps else None,
    }
    pngs = {name: _png(figure) for name, figure in plots.items() if figure is not None}

    def figures(name: str) -> dict[str, bytes]:
        return {name: pngs[name]} if name in pngs else {}

    reached = targets and any("psnr" in row.scores for _, history in histories for row in history)
    parts = [
        Part("Scores", [first], is_folded=False),
        Part("Other scores", others),
        Part("Error against training time", (), figures("error-against-seconds.png"), is_folded=False),
        Part("Final error against training time", (), figures("work-precision.png"), is_folded=False),
        Part("Error against training steps", (), figures("error-against-steps.png")),
        Part("Time to reach a PSNR", [reach_table(histories, targets)] if reached else []),
        Part("Time of a training step by part", [step_table(steps)] if steps else [], figures("step.png")),
    ]
    for one in reported:
        corrections = {} if one.corrections is None else {f"{one.prefix}corrections.png": one.corrections}
        title = "Clock, poses and lens" + (f", {one.name}" if len(reported) > 1 else "")
        parts.append(Part(title, [poses_table(one)] if one.poses else [], corrections))
    parts = [part for part in parts if part.tables or part.figures]
    return {
        "report.html": page(reported, parts).encode(),
        "report.md": markdown(reported, parts).encode(),
        "error-against-time.csv": history_csv(histories).encode(),
        "scores.json": (json.dumps(entries, indent=2) + "\n").encode(),
        **{name: content for part in parts for name, content in part.figures.items()},
        **{one.picture[0]: one.picture[1] for one in reported if one.picture},
    }


def _numbers(scores: dict[str, Any]) -> dict[str, float]:
    return {name: float(value) for name, value in scores.items() if isinstance(value, (int, float))}


def _png(figure: Figure) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png")
    return content.getvalue()
