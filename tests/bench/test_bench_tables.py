"""The table of a result file: means, what is published, what is missing, where the order is another."""

from __future__ import annotations

import csv
import json
from typing import Any

import pytest
from rich.console import Console

from enerf_ns.bench.tables import changes_since, changes_table, csv_table, disagreements, markdown, scores_table


def run(row: str, psnr: float | None, sequence: str = "shake", seed: int = 0, **changes: Any) -> dict[str, Any]:
    scores = {"log-affine-set": {} if psnr is None else {"psnr": psnr, "ssim": 0.5}}
    about = {"device": "CPU", "threads": 1, "version": "1.0"}
    return {
        "row": row,
        "sequence": sequence,
        "seed": seed,
        "steps": 10,
        "seconds": 2.0,
        "scores": scores,
        **about,
        **changes,
    }


def results(*runs: dict[str, Any], **changes: Any) -> dict[str, Any]:
    return {
        "experiment": "made-up",
        "sentence": "What is compared.",
        "command": "enerf bench made-up --budget 10",
        "method": "enerf",
        "budget": "10",
        "scale": 0.25,
        "columns": ["psnr", "ssim"],
        "protocols": ["log-affine-set"],
        "mean": False,
        "published": {"shake": {"events": {"psnr": 30.0, "ssim": 0.9}, "frames": {"psnr": 20.5, "ssim": 0.4}}},
        "source": "the paper",
        "notes": ["A note."],
        "reconstruction_weights": None,
        "left_out": {},
        "runs": list(runs),
    } | changes


def rows_of(table: str) -> list[list[str]]:
    """Cells of a Markdown table, without its head."""
    found = [line for line in table.splitlines() if line.startswith("| ")]
    return [line.strip("| ").split(" | ") for line in found[2:]]


def test_our_values_stand_beside_those_that_are_published():
    table = markdown(results(run("events", 25.128), run("frames", 21.0)))
    assert rows_of(table) == [
        ["shake", "events", "**25.13**", "**0.500**", "1.00", "10", "30.00", "0.90"],
        ["shake", "frames", "21.00", "**0.500**", "1.00", "10", "20.50", "0.40"],
    ]
    assert table.startswith("    enerf bench made-up --budget 10\n") and "* A note.\n" in table
    assert "1 CPU thread; version 1.0" in table and "at scale 0.25" in table and "10 steps" in table


def test_several_seeds_are_a_mean_and_a_standard_deviation():
    table = markdown(results(*(run("events", psnr, seed=seed) for seed, psnr in enumerate((20.0, 22.0, 27.0)))))
    assert rows_of(table)[0][2] == "23.00 ± 3.61"  # the square root of (9 + 1 + 16) / 2


def test_means_over_sequences_are_of_the_seeds_that_have_all_sequences():
    runs = [run("events", 10.0 * seed + place, f"s{place}", seed) for seed in range(3) for place in (1, 3)]
    runs[-1] = {**runs[-1], "failure": "No room."}
    table = markdown(results(*runs, mean=True, published={"mean": {"events": {"psnr": 28.1, "ssim": 0.88}}}))
    assert rows_of(table) == [["mean", "events", "7.00 ± 7.07", "0.500 ± 0.000", "1.00", "10", "28.10", "0.88"]]
    assert "s3, events, seed 2 failed: No room." in table


def test_a_mean_that_is_published_beside_sequences_has_a_line():
    published = {"a": {"theirs": {"psnr": 1.0}}, "mean": {"theirs": {"psnr": 3.5}}}
    found = rows_of(markdown(results(run("events", 1.0, "a"), run("events", 4.0, "b"), published=published)))
    assert [line[:3] for line in found] == [
        ["a", "events", "1.00"],
        ["a", "theirs", "-"],
        ["b", "events", "4.00"],
        ["mean", "events", "2.50"],
        ["mean", "theirs", "-"],
    ]
    assert [line[-1] for line in found] == ["-", "1.00", "-", "-", "3.50"]


def test_what_is_published_is_of_the_first_protocol():
    scores = {"raw": {"psnr": 10.0}, "log-affine-set": {"psnr": 16.0}}
    one = run("events", None) | {"scores": scores}
    found = rows_of(markdown(results(one, protocols=["raw", "log-affine-set"])))
    assert [[line[1], line[2], line[3], line[-2]] for line in found] == [
        ["events", "raw", "10.00", "30.00"],
        ["events", "log-affine-set", "16.00", "-"],
        ["frames", "raw", "-", "20.50"],
    ]


