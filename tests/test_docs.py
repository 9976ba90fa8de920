"""The pages beside the README: links lead somewhere, and the site is built without a warning."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WRITTEN_BY_SPHINX = ROOT / "docs" / "commands.md"
DOCS = sorted({*(ROOT / "docs").glob("*.md")} - {WRITTEN_BY_SPHINX})
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "benchmarks" / "README.md", *DOCS]


def anchors(page: Path) -> set[str]:
    """The anchors of the headings of a page, as GitHub and MyST make them."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path):
    links = re.findall(r"\]\((?!https?:)([^)\s]+)\)", page.read_text())
    for link in links:
        file, _, anchor = link.partition("#")
        target = (page.parent / file).resolve() if file else page
        assert target.is_file(), f"{page.name}: {link}"
        assert not anchor or anchor in anchors(target), f"{page.name}: {link}"
        is_on_the_site = target.suffix != ".md" or target.parent == ROOT / "docs"
        assert is_on_the_site or page.parent != ROOT / "docs", f"{page.name}: {link} is a page outside the site"


def test_every_page_is_in_the_side_bar_and_the_readme_is_short():
    index = (ROOT / "docs" / "index.md").read_text()
    listed = [
        name
        for tree in re.findall(r"```{toctree}\n(.*?)```", index, re.DOTALL)
        for name in re.findall(r"^[\w-]+$", tree, re.M)
    ]
    assert sorted(listed) == sorted({page.stem for page in [*DOCS, WRITTEN_BY_SPHINX]} - {"index"})
    assert len((ROOT / "README.md").read_text().splitlines()) <= 200


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_paths_that_are_named_exist(page: Path):
    named = re.findall(r"`((?:enerf_ns|dataparsers|tests|benchmarks|docs)/[\w/.-]+)`", page.read_text())
    assert [path for path in named if not (ROOT / path).exists()] == []


@pytest.mark.slow
@pytest.mark.skipif(sys.version_info < (3, 11), reason="the generator of the site wants Python 3.11")
def test_the_site_is_built_without_a_warning(tmp_path: Path):
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", ROOT / "docs", tmp_path / "site"]
    built = subprocess.run(command, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    assert {page.stem for page in [*DOCS, WRITTEN_BY_SPHINX]} <= {
        file.stem for file in (tmp_path / "site").glob("*.html")
    }
    found = json.loads(
        (tmp_path / "site" / "searchindex.js").read_text().removeprefix("Search.setIndex(").rstrip(");\n")
    )
    for stem, page in {"refractori": "sensor", "quaternion": "errors", "checkpoint": "continuing"}.items():
        kept = [found[kind].get(stem, []) for kind in ("terms", "titleterms")]
        numbers = [number for each in kept for number in ([each] if isinstance(each, int) else each)]
        assert page in {found["docnames"][number] for number in numbers}, f"the search for {stem} misses {page}"
    outside = re.findall(
        r"<(?:script|link)[^>]*(?:src|href)=\"(?:https?:)?//[^\"]+\"", (tmp_path / "site" / "search.html").read_text()
    )
    assert outside == [], "the search works without a network"
