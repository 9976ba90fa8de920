"""The help of the methods on the command line, and what it says of a flag that does not exist."""

from __future__ import annotations

import re
from dataclasses import fields
from typing import Any

import pytest
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from tyro._backends import _tyro_help_formatting as tyros

from enerf_ns.flags import RECORDING, USED_MOST, nearest
from enerf_ns.sensor.sensor_model import SensorModelConfig

FLAG = re.compile(r"--[a-z][\w.-]*")


def told(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[object, str, str]:
    """The exit code of `ns-train` with some arguments, and what it prints to both of its outputs."""
    with pytest.raises(SystemExit) as end:
        tyro.cli(AnnotatedBaseConfigUnion, prog="/some where/ns-train", args=arguments)
    printed = capsys.readouterr()
    return end.value.code, printed.out, printed.err


def flags_by_title(shown: str) -> dict[str, list[str]]:
    """The flags that begin a line of the help, below their titles."""
    found: dict[str, list[str]] = {}
    title = ""
    for line in shown.splitlines():
        if line and not line.startswith(" "):
            title = line
        elif match := re.match(rf"  ((?:{RECORDING} )?--\S+)", line):
            found.setdefault(title, []).append(match[1])
    return found


@pytest.mark.parametrize("method", ["enerf", "enerf-paper"])
def test_no_flag_of_tyros_own_help_is_lost(
    method: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("COLUMNS", "200")
    ours = flags_by_title(told(capsys, method, "--help")[1])
    own = [flag for flags in ours.values() for flag in flags]
    assert len(set(own)) == len(own)
    of_recording = {flag.removeprefix(f"{RECORDING} ") for flag in own if " " in flag}
    monkeypatch.setattr(tyros, "format_help", tyros.format_help.__wrapped__)  # type: ignore[attr-defined]

    def before(*arguments: str) -> set[str]:
        found = re.findall(r"^[^\w-]*(?:-h, )?(--[a-z]\S*)", told(capsys, *arguments, "--help")[1], re.MULTILINE)
        return set(found) - {"--help"}

    whole = before(method)
    assert len(whole) > 150 and {flag for flag in own if " " not in flag} == whole
    assert of_recording == before(method, RECORDING)


@pytest.mark.parametrize("columns", [80, 120])
def test_what_people_use_stands_first_and_nerfstudios_last(
    columns: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("COLUMNS", str(columns))
    code, shown, errors = told(capsys, "enerf", "--help")
    assert (code, errors) == (0, "")
    groups = flags_by_title(shown)
    assert shown.startswith("usage: ns-train enerf --data FOLDER") and next(iter(groups)) == "Used most"
    assert groups["Used most"] == list(USED_MOST) and len(USED_MOST) == 10
    own = ["nerfstudio" not in title.lower() for title in groups]
    assert own == sorted(own, reverse=True) and True in own and False in own
    sensor = {f"--pipeline.model.{field.name.replace('_', '-')}" for field in fields(SensorModelConfig)}
    hidden = {f"--pipeline.model.{name}" for name in ("-target", "width", "height")}
    assert {*groups["Sensor"], "--pipeline.model.contrast-thresholds"} == sensor - hidden
    too_long = [line for line in shown.splitlines() if len(line) > columns]
    assert all(re.match(r"  (event-data )?--|usage", line) for line in too_long), "only what is copied whole"
    for line in shown.splitlines():
        assert not re.search(r"--[\w.-]*-$", line), "a flag is broken"
    assert "Default: 1024; with pairs" in " ".join(shown.split()) and "number of the paper. (default" not in shown


def test_help_and_errors_of_other_methods_are_those_of_tyro(capsys: pytest.CaptureFixture[str]):
    assert "[NERFACTO OPTIONS]" in told(capsys, "nerfacto", "--help")[1]
    code, _, errors = told(capsys, "nerfacto", "--max-num-iteration", "5")
    assert code == 2 and "Perhaps you meant" in errors and "--max-num-iterations" in errors


def test_a_tyro_that_is_built_otherwise_speaks_for_itself(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    """Help and errors must not depend on places in tyro that are not public."""

    def moved(*_: Any) -> None:
        raise AttributeError

    monkeypatch.setattr("enerf_ns.flags._entry", moved)
    monkeypatch.setattr("enerf_ns.flags._sub_commands", moved)
    assert "[ENERF OPTIONS]" in told(capsys, "enerf", "--help")[1]
    assert "Perhaps you meant" in told(capsys, "enerf", "--max-num-iteration", "5")[2]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--max-num-iteration", "5"], "There is no flag --max-num-iteration; the nearest is --max-num-iterations."),
        (["--max_num_iteration=5"], "There is no flag --max_num_iteration; the nearest is --max-num-iterations."),
        (
            ["--contrast-thresholds", "0.2", "0.2"],
            "the nearest is --pipeline.model.contrast-thresholds. ns-train enerf",
        ),
        (["--depth_range", "1", "2"], "give it at the end of the command, as event-data --depth_range 1 2."),
        (["--depth-rang", "1", "2"], "There is no flag --depth-rang; the nearest is event-data --depth-range."),
        (["event-data", "--depth-rang", "1"], "There is no flag --depth-rang; the nearest is --depth-range."),
        (["event-data", "--vis", "viewer"], "--vis is no flag of the recording; give it before the word event-data."),
        (["event-dat"], "There is no format event-dat; the nearest is event-data."),
        (["more"], "more is neither a flag nor the value of one; ns-train enerf --help lists all flags."),
        (["--qqq"], "There is no flag --qqq; ns-train enerf --help lists all."),
    ],
)
def test_a_flag_that_does_not_exist_is_told_in_a_sentence(
    arguments: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
):
    code, shown, errors = told(capsys, "enerf", "--data", "x", *arguments)
    assert (code, shown, errors.count("\n")) == (2, "", 1)
    assert errors.startswith("enerf: ") and sentence in errors


def test_a_method_that_does_not_exist_is_told_in_a_sentence(capsys: pytest.CaptureFixture[str]):
    assert told(capsys, "enrf", "--data", "x")[2] == "enerf: There is no method enrf; the nearest is enerf.\n"


@pytest.mark.parametrize(
    ("flag", "found"),
    [("--lr", "--a.lr"), ("--b.lr", "--b.lr"), ("--b.lx", "--b.lr"), ("--ratte", "--rate"), ("--xyz", None)],
)
def test_the_nearest_flag(flag: str, found: str | None):
    assert nearest(flag, ["--b.lr", "--a.lr", "--rate"]) == found
