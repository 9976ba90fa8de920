"""The tables of the README and of the pages equal those that `enerf bench` makes from the committed result files."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from results import PAGES, written

from enerf_ns.bench.experiments import EXPERIMENTS
from enerf_ns.bench.published import MEAN
from enerf_ns.bench.tables import markdown

ROOT = Path(__file__).parents[1]
TABLE = re.compile(r"<!-- enerf bench (\S+): (\S+) -->\n(.*?)<!-- end of (\S+) -->", re.DOTALL)


def tables(readme: str) -> list[tuple[str, str, str]]:
    """The experiment, the result file and the text of each table between its marks.

    Raises:
        AssertionError: A mark has no end, or the end of another mark.
    """
    found = TABLE.findall(readme)
    assert len(found) == readme.count("<!-- enerf bench ") == readme.count("<!-- end of ")
    assert all(name == end for name, _, _, end in found)
    return [(name, file, text) for name, file, text, _ in found]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_tables_of_scores_are_those_of_their_result_files(page: Path):
    text = page.read_text()
    assert text == written(text), "run `python benchmarks/results.py --only --pages`"
    for name, file, table in tables(text):
        results = json.loads((ROOT / file).read_text())
        assert results["experiment"] == name
        assert table.strip("\n") == markdown(results).strip("\n")


def test_the_summary_has_three_scores_of_three_rows_on_three_sequences():
    for page in (ROOT / "README.md", ROOT / "docs" / "results.md"):
        (summary,) = re.findall(r"<!-- scores of .+? -->\n(.*?)<!-- scores end -->", page.read_text(), re.DOTALL)[:1]
        assert summary.count(" ± ") == 27


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_scores_outside_of_the_tables_are_in_the_notes_of_the_benchmarks_alone(page: Path):
    """A score that is written by hand would not change with the version. The notes state the version of each."""
    if page.name == "commands.md" or page.parent.name == "benchmarks":
        return
    made = r"<!-- (enerf bench|scores of|pose refinement).*?<!-- (end of \S+|scores end|pose refinement ends) -->"
    by_hand = re.sub(made, "", page.read_text(), flags=re.DOTALL)
    assert re.findall(r".*\d dB.*|.*\d\d\.\d\d ± \d.*|.*[vV]ersion [0-9a-f]{7}.*", by_hand) == []


def test_every_result_file_is_shown_and_from_one_version_of_the_code():
    shown = [file for page in PAGES for _, file, _ in tables(page.read_text())]
    committed = sorted((ROOT / "benchmarks" / "results").glob("*.json"))
    gates = {"benchmarks/validation.json", "benchmarks/refractory.json"}  # of the versions that changed a default
    assert {str(file.relative_to(ROOT)) for file in committed} | gates == set(shown)
    versions = {run["version"] for file in committed for run in json.loads(file.read_text())["runs"]}
    assert len(versions) <= 1 and not any("dirty" in version for version in versions)


@pytest.mark.parametrize("file", sorted((ROOT / "benchmarks" / "results").glob("*.json")), ids=lambda file: file.stem)
def test_a_result_file_says_of_its_experiment_what_the_experiment_says(file: Path):
    results, experiment = json.loads(file.read_text()), EXPERIMENTS[file.stem]
    assert results["published"] == {
        sequence: rows
        for sequence, rows in experiment.published.items()
        if sequence in {run["sequence"] for run in results["runs"]} | {MEAN}
    }
    assert (results["notes"], results["columns"]) == (list(experiment.notes), list(experiment.columns))
    assert (results["sentence"], results["source"]) == (experiment.sentence, experiment.source)


def test_marks_are_found_and_those_without_an_end_are_not_passed_over():
    one, other = (f"<!-- enerf bench {name}: {name}.json -->\n| {name} |\n<!-- end of {name} -->\n" for name in "ab")
    assert tables(f"before\n{one}between\n{other}after") == [("a", "a.json", "| a |\n"), ("b", "b.json", "| b |\n")]
    for broken in (one.replace("<!-- end of a -->", ""), one.replace("end of a", "end of b"), "<!-- end of a -->"):
        with pytest.raises(AssertionError):
            tables(broken + other)
