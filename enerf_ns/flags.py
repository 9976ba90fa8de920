"""Flags on the command line: their help in groups, and a sentence about a flag that does not exist.

`ns-train` belongs to Nerfstudio, and tyro prints its help and its errors. `speak_for_methods` replaces both for the
methods of this package, and leaves them as they are for all others and for a tyro that has them elsewhere. The help of
`enerf` is tyro's own, with `shorten_help`.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from difflib import get_close_matches
from functools import cache, wraps
from itertools import takewhile
from pathlib import Path
from typing import Any, NoReturn

RECORDING = "event-data"
"""Sub-command of `ns-train enerf` that the flags of the recording follow."""

USED_MOST = (
    "--data",
    "--max-num-iterations",
    "--output-dir",
    "--pipeline.datamanager.supervision",
    "--pipeline.model.contrast-thresholds",
    f"{RECORDING} --depth-range",
    f"{RECORDING} --time-range",
    "--vis",
    "--machine.seed",
    "--load-config",
)

SENSOR = r"(learn-(?!exposure)|.*(threshold|leak|cutoff|delay|response|refractory|bayer))"
GROUPS = {
    "Used most": "",
    f"Recording: these flags stand last, behind the word {RECORDING}": rf"{RECORDING} ",
    "Events and frames of a step": r"--pipeline\.datamanager\.",
    "Sensor": rf"--pipeline\.model\.{SENSOR}",
    "Losses": r"--pipeline\.model\..*-(loss|margin)",
    "Scene and field": r"--pipeline\.model\.",
    "Clock, poses and lens": r"--pipeline\.",
    "Run": r"--(preset|evaluation-share|verbose)",
    "Nerfstudio: names, checkpoints and devices": r"--([a-z]+-name|timestamp|load-|save-|steps-per-save|machine)",
    "Nerfstudio: viewer and logs": r"--(viewer|logging|vis)",
    "Nerfstudio: other flags": r"--(?!optimizers)",
    "Nerfstudio: learning rates": "",
}
"""Titles, and the beginnings of the flags below each. A flag stands below the first title that fits it."""

MOST_COLUMNS = 120


def nearest(flag: str, known: Iterable[str]) -> str | None:
    """The flag that is spelt most like another; also one whose last part is, as --lr and --optimizers.fields.lr are."""
    flags = sorted(known, key=lambda name: (name.count("."), name))
    last = {_last_part(name): name for name in reversed(flags)}
    end = _last_part(flag)
    alike = close(flag, flags, 0.8)
    if end in last and not (alike and "." in flag):
        return last[end]
    if alike:
        return alike
    found = close(end, last, 0.7)
    return last[found] if found else None


def _last_part(flag: str) -> str:
    return re.split(r"\.| ", flag)[-1].strip("-")


def close(word: str, words: Iterable[str], likeness: float = 0.6) -> str | None:
    """The word of some that is most like another, from a likeness of 0 to 1; None if none is so like it."""
    return next(iter(get_close_matches(word, words, 1, likeness)), None)


def about_unknown(word: str, known: Iterable[str], program: str) -> str:
    """A sentence about a word that is neither a flag nor the value of one, with the nearest flag.

    Args:
        word: As the user gave it.
        known: All flags of the program.
        program: The words of the command before the flags.
    """
    help_of = f"{program} --help lists all"
    if not word.startswith("-"):
        return f"enerf: {word} is neither a flag nor the value of one; {help_of} flags."
    near = nearest(spelt(word), known)
    return f"enerf: There is no flag {word.partition('=')[0]}; " + (
        f"the nearest is {near}. {help_of}." if near else f"{help_of}."
    )


def spelt(flag: str) -> str:
    """A flag as the help spells it: with hyphens for underscores, and without the value after `=`."""
    return flag.partition("=")[0].replace("_", "-")


def speak_for_methods(config: type, names: Sequence[str]) -> None:
    """Replaces the help that tyro prints for a class of configs, and its error about a flag that does not exist.

    Args:
        config: Class of the configs of the methods.
        names: Names of the methods.
    """
    try:
        from tyro._backends import _tyro_help_formatting as tyros

        show, refuse = tyros.format_help, tyros.unrecognized_args_error
    except (ImportError, AttributeError):
        return

    @wraps(show)
    def help_lines(*args: Any, **options: Any) -> list[str]:
        return _tried(lambda: _help(config, **options)) or show(*args, **options)

    @wraps(refuse)
    def refused(*args: Any, **options: Any) -> NoReturn:
        if sentence := _tried(lambda: _unknown(config, names, **options)):
            print(sentence, file=sys.stderr)
            raise SystemExit(2)
        refuse(*args, **options)

    tyros.format_help, tyros.unrecognized_args_error = help_lines, refused


@cache
def shorten_help() -> None:
    """Makes tyro join the lines of the docstring of a flag, and leave out a default that is None or empty.

    tyro 1.0.17 joins lines that begin with a letter, before it takes away the indent of the lines after the first. The
    docstring says what such a default means.
    """
    try:
        from tyro import _arguments, _docstrings

        read, describe = _docstrings.parse_docstring_from_object, _arguments.generate_argument_helptext
    except (ImportError, AttributeError):
        return

    @wraps(read)
    def joined(of: object) -> dict[str, str]:
        return {name: " ".join(text.split()) for name, text in read(of).items()}

    @wraps(describe)
    def described(argument: Any, *args: Any, **options: Any) -> Any:
        text = describe(argument, *args, **options)
        return _tried(lambda: _without_default(describe, text, argument, *args, **options)) or text

    _docstrings.parse_docstring_from_object = joined
    _arguments.generate_argument_helptext = described


def _without_default(describe: Callable[..., Any], text: Any, argument: Any, *args: Any, **options: Any) -> Any:
    """The text about a flag without its default, where that is None or empty; else None."""
    if text.as_str_no_ansi().endswith(("(default: None)", "(default: )")):
        silent = replace(argument.field.argconf, help_behavior_hint="")
        return describe(replace(argument, field=replace(argument.field, argconf=silent)), *args, **options)
    return None


def _tried(make: Callable[[], Any]) -> Any:
    """The result of a function; None if a version of tyro is built in another way than it expects."""
    try:
        return make()
    except (ImportError, AttributeError, KeyError, TypeError, ValueError, StopIteration):
        return None


def _flags(spec: Any) -> set[str]:
    """The flags of a parser of tyro, without those of its sub-commands."""
    arguments = [found.arg for found in spec.get_args_including_children()]
    return {flag for argument in arguments if not argument.is_suppressed() for flag in argument.lowered.name_or_flags}


def _sub_commands(spec: Any) -> dict[str, Any]:
    return next(iter(spec.subparsers_from_intern_prefix.values())).parser_from_name


def _unknown(
    config: type, names: Sequence[str], unrecognized_args_and_progs: list[tuple[str, str]], parser_spec: Any, **_: Any
) -> str | None:
    """The sentence about the first flag that `ns-train` does not know; None if no method of this package is meant."""
    given = unrecognized_args_and_progs
    place = next((i for i, (word, _) in enumerate(given) if word.startswith("--")), 0)
    word, (tool, *words) = given[place][0], Path(given[place][1]).name.split()
    if not words:
        method = given[0][0]
        near = close(method, names)
        return f"enerf: There is no method {method}; the nearest is {near}." if near else None
    method = _sub_commands(parser_spec)[words[0]].evaluate()
    if method.f is not config:
        return None
    formats = _sub_commands(method)
    format = words[1] if len(words) > 1 else RECORDING
    here, of_recording = _flags(method), _flags(formats[format].evaluate())
    there = {f"{RECORDING} {flag}" for flag in of_recording}
    if len(words) > 1:
        here, there = of_recording, here
        if spelt(word) in there:
            return f"enerf: {word} is no flag of the recording; give it before the word {format}."
    elif f"{RECORDING} {spelt(word)}" in there:
        values = takewhile(lambda value: not value.startswith("--"), (value for value, _ in given[place + 1 :]))
        whole = " ".join([RECORDING, word, *values])
        return f"enerf: {word} is a flag of the recording; give it at the end of the command, as {whole}."
    elif not word.startswith("-") and (near := close(word, formats)):
        return f"enerf: There is no format {word}; the nearest is {near}."
    return about_unknown(word, here | there, f"{tool} {words[0]}")


def _help(
    config: type, prog: str, parser_spec: Any, args: list[Any], subparser_frontier: dict[str, Any], **_: Any
) -> list[str] | None:
    """The lines of the help of a method; None for a parser of another class."""
    if parser_spec.f is not config:
        return None
    sub_commands = next(iter(subparser_frontier.values())).parser_from_name
    arguments = {"": [found.arg for found in args]}
    recording = sub_commands[RECORDING].evaluate()
    arguments[f"{RECORDING} "] = [found.arg for found in recording.get_args_including_children()]
    entries = {
        prefix + argument.lowered.name_or_flags[0]: argument
        for prefix, found in arguments.items()
        for argument in found
        if not argument.is_suppressed()
    }
    formats = {name: parser.description.strip() for name, parser in sub_commands.items() if name != RECORDING}
    lines = [
        f"usage: {Path(prog).name} --data FOLDER [FLAGS] [{RECORDING} [FLAGS OF THE RECORDING]]",
        "",
        *_filled(parser_spec.description, ""),
        *_filled("What you leave out is decided from the recording, and training prints what it chose.", ""),
    ]
    for title, flags in _groups(entries).items():
        lines += ["", _bold(title)]
        told: set[str] = set()
        for flag in flags:
            lines += _entry(flag, entries[flag], told)
        if flags[0].startswith(RECORDING):
            lines += ["", _bold(f"Formats: words in place of {RECORDING}, for a folder that is not recognised")]
            lines += [line for name, text in sorted(formats.items()) for line in _beside(name, name, text)]
    return lines


def _groups(flags: Iterable[str]) -> dict[str, list[str]]:
    """The flags below their titles."""
    groups: dict[str, list[str]] = {title: [] for title in GROUPS}
    first, *_, last = groups
    for flag in flags:
        fits = (title for title, begin in GROUPS.items() if begin and re.match(begin, flag))
        groups[first if flag in USED_MOST else next(fits, last)].append(flag)
    groups[first].sort(key=USED_MOST.index)
    return {title: found for title, found in groups.items() if found}


def _entry(flag: str, argument: Any, told: set[str]) -> Iterator[str]:
    """The lines of a flag. A text that stands below another flag of its group is not repeated."""
    from tyro._arguments import generate_argument_helptext

    text = " ".join(generate_argument_helptext(argument, argument.lowered).as_str_no_ansi().split())
    what, mark, default = text.rpartition("(default: ")
    if mark and "Default:" in what:
        text, default = what.rstrip(), ""
    if what in told:
        text = mark * bool(default) + default
    told.add(what)
    values = re.sub(r"^\{None\}\|(?:\{(.*)\}$)?", r"\1", argument.lowered.metavar or "").replace("{None,", "{")
    return _beside(f"{_bold(flag)} {values}", f"{flag} {values}", text)


def _beside(name: str, plain: str, text: str) -> Iterator[str]:
    """A name and a text beside it, or below it if both do not fit on a line."""
    if len(f"  {plain}  {text}") <= _columns():
        yield f"  {name}  {text}"
    else:
        yield f"  {name}"
        yield from _filled(text, 6 * " ")


def _filled(text: str, indent: str) -> list[str]:
    """A text in lines of the width of the terminal. No word is broken, so that flags can be copied."""
    return textwrap.wrap(
        " ".join(text.split()),
        _columns(),
        initial_indent=indent,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )


def _columns() -> int:
    return min(shutil.get_terminal_size().columns, MOST_COLUMNS)


def _bold(text: str) -> str:
    return f"\x1b[1m{text}\x1b[0m" if sys.stdout.isatty() and "NO_COLOR" not in os.environ else text
