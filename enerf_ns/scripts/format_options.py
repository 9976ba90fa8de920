"""Flags of the options with which recordings are read, made from all registered formats."""

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
    """Options with which a recording is read. The subclass from `format_flags` has one field for each option."""

    def given(self) -> dict[str, Any]:
        """The options that the user gave, by name, as arguments of `read_recording`."""
        chosen = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in chosen.items() if value is not None}


def format_flags() -> type[FormatFlags]:
    """A dataclass for tyro with the options of all registered formats. Each is None unless the user gives it."""
    types: dict[str, Any] = {}
    helps: dict[str, list[str]] = {}
    for format in formats():
        hints, about = get_type_hints(format.options), _docstrings(format.options)
        for option in fields(format.options):
            types[option.name] = Optional[hints[option.name]] | types.get(option.name)  # noqa: UP045
            text = about.get(option.name, "").replace(" None: ", " Default: ")
            if option.default is not None:
                text = f"{text} Default: {option.default}."
            helps.setdefault(option.name, []).append(f"For a recording of {format.name}: {text}")
    flags = [
        (name, Annotated[types[name], tyro.conf.arg(help=" ".join(sentences))], None)
        for name, sentences in helps.items()
    ]
    return make_dataclass("FormatFlags", flags, bases=(FormatFlags,))


def _docstrings(options: type) -> dict[str, str]:
    """The docstrings of the fields of a class, by field. Empty if the source cannot be read."""
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
    """Refuses options of a recording beside --run, because the run knows how its recording is read.

    Args:
        chosen: Names of the options that the user gave.

    Raises:
        FlagError: The user gave an option.
    """
    for option in chosen:
        raise FlagError(f"--{option.replace('_', '-')} is taken from the run of --run; leave it out.")
