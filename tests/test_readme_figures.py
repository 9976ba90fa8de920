"""The tables of the README and of the pages equal those that `enerf bench` makes from the committed result files."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from results import summary

from enerf_ns.bench.tables import markdown

ROOT = Path(__file__).parents[1]
READMES = [ROOT / "README.md", ROOT / "benchmarks" / "README.md", ROOT / "docs" / "results.md"]
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


@pytest.mark.parametrize("readme", READMES, ids=lambda readme: str(readme.relative_to(ROOT)))
def test_every_table_of_a_readme_is_that_of_its_result_file(readme: Path):
    for name, file, text in tables(readme.read_text()):
        results = json.loads((ROOT / file).read_text())
        assert results["experiment"] == name
        assert text.strip("\n") == markdown(results).strip("\n"), f"{readme.name} is not what {file} says"


def test_the_summary_is_that_of_the_result_files():
    for page in (ROOT / "README.md", ROOT / "docs" / "results.md"):
        (found,) = re.findall(r"<!-- summary -->\n(.*?)<!-- summary ends -->", page.read_text(), re.DOTALL)
        assert found.strip() == summary()
    assert summary().count(" ± ") == 27  # three scores of three rows on three sequences


def test_every_result_file_is_shown_and_from_one_version_of_the_code():
    shown = [file for readme in READMES for _, file, _ in tables(readme.read_text())]
    committed = sorted((ROOT / "benchmarks" / "results").glob("*.json"))
    gate = "benchmarks/validation.json"  # of the version that last changed a default, whenever the others were made
    assert {str(file.relative_to(ROOT)) for file in committed} | {gate} == set(shown)
    versions = {run["version"] for file in committed for run in json.loads(file.read_text())["runs"]}
    assert len(versions) <= 1 and not any("dirty" in version for version in versions)


def test_marks_are_found_and_those_without_an_end_are_not_passed_over():
    one, other = (f"<!-- enerf bench {name}: {name}.json -->\n| {name} |\n<!-- end of {name} -->\n" for name in "ab")
    assert tables(f"before\n{one}between\n{other}after") == [("a", "a.json", "| a |\n"), ("b", "b.json", "| b |\n")]
    for broken in (one.replace("<!-- end of a -->", ""), one.replace("end of a", "end of b"), "<!-- end of a -->"):
        with pytest.raises(AssertionError):
            tables(broken + other)
