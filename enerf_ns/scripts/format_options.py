"""Flags for what may be chosen of a recording, made from the options of all registered formats."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Iterable
from dataclasses import dataclass, fields, make_dataclass
from itertools import pairwise
from typing import Annotated, Any, Optional, get_type_hints

import tyro

from enerf_ns.dataparsers.formats.registry import formats
from enerf_ns.dataparsers.recording.errors import FlagError


@dataclass
class FormatFlags:
    """What was chosen of a recording; its subclass from `format_flags` has a field for each option of a format."""

    def given(self) -> dict[str, Any]:
        """The options that are set, by name, as `read_recording` takes them."""
        chosen = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in chosen.items() if value is not None}


def format_flags() -> type[FormatFlags]:
    """A dataclass for tyro with the options of all formats that are registered by now, each None unless given."""
    types: dict[str, Any] = {}
    helps: dict[str, list[str]] = {}
    for format in formats():
        hints, about = get_type_hints(format.options), _docstrings(format.options)
        for option in fields(format.options):
            types[option.name] = Optional[hints[option.name]] | types.get(option.name)  # noqa: UP045
            sentence = f"For a recording of {format.name}: {about.get(option.name, '')} None: {option.default}."
            helps.setdefault(option.name, []).append(sentence)
    flags = [
        (name, Annotated[types[name], tyro.conf.arg(help=" ".join(sentences))], None)
        for name, sentences in helps.items()
    ]
    return make_dataclass("FormatFlags", flags, bases=(FormatFlags,))


def _docstrings(options: type) -> dict[str, str]:
    """The strings below the fields of a class, by field; none where its source is not at hand."""
    try:
        source = textwrap.dedent(inspect.getsource(options))
    except OSError:
        return {}
    (definition,) = ast.parse(source).body
    assert isinstance(definition, ast.ClassDef)
    return {
        field.target.id: " ".join(str(text.value.value).split())
        for field, text in pairwise(definition.body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
    }


def refuse_beside_run(chosen: Iterable[str]) -> None:
    """Says that a run knows how its recording is read.

    Args:
        chosen: Names of the options that were given.

    Raises:
        FlagError: There are some.
    """
    for option in chosen:
        raise FlagError(f"--{option.replace('_', '-')} is taken from the run of --run; leave it out.")
