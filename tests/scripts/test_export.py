"""`enerf export`: files in metres that trimesh reads, scores beside, and mistakes as sentences."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from small_runs import SMALL

from enerf_ns.dataparsers.errors import FlagError, OutputError, RecordingError
from enerf_ns.evaluation.runs import method_config, train
from enerf_ns.export import surface
from enerf_ns.scripts.export import Export


@pytest.fixture(scope="module")
def run(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run of two steps."""
    return train(method_config("enerf", recording, tmp_path_factory.mktemp("runs"), SMALL)).config_file.parent


@pytest.mark.parametrize(("what", "suffix"), [("mesh", "ply"), ("mesh", "glb"), ("pointcloud", "ply")])
def test_what_is_written_is_read_by_trimesh_and_scored(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: Any, suffix: str
):
    """Though nothing is known after two steps."""
    monkeypatch.setattr(surface, "SURE", 0.0)
    output = tmp_path / "new" / f"scene.{suffix}"
    Export(what, run, output, voxel=0.1).main()
    loaded: Any = trimesh.load(output)
    points = np.concatenate(
        [np.asarray(shape.vertices) for shape in getattr(loaded, "geometry", {"": loaded}).values()]
    )
    assert len(points) > 50
    assert 0.3 < points[:, 1].mean() < 4.5 and np.abs(points).max() < 6.0  # y goes away from the camera, in metres
    scores = json.loads(output.with_suffix(".json").read_text())
    assert scores["voxel"] == 0.1 and scores["chamfer"] == (scores["accuracy"] + scores["completeness"]) / 2
    assert sorted(path.name for path in output.parent.iterdir()) == sorted([output.name, "scene.json"])


def test_a_reference_takes_the_place_of_the_simulated_scene(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(surface, "SURE", 0.0)
    room = trimesh.creation.box((20.0, 20.0, 20.0))
    room.export(tmp_path / "room.ply")
    Export("mesh", run, tmp_path / "mesh.ply", voxel=0.1, reference=tmp_path / "room.ply").main()
    scores = json.loads((tmp_path / "mesh.json").read_text())
    assert 5.0 < scores["accuracy"] < 10.0 and scores["complete_share"] == 0.0


def test_mistakes_are_sentences_and_leave_nothing(run: Path, recording: Path, tmp_path: Path):
    with pytest.raises(FlagError, match=r"neither \.ply nor \.glb"):
        Export("mesh", run, tmp_path / "mesh.obj").main()
    with pytest.raises(FlagError, match="--voxel"):
        Export("mesh", run, tmp_path / "mesh.ply", voxel=-1.0).main()
    with pytest.raises(OutputError, match="within the recording"):
        Export("mesh", run, recording / "mesh.ply").main()
    with pytest.raises(RecordingError, match=r"holds no config\.yml"):
        Export("mesh", tmp_path, tmp_path / "mesh.ply").main()
    with pytest.raises(RecordingError, match="knows no depth"):
        Export("mesh", run, tmp_path / "mesh.ply").main()
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(OutputError, match="is a folder"):
        Export("mesh", run, tmp_path / "folder.ply").main()
    without = tmp_path / "without"
    shutil.copytree(run, without, ignore=shutil.ignore_patterns("nerfstudio_models"))
    with pytest.raises(RecordingError, match="no whole checkpoint"):
        Export("mesh", without, tmp_path / "mesh.ply").main()
    assert {path.name for path in tmp_path.iterdir()} == {"folder.ply", "without"}


def test_a_place_that_cannot_be_written_to_is_a_sentence(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(surface, "SURE", 0.0)
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="cannot be written"):
        Export("pointcloud", run, tmp_path / "file" / "points.ply", voxel=0.1).main()
