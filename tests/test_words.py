"""Pages, docstrings, printed lines and messages are plain sentences, for readers whose English is a second language."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted(file for folder in ("enerf_ns", "dataparsers") for file in (ROOT / folder).rglob("*.py"))
PAGES = [*sorted((ROOT / "docs").glob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md"]
GENERATED = {"commands.md"}

AVOIDED = {
    r"\btold\b": "identifiable, known, estimated or stated",
    r"\b(is|are|was|were) said\b": "the name of who says it, and the verb",
    r"\bas of `": "what is meant itself, in place of a reference to another docstring",
    r"\bspace sweep\b": "plane sweep",
    r"\b[Ww]hat is None\b": "the default, and who fills it in",
    r"\bof which\.": "a sentence of its own",
}
"""Expressions that readers stumbled over, and what to write in their place."""

FIRST_WORDS = re.compile(r"(What|Of|Whose|Where|Which)\b(?![^.]*\?)")
"""Words that a docstring does not begin with, unless it asks a question: no sentence or name of a thing does."""


def strings(source: str) -> Iterator[tuple[int, str]]:
    """Every string of a module with its line, but for those that are keys or names and hold no space."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield node.lineno, node.value


def docstrings(source: str) -> Iterator[tuple[int, str]]:
    """Those of a module, of its classes and functions, and strings below a value that explain it."""
    for node in ast.walk(ast.parse(source)):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else ():
            if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
                if isinstance(statement.value.value, str):
                    yield statement.lineno, statement.value.value


@pytest.mark.parametrize("avoided", AVOIDED)
def test_expressions_that_readers_stumble_over_are_avoided(avoided: str):
    found = [
        f"{file.relative_to(ROOT)}:{line}"
        for file in SOURCES
        for line, text in strings(file.read_text())
        if re.search(avoided, text)
    ]
    for page in PAGES:
        if page.name not in GENERATED:
            lines = enumerate(page.read_text().splitlines(), 1)
            found += [f"{page.relative_to(ROOT)}:{number}" for number, text in lines if re.search(avoided, text)]
    assert found == [], f"write {AVOIDED[avoided]}"


def test_docstrings_begin_with_a_noun_or_a_verb():
    found = [
        f"{file.relative_to(ROOT)}:{line}"
        for file in SOURCES
        for line, text in docstrings(file.read_text())
        if FIRST_WORDS.match(text)
    ]
    assert found == []
