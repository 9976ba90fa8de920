from __future__ import annotations

from typing import Annotated, Any

import pytest
import tyro

from enerf_ns.scripts.format_options import format_flags


def parsed(*arguments: str) -> dict[str, Any]:
    flags: Any = Annotated[format_flags(), tyro.conf.arg(name="")]
    return tyro.cli(flags, args=arguments).given()


def test_what_is_not_given_is_left_to_the_format():
    assert parsed() == {}
    assert parsed("--event-camera", "right") == {"event_camera": "right"}


def test_a_value_that_there_is_not_is_refused():
    with pytest.raises(SystemExit):
        parsed("--event-camera", "middle")


def test_the_help_says_for_which_format_an_option_is(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        parsed("--help")
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "For a recording of tum_vie: The event camera that is read" in shown and "Default: left." in shown
    assert "seconds. Default: 1 ms from view to view" in shown
