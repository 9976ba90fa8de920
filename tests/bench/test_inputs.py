"""What a result depends on, so that a bench runs again what has changed and nothing else."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from enerf_ns.bench import inputs
from enerf_ns.bench.experiments import SEQUENCES
from enerf_ns.bench.inputs import (
    ALL_READERS,
    LEFT_OUT,
    NUMERICAL_ERRORS,
    SIMULATION,
    TRAINED_RUNS,
    TRAINING,
    modules,
    recording_digest,
)
from enerf_ns.simulator.settings import resolve

IN_A_TRAINING = """
import sys
from pathlib import Path
from small_runs import SMALL_BENCH
from enerf_ns.bench.runner import Bench
from enerf_ns.bench.settings import BenchSettings
for _, result in Bench("design", BenchSettings(**SMALL_BENCH, output_dir=Path(sys.argv[1]))).run():
    assert result is None or "failure" not in result, result
print(*(name for name in sys.modules if name.startswith("enerf_ns.")))
"""

OTHER_FORMATS = "enerf_ns.dataparsers.formats."


@pytest.mark.slow
def test_all_that_a_training_imports_counts(tmp_path: Path):
    """The experiment, its runner and its tables are not of the training."""
    path = str(Path(__file__).parents[1])
    ran = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {path!r})\n{IN_A_TRAINING}", str(tmp_path)],
        capture_output=True,
        text=True,
        check=True,
    )
    imported = {name for name in ran.stdout.splitlines()[-1].split() if not name.startswith((*LEFT_OUT, OTHER_FORMATS))}
    assert len(imported) > 100
    not_of_it = {"enerf_ns.bench", "enerf_ns.flags"}
    missing = {name for name in imported - modules(TRAINING) if not name.startswith(tuple(not_of_it))}
    packages = {name for name in missing if any(other.startswith(f"{name}.") for other in imported)}
    assert missing - packages == set()


def test_reports_and_readers_of_other_formats_do_not_count():
    found = modules(TRAINING)
    for name in ("report.page", "method.viewer.scene_view", "dataparsers.formats.eds", "scripts.cli", "bench.runner"):
        assert f"enerf_ns.{name}" not in found
    for name in ("method.model", "supervision.losses", "dataparsers.index.event_index", "kernels.hash_grid_triton"):
        assert f"enerf_ns.{name}" in found


def test_what_a_row_needs_beyond_that_counts_where_it_is_asked_for():
    assert "enerf_ns.dataparsers.formats.davis" in modules([*TRAINING, ALL_READERS])
    assert NUMERICAL_ERRORS in modules([*TRAINING, NUMERICAL_ERRORS]) and NUMERICAL_ERRORS not in modules(TRAINING)


def test_the_layouts_of_all_simulated_recordings_count(tmp_path: Path):
    simulated = [sequence for sequence in SEQUENCES.values() if sequence.scene is not None]
    layouts = {resolve(sequence.simulation_settings(tmp_path)).layout for sequence in simulated}
    assert len(layouts) > 1
    found = modules(SIMULATION, TRAINED_RUNS)
    assert {f"enerf_ns.dataparsers.formats.{layout}" for layout in layouts} <= found
    assert "enerf_ns.simulator.event_sensor" in found and "enerf_ns.supervision.losses" not in found


@pytest.mark.parametrize(
    ("changed", "counts"),
    [
        ('def f(x):\n    """Other words."""\n    # a remark\n    return 2 * x\n', False),
        ("def f(x):\n    return 3 * x\n", True),
        ("import enerf_ns.flags\ndef f(x):\n    return 2 * x\n", True),
    ],
)
def test_words_do_not_count_and_code_does(changed: str, counts: bool, monkeypatch: pytest.MonkeyPatch):
    """One module is exchanged for a text."""
    parsed = inputs._parsed

    def digest(text: str) -> str:
        module = "enerf_ns.sensor.response"
        monkeypatch.setattr(inputs, "_parsed", lambda name: ast.parse(text) if name == module else parsed(name))
        return inputs.code_digest.__wrapped__(*TRAINING)

    assert (digest(changed) != digest('def f(x):\n    """Words."""\n    return 2 * x\n')) == counts


def test_a_recording_is_known_by_its_files(tmp_path: Path):
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "events.txt").write_text("1 2 3 1")
    first = recording_digest(tmp_path)
    assert recording_digest(tmp_path) == first
    (tmp_path / "one" / "events.txt").write_text("1 2 3 0")
    assert recording_digest(tmp_path) != first
    (tmp_path / "one" / "events.txt").write_text("1 2 3 1")
    (tmp_path / "one" / "poses.txt").touch()
    assert recording_digest(tmp_path) != first