def test_what_failed_and_what_is_left_out_say_why():
    failed = run("frames", None, failure="The recording holds no frames.")
    table = markdown(results(run("events", 25.0), failed, left_out={"e2vid": "no weights"}))
    assert rows_of(table)[1][:6] == ["shake", "frames", "-", "-", "-", "-"]
    assert "* shake, frames, seed 0 failed: The recording holds no frames.\n" in table
    assert "* e2vid is left out: no weights.\n" in table


def test_time_is_a_ratio_to_events_of_the_same_seed_so_that_machines_may_differ():
    seconds = {0: {"frames": 8.0, "events": 8.0}, 1: {"frames": 2.0, "events": 1.0}}
    told = [
        run(row, 21.0, seed=seed, processor_seconds=took) for seed, of in seconds.items() for row, took in of.items()
    ]
    table = markdown(results(*told))
    assert {line[1]: line[4] for line in rows_of(table)} == {"frames": "1.50", "events": "1.00"}
    assert "on the processor, divided by that of events on the same sequence with the same seed: 1 to 8 s." in table
    without = results(
        run("frames", 21.0), run("both", 25.0, seconds=1.0), run("gone", None, failure="No room."), published={}
    )
    assert {line[1]: line[4] for line in rows_of(markdown(without))} == {"frames": "1.00", "both": "0.50", "gone": "-"}
    failed = results(run("frames", 21.0), run("events", None, failure="No room."))
    assert [line[4] for line in rows_of(markdown(failed))][:2] == ["-", "-"]


def test_a_score_that_a_run_has_not_is_a_dash():
    assert rows_of(markdown(results(run("events", None))))[0][2] == "-"


@pytest.mark.parametrize(
    ("events", "frames", "columns", "differs"),
    [
        (25.0, 21.0, ["psnr"], False),
        (21.0, 25.0, ["psnr"], True),
        (21.0, 21.0, ["psnr"], False),  # neither is better
        (25.0, 21.0, ["lpips"], False),
        (21.0, 25.0, ["lpips"], True),
    ],
)
def test_the_order_of_rows_is_compared_with_the_published_one(events, frames, columns, differs):
    """Of lpips, less is better, also in what is published; so both orders are turned round."""
    runs = [run(row, None, scores={"log-affine-set": {columns[0]: value}}) for row, value in
            (("events", events), ("frames", frames))]  # fmt: skip
    published = {"shake": {"events": {columns[0]: 30.0}, "frames": {columns[0]: 20.5}}}
    found = disagreements(results(*runs, columns=columns, published=published))
    assert found is not None and bool(found) == differs
    if differs:
        better, worse = ("frames", "events") if columns == ["psnr"] else ("events", "frames")
        assert found[0].startswith(f"shake: {better} is better than {worse} here (")
    assert ("the same order" in markdown(results(*runs, columns=columns, published=published))) != differs


def test_a_difference_of_order_within_the_spread_of_the_seeds_is_called_so():
    def told(spread: float) -> str:
        runs = [run("events", 22.0 + sign * spread, seed=seed) for seed, sign in enumerate((-1, 1))]
        runs += [run("frames", 22.5 + sign * spread, seed=seed) for seed, sign in enumerate((-1, 1))]
        return (disagreements(results(*runs)) or [""])[0]

    assert "less than the seeds differ" in told(1.0) and "less than the seeds differ" not in told(0.01)


def test_nothing_is_said_of_an_order_that_nobody_published():
    assert disagreements(results(run("events", 25.0), published={})) is None


def test_rows_from_several_versions_are_told():
    table = markdown(results(run("events", 25.0), run("frames", 21.0, version="2.0")))
    assert "more than one version" in table
    assert "more than one version" not in markdown(results(run("events", 25.0), run("frames", 21.0)))


def test_the_table_is_made_of_the_file_alone():
    told = results(run("events", 25.0), run("frames", 26.0))
    assert markdown(json.loads(json.dumps(told))) == markdown(told)


