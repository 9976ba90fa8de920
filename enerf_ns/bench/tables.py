"""Tables of the results of an experiment, made from its result file alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import combinations
from statistics import mean, stdev
from typing import Any

from enerf_ns.bench.numerics.case import shown
from enerf_ns.bench.published import MEAN
from enerf_ns.report.tables import NONE, Table, csv_text

Results = dict[str, Any]
"""Contents of a result file (`Bench.results`)."""

DIGITS = {
    "psnr": 2,
    "depth_rmse_all_poses": 2,
    "ms_a_step": 0,
    "megabytes_a_step": 1,
    "refractory_ms": 2,
    **dict.fromkeys(("sample", "poses", "rays", "images", "forward_and_backward"), 2),
}
"""Number of decimals of scores, if not 3."""

TITLES = {
    "psnr": "PSNR, dB",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "lpips_vgg": "LPIPS (VGG)",
    "depth_rmse": "depth RMSE, m",
    "depth_rmse_all_poses": "depth RMSE, m",
    "near_depth_error": "median depth error, m",
    "ms_a_step": "ms a step",
    "megabytes_a_step": "MB a step",
    "forward_and_backward": "forward and backward",
    "brightness_scale": "scale",
    "event_correlation": "correlation of held-out events",
    "threshold_ratio": "C_on / C_off",
    "refractory_ms": "refractory period, ms",
    "threshold_map_on": "map of C_on",
    "threshold_map_off": "map of C_off",
}
"""Titles of scores, if not their names."""

LARGEST_LOSS = 0.3
"""PSNR (dB, mean over the seeds) that a row may lose against another version."""

LOWER_IS_BETTER = ("lpips", "lpips_vgg", "depth_rmse", "depth_rmse_all_poses", "near_depth_error", "ms_a_step")
HIGHER_IS_BETTER = ("psnr", "ssim", "correlation", "event_correlation")


@dataclass
class Line:
    """One line of a table."""

    sequence: str
    row: str
    protocol: str
    scores: dict[str, list[float]] = field(default_factory=dict)
    """Scores by name, one for each seed."""
    published: dict[str, float] = field(default_factory=dict)
    """Published scores by name."""
    times: list[float] = field(default_factory=list)
    """Training time, one for each seed: a ratio to that of `reference_row` on the same sequence with the same seed, so
    that neither the machine nor its load counts."""
    steps: list[int] = field(default_factory=list)
    """Number of training steps of each run."""


def lines(results: Results) -> list[Line]:
    """The lines of the table by sequence: first the rows of the experiment, then rows that are only published.

    A mean over a part of the sequences is named by them, and has no published scores beside it.
    """
    runs, published = results["runs"], results["published"]
    sequences = list(dict.fromkeys(run["sequence"] for run in runs))
    rows = list(dict.fromkeys(run["row"] for run in runs))
    of_reference = _reference_seconds(results)
    whole = results.get("sequences", sequences)
    missing = set(whole).difference(sequences)
    of_mean = f"{MEAN} of {', '.join(name for name in whole if name in sequences)}" if missing else MEAN
    blocks = [] if results["mean"] else [[sequence] for sequence in sequences]
    if results["mean"] or (MEAN in published and not missing):
        blocks.append(sequences)
    found = []
    for number, block in enumerate(blocks):
        is_mean = results["mean"] or number == len(sequences)
        name = of_mean if is_mean else block[0]
        of_block = published.get(name, {})
        for row in rows:
            for place, protocol in enumerate(results["protocols"]):
                line = Line(name, row, protocol, published=of_block.get(row, {}) if place == 0 else {})
                chosen = [run for run in runs if run["row"] == row and run["sequence"] in block]
                _fill(line, chosen, len(block), of_reference)
                found.append(line)
        others = [row for row in of_block if row not in rows]
        found += [Line(name, row, results["protocols"][0], published=of_block[row]) for row in others]
    return found


def reference_row(results: Results) -> str:
    """The row whose training time is the unit of the others: `events` if it is there, else the first one."""
    rows = [run["row"] for run in results["runs"]]
    return rows[0] if rows and "events" not in rows else "events"


def _reference_seconds(results: Results) -> dict[tuple[str, int], float]:
    """Training time in seconds of the reference row by sequence and seed, where it did not fail."""
    runs = [run for run in results["runs"] if "failure" not in run]
    row = reference_row(results)
    return {(run["sequence"], run["seed"]): seconds_of(run) for run in runs if run["row"] == row}


def _fill(
    line: Line, runs: list[dict[str, Any]], num_sequences: int, of_reference: dict[tuple[str, int], float]
) -> None:
    """Adds the mean scores over the sequences, for each seed that has all sequences."""
    for seed in dict.fromkeys(run["seed"] for run in runs):
        done = [run for run in runs if run["seed"] == seed and "failure" not in run]
        if len(done) < num_sequences:
            continue
        references = [of_reference.get((run["sequence"], run["seed"])) for run in done]
        times = [seconds_of(run) / seconds for run, seconds in zip(done, references, strict=True) if seconds]
        line.times += [mean(times)] if len(times) == num_sequences else []
        line.steps += [run["steps"] for run in done]
        scores = [run["scores"][line.protocol] for run in done]
        for name in scores[0]:
            values = [of_run[name] for of_run in scores if of_run.get(name) is not None]
            if len(values) == num_sequences:
                line.scores.setdefault(name, []).append(mean(values))


def seconds_of(run: dict[str, Any]) -> float:
    """Training time of a run, s: that of the processor on a CPU, which other programs change less."""
    return run["processor_seconds"] if run["device"] == "CPU" and "processor_seconds" in run else run["seconds"]


@dataclass(frozen=True)
class Change:
    """PSNR of a row in another version and now, means over seeds in dB."""

    sequence: str
    row: str
    before: float
    now: float

    @property
    def loses(self) -> bool:
        """Whether the row lost more than `LARGEST_LOSS`."""
        return self.now < self.before - LARGEST_LOSS


def changes_since(results: Results, before: Results) -> list[Change]:
    """The change of each row on the sequences that both results have, largest loss first."""
    sequences = {run["sequence"] for run in results["runs"]} & {run["sequence"] for run in before["runs"]}
    whole = results.get("sequences", [*sequences])
    then, now = (_psnr_of_rows(one, sequences, whole) for one in (before, results))
    found = [Change(*key, mean(then[key]), mean(now[key])) for key in now if key in then]
    return sorted(found, key=lambda change: change.now - change.before)


def _psnr_of_rows(results: Results, sequences: set[str], whole: list[str]) -> dict[tuple[str, str], list[float]]:
    """PSNR of each row on some sequences of the whole experiment, one for each seed."""
    runs = [run for run in results["runs"] if run["sequence"] in sequences]
    table = lines({**results, "runs": runs, "sequences": whole})
    return {(line.sequence, line.row): line.scores["psnr"] for line in table if line.scores.get("psnr")}


def changes_table(changes: list[Change], file: str) -> Table:
    """The changes since the results in a file, as `changes_since` orders them."""
    rows = []
    for change in changes:
        mark = f"  more than {LARGEST_LOSS:g} dB lost" * change.loses
        numbers = f"{change.before:.2f}", f"{change.now:.2f}", f"{change.now - change.before:+.2f}{mark}"
        rows.append([change.sequence, change.row, *numbers])
    header = ["sequence", "row", "before, dB", "now, dB", "change, dB"]
    return Table(f"PSNR against {file}, largest loss first", header, rows, num_words=2)


def scores_table(results: Results, bold: bool = False) -> Table:
    """The scores of all rows and sequences beside the published ones.

    Args:
        bold: Whether the best mean of each sequence is bold, as Markdown marks it, where several rows have one.
    """
    table, columns = lines(results), results["columns"]
    theirs = [name for name in columns if any(name in line.published for line in table)]
    several = len(results["protocols"]) > 1
    source = results["source"]
    head = ["sequence", "row", *(["protocol"] if several else []), *map(_title, columns)]
    head += ["time", "steps", *(f"{source}: {_title(name)}" for name in theirs)]
    content = []
    for line in table:
        cells = [line.sequence, line.row, *([line.protocol] if several else [])]
        for name in columns:
            cell = _score(name, line.scores.get(name, [])) + _truth(name, line)
            cells.append(f"**{cell}**" if bold and _is_best(line, name, table) else cell)
        cells += [f"{mean(line.times):.2f}" if line.times else NONE]
        cells += [f"{mean(line.steps):.0f}" if line.steps else NONE]
        cells += [_published(name, line.published[name]) if name in line.published else NONE for name in theirs]
        content.append(cells)
    return Table(f"{results['experiment']}: {results['sentence']}", head, content, num_words=2)


def _is_best(line: Line, name: str, table: list[Line]) -> bool:
    """Whether no other row of the same sequence and protocol has a better mean, as the table prints it."""
    if name not in (*LOWER_IS_BETTER, *HIGHER_IS_BETTER):
        return False
    rivals = [
        round(mean(one.scores[name]), DIGITS.get(name, 3))
        for one in table
        if (one.sequence, one.protocol) == (line.sequence, line.protocol) and one.scores.get(name)
    ]
    best = (min if name in LOWER_IS_BETTER else max)(rivals, default=None)
    values = line.scores.get(name)
    return bool(values) and len(rivals) > 1 and round(mean(values), DIGITS.get(name, 3)) == best


def _title(name: str) -> str:
    return TITLES.get(name, name)


def _score(name: str, values: list[float]) -> str:
    if not values:
        return NONE
    digits = DIGITS.get(name, 3)
    spread = f" ± {stdev(values):.{digits}f}" if len(values) > 1 else ""
    return f"{mean(values):.{digits}f}{spread}"


def _truth(name: str, line: Line) -> str:
    """The true value of a score in brackets, if known."""
    values = line.scores.get(f"true_{name}")
    return f" ({_score(name, [mean(values)])})" if values else ""


def _published(name: str, value: float) -> str:
    """A published score as printed there, with at least two decimals if ours has decimals."""
    digits = len(f"{value:g}".partition(".")[2])
    return f"{value:.{max(digits, 2) if DIGITS.get(name, 3) else 0}f}"


def disagreements(results: Results) -> list[str] | None:
    """A sentence for each pair of rows whose order differs from the published one; None if nothing can be compared."""
    name = results["columns"][0]
    lower = name in LOWER_IS_BETTER
    compared, found = 0, []
    both = [line for line in lines(results) if name in line.published and line.scores.get(name)]
    for one, other in combinations(both, 2):
        if one.sequence != other.sequence:
            continue
        compared += 1
        ours = mean(one.scores[name]) - mean(other.scores[name])
        theirs = one.published[name] - other.published[name]
        if ours * theirs >= 0:
            continue
        better, worse = (one, other) if (ours > 0) != lower else (other, one)
        spread = sum(stdev(line.scores[name]) ** 2 for line in (one, other) if len(line.scores[name]) > 1) ** 0.5
        values = [_score(name, [mean(line.scores[name])]) for line in (better, worse)]
        in_theirs = [_published(name, line.published[name]) for line in (better, worse)]
        found.append(
            f"{one.sequence}: {better.row} is better than {worse.row} here ({' and '.join(values)}), and worse in "
            f"{results['source']} ({' and '.join(in_theirs)})"
            + (", by less than the seeds differ." if abs(ours) < spread else ".")
        )
    return found if compared else None


def remarks(results: Results) -> Iterator[str]:
    """Sentences about the table: how it was made, what is missing, and which order differs from the published one."""
    runs, name = results["runs"], _title(results["columns"][0]).partition(",")[0]
    seeds = 1 + max((run["seed"] for run in runs), default=0)
    size = "" if results["scale"] is None else f" at scale {results['scale']:g} of 640 x 480"
    budget = results["budget"] if results["budget"].endswith("s") else f"{results['budget']} steps"
    spread = f", mean ± standard deviation of {seeds} seeds" if seeds > 1 else ", one seed"
    for device, threads, version in sorted({(run["device"], run["threads"], run["version"]) for run in runs}):
        where = f"{threads} CPU thread{'s' * (threads > 1)}" if device == "CPU" else device
        yield (
            f"Method {results['method']}, {budget} of training a row{size}{spread}; {where}; version {version}; "
            f"protocol {', '.join(results['protocols'])}."
        )
    if len({run["version"] for run in runs}) > 1:
        yield "Rows come from more than one version of the code."
    seconds = _reference_seconds(results).values()
    if seconds:
        of_processor = any(run["device"] == "CPU" and "processor_seconds" in run for run in runs)
        low, high = (f"{edge(seconds):.0f}" for edge in (min, max))
        span = low if low == high else f"{low} to {high}"
        yield (
            f"Time is that of the training steps{' on the processor' * of_processor}, divided by that of "
            f"{reference_row(results)} on the same sequence with the same seed: {span} s."
        )
    yield from results["notes"]
    if results["reconstruction_weights"] and any(run["row"] == "e2vid" for run in runs):
        yield f"e2vid reconstructs with the weights {results['reconstruction_weights']}."
    for row, why in results["left_out"].items():
        yield f"{row} is left out: {why}."
    for run in runs:
        if "failure" in run:
            yield f"{run['sequence']}, {run['row']}, seed {run['seed']} failed: {run['failure'].rstrip('.')}."
    found = disagreements(results)
    if found == []:
        yield f"By {name}, the rows that are in {results['source']}, too, are in the same order there."
    if found:
        yield f"By {name}, not all rows are in the order of {results['source']}:"
        yield from found


def markdown(results: Results) -> str:
    """The command, the tables and the remarks as Markdown."""
    tables = [scores_table(results, bold=True)]
    if any("parts" in run for run in results["runs"]):
        tables.append(_parts_table(results))
    about = "".join(f"* {remark}\n" for remark in remarks(results))
    return "\n\n".join([f"    {results['command']}", *(table.markdown() for table in tables), about])


def _parts_table(results: Results) -> Table:
    """The numerical errors of the parts of each run, for the first seed of each row and sequence."""
    runs = [run for run in results["runs"] if run["seed"] == 0 and "parts" in run]
    lines: dict[tuple[str, str, str], list[str]] = {}
    for place, run in enumerate(runs):
        for part in run["parts"]:
            kind = part["name"], part["compared"], part["unit"].partition(" at ")[0]
            lines.setdefault(kind, [NONE] * len(runs))[place] = shown(part["error"], part["unit"])
    head = ["part", "compared with", *(f"{run['sequence']}, {run['row']}" for run in runs)]
    rows = [[name, compared, *cells] for (name, compared, _), cells in lines.items()]
    return Table("Numerical error of the parts", head, rows, num_words=2)


def csv_table(results: Results) -> str:
    """All scores as CSV, with one line for each run and protocol."""
    runs = [run for run in results["runs"] if "failure" not in run]
    names = dict.fromkeys(name for run in runs for scores in run["scores"].values() for name in scores)
    table = [["sequence", "row", "seed", "protocol", "steps", "seconds", *names]]
    for run in runs:
        for protocol, scores in run["scores"].items():
            about = [run["sequence"], run["row"], run["seed"], protocol, run["steps"], run["seconds"]]
            table.append([*about, *(scores.get(name, "") for name in names)])
    return csv_text(table)
