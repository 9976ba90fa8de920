"""The verdict on scores that runs had, and its words."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from enerf_ns.evaluation.verdict import verdict_on_events

PATH = Path("a folder")
CAUSE = "the poses are inverse; invert them"


@pytest.mark.parametrize(
    ("correlation", "sign", "steps", "cause", "explained"),
    [
        pytest.param(0.93, 0.97, 600, "", "yes", id="right poses"),
        pytest.param(0.50, 0.95, 1000, "", "yes", id="steep edges"),
        pytest.param(0.54, 0.93, 1000, "", "yes", id="a noisy sensor"),
        pytest.param(0.87, 0.93, 131, "", "yes", id="a short run may be good"),
        pytest.param(0.93, 0.97, 600, CAUSE, "yes", id="a cause that did no harm"),
        pytest.param(0.10, 0.54, 60, "", "unknown", id="right poses, 60 steps"),
        pytest.param(0.04, 0.59, 60, CAUSE, "no", id="inverse poses, 60 steps"),
        pytest.param(0.06, 0.59, 350, CAUSE, "no", id="inverse poses"),
        pytest.param(0.14, 0.51, 350, "", "no", id="quaternions w x y z"),
        pytest.param(-0.04, 0.45, 350, "", "no", id="a negative"),
        pytest.param(0.41, 0.70, 1000, "", "partly", id="a clock 5 ms late"),
        pytest.param(0.41, 0.70, 60, CAUSE, "partly", id="in part, with a cause"),
    ],
)
def test_the_verdict_on_known_runs(correlation: float, sign: float, steps: int, cause: str, explained: str):
    found = verdict_on_events({"event_correlation": correlation, "event_sign": sign}, 2000, steps, cause, PATH)
    assert found.explained == explained and found.sentence.lower().startswith(found.short)
    assert f"{correlation:.2f}" in found.sentence and "\n" not in found.sentence
    advised = explained in ("no", "partly")
    assert (CAUSE in found.sentence) == (advised and bool(cause))
    order = [
        "enerf inspect 'a folder'",
        "--depth-range",
        "--max-num-iterations",
        "--pipeline.model.contrast-thresholds",
    ]
    places = [found.sentence.find(word) for word in order]
    assert (places == sorted(places) and -1 not in places) == (advised and not cause)


@pytest.mark.parametrize(
    ("scores", "pairs", "why"),
    [
        ({"event_correlation": "the rendered values are all equal"}, 2000, "the rendered values are all equal"),
        ({"event_correlation": 0.1, "event_sign": 0.5}, 12, "only 12 pairs .*--pipeline.datamanager.held-out-events"),
        ({}, 2000, "no events were scored"),
    ],
)
def test_what_scores_do_not_tell_is_unknown(scores: dict[str, float | str], pairs: int, why: str):
    found = verdict_on_events(scores, pairs, 1000, CAUSE, PATH)
    assert found.explained == "unknown" and found.sentence.startswith("It is not known whether the events are")
    assert re.search(why, found.sentence)


def test_a_sign_that_is_missing_does_not_count():
    found = verdict_on_events({"event_correlation": 0.1, "event_sign": "no pair"}, 2000, 1000, "", PATH)
    assert found.explained == "no" and "sign" not in found.sentence and shlex.quote("a folder") in found.sentence


@pytest.mark.parametrize(("correlation", "sign", "explained"), [(0.79, 0.9, "partly"), (0.1, 0.5, "no")])
def test_poses_that_do_not_fit_although_they_were_corrected_explain_in_part_at_best(
    correlation: float, sign: float, explained: str
):
    scores = {"event_correlation": correlation, "event_sign": sign}
    found = verdict_on_events(scores, 2000, 3000, CAUSE, PATH, in_spite_of_corrections=True)
    assert found.explained == explained and f"{correlation:.2f}" in found.sentence
    assert found.sentence.endswith(f"The corrections of clock, poses and lens do not suffice: {CAUSE}.")