def test_the_terminal_shows_the_cells_of_the_markdown():
    told = results(run("events", 25.0), run("frames", 26.0))
    console = Console(width=200)
    with console.capture() as shown:
        console.print(scores_table(told).rich())
    for line in rows_of(markdown(told)):
        assert any(all(cell.strip("*") in printed for cell in line) for printed in shown.get().splitlines())
    assert "**" not in shown.get()


def test_the_best_row_of_each_sequence_is_bold_where_there_is_another():
    def cells(*runs: dict[str, Any], column: str = "psnr") -> list[str]:
        return [line[2] for line in rows_of(markdown(results(*runs, columns=[column], published={})))]

    def depth(row: str, error: float) -> dict[str, Any]:
        return run(row, 1.0, scores={"log-affine-set": {"depth_rmse": error, "brightness_scale": error}})

    assert cells(run("events", 25.0), run("frames", 26.0)) == ["25.00", "**26.00**"]
    assert cells(run("events", 25.0, "a"), run("frames", 24.0, "a"), run("events", 23.0, "b")) == [
        *("**25.00**", "24.00"),
        *("23.00", "-"),
    ]
    assert cells(depth("events", 0.2), depth("frames", 0.3), column="depth_rmse") == ["**0.200**", "0.300"]
    assert cells(depth("events", 0.2), depth("frames", 0.3), column="brightness_scale") == ["0.200", "0.300"]
    assert cells(run("events", 25.001), run("frames", 25.004), run("both", 24.0)) == ["**25.00**", "**25.00**", "24.00"]


def test_csv_has_a_line_for_each_run_that_finished():
    told = results(run("events", 25.0), run("frames", None, failure="No room."), run("events", 26.0, seed=1))
    found = list(csv.DictReader(csv_table(told).splitlines()))
    assert [(line["row"], line["seed"], float(line["psnr"])) for line in found] == [
        ("events", "0", 25.0),
        ("events", "1", 26.0),
    ]


def test_what_a_score_should_be_stands_in_brackets_where_it_is_known():
    known = {"brightness_scale": 0.75, "true_brightness_scale": 0.8}
    runs = [run("learned", None, scores={"log-affine-set": known})]
    runs += [run("learned", None, "other", scores={"log-affine-set": {"brightness_scale": 0.5}})]
    found = rows_of(markdown(results(*runs, columns=["brightness_scale"], published={})))
    assert [line[2] for line in found] == ["0.750 (0.800)", "0.500"]


def test_a_mean_over_a_part_of_the_sequences_is_named_by_them_and_compared_with_the_same_ones():
    whole = {"mean": True, "sequences": ["a", "b"], "published": {"mean": {"events": {"psnr": 30.0}}}}
    both = results(run("events", 25.0, "a"), run("events", 21.0, "b"), **whole)
    part = results(run("events", 21.0, "b"), **whole)
    assert [line[:3] for line in rows_of(markdown(both))] == [["mean", "events", "23.00"]]
    assert rows_of(markdown(both))[0][-1] == "30.00"
    assert [line[:3] for line in rows_of(markdown(part))] == [["mean of b", "events", "21.00"]]
    assert "30.00" not in markdown(part)
    backwards = {**both, "runs": both["runs"][::-1]}
    for old in (both, backwards, {name: value for name, value in both.items() if name != "sequences"}):
        assert [(change.row, change.before, change.now) for change in changes_since(part, old)] == [
            ("events", 21.0, 21.0)
        ]


def test_what_became_of_each_row_since_another_version_stands_worst_first():
    before = results(run("events", 25.0), run("events", 27.0, seed=1), run("frames", 20.0), run("gone", 20.0))
    now = results(run("events", 25.65), run("events", 25.65, seed=1), run("frames", 25.0), run("new", 9.0))
    changes = changes_since(now, before)
    assert [(change.row, change.before, change.now) for change in changes] == [
        ("events", 26.0, pytest.approx(25.65)),
        ("frames", 20.0, 25.0),
    ]
    assert [change.loses for change in changes] == [True, False]
    assert not changes_since(results(run("events", 25.71)), before)[0].loses, "less than 0.3 dB may be lost"
    console = Console(width=140, record=True)
    console.print(changes_table(changes, "before.json").rich())
    told = console.export_text()
    assert told.count("more than 0.3 dB lost") == 1 and "-0.35" in told and "+5.00" in told
