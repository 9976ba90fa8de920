"""The experiments as data: every name is known, and what is published agrees with itself."""

from __future__ import annotations

from pathlib import Path
from statistics import mean

import numpy as np
import pytest

from enerf_ns.bench import published
from enerf_ns.bench.experiments import EXPERIMENTS, FORCED_ON, LEFT_OUT, ROWS, SEQUENCES, Sequence, known_sensor
from enerf_ns.bench.measures import MEASURES
from enerf_ns.bench.published import MEAN
from enerf_ns.bench.tables import LOWER_IS_BETTER
from enerf_ns.bench.validation import CHOSEN_ON, ONLY_SCORED, REAL
from enerf_ns.choices.presets import PRESETS
from enerf_ns.method.runs import method_config
from enerf_ns.simulator import paper_sequences
from enerf_ns.simulator.event_sensor import SensorSettings
from enerf_ns.simulator.scene.scenes import SCENES
from enerf_ns.simulator.settings import SimulationSettings
from enerf_ns.simulator.sources import RenderedScene
from enerf_ns.simulator.view import view_of


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_all_that_an_experiment_names_is_known(name: str):
    experiment = EXPERIMENTS[name]
    assert experiment.sequences or experiment.recorded
    assert set(experiment.rows) <= set(ROWS) and len(set(experiment.rows)) == len(experiment.rows)
    assert {*experiment.sequences, *experiment.recorded} <= set(SEQUENCES)
    assert set(experiment.measures) <= set(MEASURES)
    assert set(experiment.published) <= {*experiment.sequences, *experiment.recorded, MEAN}
    for scores in (scores for rows in experiment.published.values() for scores in rows.values()):
        assert scores and set(scores) <= set(experiment.columns)  # no published score is left out of the table
    assert not experiment.mean or set(experiment.published) <= {MEAN}


def test_every_row_and_sequence_is_of_an_experiment():
    assert {row for experiment in EXPERIMENTS.values() for row in experiment.rows} == set(ROWS)
    used = {name for experiment in EXPERIMENTS.values() for name in (*experiment.sequences, *experiment.recorded)}
    assert used == set(SEQUENCES)


@pytest.mark.parametrize("name", ROWS)
def test_every_setting_of_a_row_is_one_of_the_method(name: str):
    row = ROWS[name]
    method_config(row.method or "enerf", Path("recording"), Path("runs"), {**row.changes, **dict.fromkeys(row.factors)})


@pytest.mark.parametrize("name", SEQUENCES)
def test_every_sequence_can_be_made(name: str):
    sequence: Sequence = SEQUENCES[name]
    known = known_sensor(SensorSettings(**(sequence.sensor or {})))
    method_config("enerf", Path("recording"), Path("runs"), {**sequence.changes, **known})
    assert sequence.preset is None or sequence.preset in PRESETS
    assert sequence.scene is None or sequence.scene in {**paper_sequences.PRESETS, **SCENES, **sequence.files}


def test_six_views_are_of_those_that_the_preset_trains_on_and_span_the_same_time():
    (views,) = SEQUENCES["spiral1-6views"].changes.values()
    train_frames = PRESETS["spiral1"].train_frames
    assert len(set(views)) == 6 and set(views) <= set(train_frames)
    assert (views[0], views[-1]) == (train_frames[0], train_frames[-1])


def test_parts_that_are_left_out_are_forced_on_otherwise():
    for part, off in LEFT_OUT.items():
        assert any(FORCED_ON.get(name) != value for name, value in off.items()), part


@pytest.mark.parametrize("table", [published.EDS, published.TUM_VIE, published.EVENTNERF])
def test_published_means_are_those_of_the_sequences(table: published.Published):
    for row, scores in table[MEAN].items():
        values = [rows[row]["psnr"] for name, rows in table.items() if name != MEAN and row in rows]
        assert not values or mean(values) == pytest.approx(scores["psnr"], abs=0.0051)


def test_the_published_ablation_starts_from_the_published_events():
    five = [*published.SHAKE.values(), published.SPIRAL["spiral1"], published.SPIRAL["spiral2"]]
    for score in ("psnr", "ssim"):  # each value, and their mean, is rounded to two digits
        expected = mean(rows["events"][score] for rows in five)
        assert published.ABLATION[MEAN]["paper-loss"][score] == pytest.approx(expected, abs=0.01)


def test_scores_of_which_less_is_better_are_told_from_the_others():
    columns = {experiment.columns[0] for experiment in EXPERIMENTS.values()}
    assert columns - set(LOWER_IS_BETTER) == {"psnr"}


def test_the_validation_set_has_ten_recordings_of_which_half_are_only_scored():
    experiment = EXPERIMENTS["validation"]
    assert not set(CHOSEN_ON) & set(ONLY_SCORED) and len(CHOSEN_ON) + len(ONLY_SCORED) >= 10
    assert len(ONLY_SCORED) >= len(CHOSEN_ON) and experiment.sequences == (*CHOSEN_ON, *ONLY_SCORED)
    assert experiment.recorded == (REAL,) and experiment.beside
    simulations = [sequence.simulation for sequence in (*CHOSEN_ON.values(), *ONLY_SCORED.values())]
    sizes = {(simulation["width"], simulation["height"]) for simulation in simulations}
    assert {(160, 120), (346, 260), (640, 480)} <= sizes
    assert any("bayer_pattern" in simulation for simulation in simulations)
    for half in (CHOSEN_ON, ONLY_SCORED):
        sensors = [sequence.sensor for sequence in half.values()]
        assert None in sensors and any(sensors), "both halves have ideal sensors and others"


@pytest.mark.parametrize("name", [*CHOSEN_ON, *ONLY_SCORED])
def test_every_recording_of_the_validation_set_shows_its_scene_all_along(name: str, tmp_path: Path):
    """Rendered at the start, in the middle and at the end of its path, small; what is before nothing is in view."""
    sequence = {**CHOSEN_ON, **ONLY_SCORED}[name]
    for file, content in sequence.files.items():
        (tmp_path / file).write_text(content)
    given = {
        **sequence.simulation,
        "width": 40,
        "height": 30,
        "key_frames": tmp_path / sequence.simulation["key_frames"],
    }
    settings = SimulationSettings(str(tmp_path / str(sequence.scene)), layout="event_recording", **given)
    scene = view_of(settings, []).events
    assert isinstance(scene, RenderedScene)
    for time in np.linspace(scene.start, scene.end, 3).astype(int).tolist():
        depth = scene.depth(time)
        assert (depth > 0).mean() > (0.1 if name == "statue" else 0.95)
        assert scene.brightness(time).std() > 0.03
