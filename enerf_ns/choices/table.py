"""Output of training on the recording, the choices, and the errors of clock, poses and lens."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from enerf_ns.choices.resolution import Choice
from enerf_ns.dataparsers.event_dataparser import EventDataParserConfig
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.inspection.agreement import why_no_search
from enerf_ns.dataparsers.inspection.evidence import Evidence
from enerf_ns.dataparsers.inspection.problems import find_problems
from enerf_ns.dataparsers.recording.errors import printable
from enerf_ns.dataparsers.scene.depth_range import recording_parallax
from enerf_ns.dataparsers.scene.scene_box import scene_normalisation
from enerf_ns.poses.findings import Finding

PREFIX = "--pipeline."
"""Begin of the flags, which stands once below a table."""


def recording_table(parser: EventDataParserConfig) -> Table:
    """The table of the contents of a recording, its depths, its box and its problems."""
    recording = parser.setup().recording()
    index, camera = index_events(recording), recording.camera
    first, last = index.span
    seconds = max(last - first, 1) * 1e-9
    depth = parser.depth_range
    rows = {
        "folder": f"{recording.path} ({recording.format})",
        "events": f"{len(index):,}, {100 * index.num_positive / len(index):.0f} % on",
        "span": f"{seconds:.2f} s",
        "rate": f"{len(index) / seconds / 1e6:.2f} million events/s, "
        f"{len(index) / (camera.width * camera.height):.1f} a pixel",
        "sensor": f"{camera.width} x {camera.height}, {camera.model}",
        "poses": f"{len(recording.trajectory.times):,}",
    }
    for name, frames in {"frames": recording.frames, "blurred frames": recording.blurred_frames}.items():
        if frames is None:
            rows[name] = "none"
            continue
        depth_note = ", with depth" if frames.depth_filenames else ""
        rows[name] = (
            f"{len(frames.times)}, {frames.camera.width} x {frames.camera.height}{depth_note}{frames.white_in_words}"
        )
    if depth is not None and depth == recording_parallax(recording).panorama_range:
        rows["depths"] = "unknown: the camera only turns"
    elif depth is not None:
        _, scale, box = scene_normalisation(recording, *depth, parser.box)
        rows["depths"] = f"{depth[0]:.2f} m to {depth[1]:.2f} m"
        rows["box"] = " x ".join(f"{side:.2f}" for side in (box[1] - box[0]) / scale) + " m"
    table = Table(title="Recording", show_header=False, title_justify="left")
    for name, value in rows.items():
        table.add_row(name, Text(printable(value)))
    for note in (*recording.notes, *index.notes):
        table.add_row("note", Text(printable(note), "yellow"))
    evidence = Evidence.of(recording)
    unknown = filter(None, [why_no_search(recording, depth), *evidence.unknown])
    for problem in [*find_problems(recording, depth), *evidence.problems]:
        what, advice = printable(problem.what), printable(problem.advice)
        table.add_row(Text("problem", "red"), Text.assemble((what, "red"), f" {advice}"))
    for one in unknown:
        table.add_row("note", Text(printable(one.sentence), "yellow"))
    return table


def choices_text(choices: Sequence[Choice], columns: int) -> str:
    """The choices as text: the parts of the method, whether each is kept, why, and the flag that forces it.

    Args:
        choices: The rows.
        columns: Width of the lines. A flag is never broken.
    """

    def lines(text: str, indent: str = "    ") -> list[str]:
        return textwrap.wrap(text, columns, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)

    found = []
    for choice in choices:
        value = f": {choice.value}" if choice.value else ""
        found += lines(f"{choice.part}, {'kept' if choice.kept else 'left out'}{value}")
        found += [*lines(f"    because {choice.why}"), f"    {choice.flag}", ""]
    return "\n".join(found)


def findings_table(found: Sequence[Finding]) -> Table:
    """The table of the errors of clock, poses and lens, and the distance (pixels) by which each moves the picture."""
    caption = f"forced or forbidden by {PREFIX}FLAG True or False"
    table = Table(title="Clock, poses and lens", caption=caption)
    table.title_justify = table.caption_justify = "left"
    for column in ("part", "", "found", "moves the picture by"):
        table.add_column(column, overflow="fold")
    table.add_column("flag", no_wrap=True)
    for row in found:
        kept = "[green]corrected[/green]" if row.is_corrected else "[dim]as stated[/dim]"
        value = row.value if row.is_identifiable else f"not identifiable ({row.value})"
        moved = f"{row.pixels:.2g} pixels" if row.is_corrected else ""
        table.add_row(row.what, kept, Text(value), moved, Text(row.flag.removeprefix(PREFIX), "dim"))
    return table
