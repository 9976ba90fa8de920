"""The tables of a report that need the reported runs: scores, and errors of clock, poses and lens."""

from __future__ import annotations

from collections.abc import Sequence

from enerf_ns.evaluation.protocols import DEFAULT_PROTOCOL, described
from enerf_ns.evaluation.views import EXPECTED_SCALE
from enerf_ns.report.figures import SCORES
from enerf_ns.report.reported import Reported
from enerf_ns.report.tables import NONE, Table, score_cell

COLUMNS = 6
"""Most columns of a table of scores."""

FIRST_SCORES = ("event_correlation", "psnr", "depth_rmse", "ssim", "event_rmse", "event_sign", "lpips")
"""Scores in the order in which they get into the first table."""


def score_tables(reported: Sequence[Reported], unread: dict[str, str]) -> tuple[Table, list[Table]]:
    """Scores, time and state of each run: a table of the first scores, and tables of all others.

    Columns without any value are left out.

    Args:
        reported: At least one run.
        unread: Reasons why other runs cannot be read, by path.
    """
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
            "on the path": NONE if (on_path := one.scores.get("held_out_on_path")) is None else f"{on_path:.0f}",
            "protocol": one.protocol if one.scores else NONE,
        }
        for one in reported
    ]
    rows += [dict.fromkeys(rows[0], NONE) | {"run": path, "state": fault} for path, fault in unread.items()]
    header = [name for name in rows[0] if any(row[name] != NONE for row in rows)]
    is_done = all(one.files.state == "done" for one in reported) and not unread
    first = ["run", *([] if is_done else ["state"]), "training time"]
    chosen = [SCORES[name] for name in FIRST_SCORES if SCORES[name] in header][: COLUMNS - len(first)]
    first = [name for name in header if name in (*first, *chosen)]
    others = [name for name in header if name not in first]
    with_frames = any(one.has_frames for one in reported)
    notes = [
        "Scores are means over held-out frames." * with_frames,
        "Training time is that of the training steps alone, up to the scored step.",
    ]
    protocols = dict.fromkeys(one.protocol for one in reported if one.scores)
    other_notes = [
        "A held-out frame is on the path if its pose lies among the training poses." * ("on the path" in header),
        "The brightness scale is the factor by which the fit multiplies the contrast of renders. The expected value is "
        "in brackets, if the recording states it: the sensor's mean contrast threshold divided by the one that "
        "training used." * ("brightness scale" in header),
        *map(described, protocols),
    ]

    def table(names: Sequence[str], number: int, sentences: Sequence[str] = ()) -> Table:
        note = " ".join(filter(None, sentences))
        return Table("Scores", names, [[row[name] for name in names] for row in rows[:number]], note)

    groups = [others[start : start + COLUMNS - 1] for start in range(0, len(others), COLUMNS - 1)]
    more = [table(["run", *group], len(reported), other_notes if group is groups[-1] else ()) for group in groups]
    return table(first, len(rows), notes), more


def _brightness_scale(one: Reported) -> str:
    """Brightness scale of each fitted channel, and in brackets the expected one.

    Only a run that learns from events has it, because the contrast of its field is in units of the thresholds.
    """
    names = [name for name in one.scores if name.startswith("brightness_scale") and name != EXPECTED_SCALE]
    if not names or one.protocol != DEFAULT_PROTOCOL or "events" not in one.files.learns_from:
        return NONE
    expected = one.scores.get(EXPECTED_SCALE)
    brackets = [] if expected is None else [f"({score_cell(EXPECTED_SCALE, expected)})"]
    return " ".join([*(score_cell(name, one.scores[name]) for name in names), *brackets])


def poses_table(one: Reported) -> Table:
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
            " All scores are at the corrected poses, which were not fitted to held-out frames. Scores at the "
            f"poses of the recording: {scores}."
        )
    header = ["part", "correction", "error", "image motion", "flag"]
    return Table("Clock, poses and lens", header, rows, note)
