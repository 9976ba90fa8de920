"""`enerf export`: files in metres that trimesh reads, scores beside, and mistakes as sentences."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
import yaml
from scipy.spatial.transform import Rotation
from small_runs import SMALL

from enerf_ns.dataparsers import event_dataparser
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.recording.errors import FlagError, OutputError, RecordingError
from enerf_ns.export import surface
from enerf_ns.method.held_out_views import held_out_views
from enerf_ns.method.runs import load, method_config, train
from enerf_ns.scripts.convert import Convert
from enerf_ns.scripts.export import Export
from enerf_ns.scripts.format_options import format_flags
from enerf_ns.scripts.inspect import Inspect


@pytest.fixture(scope="module")
def run(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run of two steps."""
    return train(method_config("enerf", recording, tmp_path_factory.mktemp("runs"), SMALL)).config_file.parent


@pytest.mark.parametrize(
    ("what", "suffix"), [("mesh", "ply"), ("mesh", "glb"), ("pointcloud", "ply"), ("splats", "ply")]
)
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
    scores = json.loads((output.parent / f"{output.name}.json").read_text())
    assert scores["voxel"] == 0.1 and scores["chamfer"] == (scores["accuracy"] + scores["completeness"]) / 2
    assert sorted(path.name for path in output.parent.iterdir()) == sorted([output.name, f"{output.name}.json"])


def test_a_reference_takes_the_place_of_the_simulated_scene(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(surface, "SURE", 0.0)
    room = trimesh.creation.box((20.0, 20.0, 20.0))
    room.export(tmp_path / "room.ply")
    (tmp_path / "mesh.json").write_text("of the user")
    Export("mesh", run, tmp_path / "mesh.ply", voxel=0.1, reference=tmp_path / "room.ply").main()
    assert (tmp_path / "mesh.json").read_text() == "of the user"
    scores = json.loads((tmp_path / "mesh.ply.json").read_text())
    assert 5.0 < scores["accuracy"] < 10.0 and scores["complete_share"] == 0.0


def test_a_machine_without_the_libraries_of_open3d_is_told_to_install_them(run: Path, tmp_path: Path):
    """As a slim container is, on which `import open3d` raises this error."""
    (tmp_path / "open3d.py").write_text('raise ImportError("libusb-1.0.so.0: cannot open shared object file")\n')
    output = tmp_path / "new" / "mesh.ply"
    script = (
        "import sys\nfrom enerf_ns.export import surface\nfrom enerf_ns.scripts.cli import entrypoint\n"
        f"surface.SURE = 0.0\nsys.argv = ['enerf', 'export', 'mesh', {str(run)!r}, '--output', {str(output)!r}]\n"
        "entrypoint()"
    )
    ended = subprocess.run(
        [sys.executable, "-c", script], env={**os.environ, "PYTHONPATH": str(tmp_path)}, capture_output=True, text=True
    )
    assert ended.returncode == 1 and ended.stderr.count("\n") == 1 and not output.parent.exists()
    assert "libusb-1.0.so.0" in ended.stderr and "apt-get install libusb-1.0-0" in ended.stderr


def test_mistakes_are_sentences_and_leave_nothing(run: Path, recording: Path, tmp_path: Path):
    with pytest.raises(FlagError, match=r"does not end with \.ply or \.glb"):
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


def test_poses_are_written_as_training_refined_them(run: Path, recording: Path, tmp_path: Path):
    """As TUM text, of which NumPy reads the trajectory on the clock of the events; with a lens that OpenCV takes."""
    pipeline = load(run / "config.yml").pipeline
    given = pipeline.datamanager.recording
    pipeline.poses.is_corrected[0], pipeline.poses.value[0] = True, 0.25  # 5 ms
    (checkpoint,) = run.glob("nerfstudio_models/*.ckpt")
    kept = checkpoint.read_bytes()
    stored = torch.load(checkpoint, weights_only=False)
    stored["pipeline"] |= {f"poses.{name}": value for name, value in pipeline.poses.state_dict().items()}
    torch.save(stored, checkpoint)
    try:
        Export("poses", run, tmp_path / "poses.txt").main()
        Convert(recording, tmp_path / "new", run=run).main()
        Inspect(recording, tmp_path / "inspect.html", run=run).main()
        loaded = load(run / "config.yml").pipeline
        manager: Any = loaded.config.datamanager.setup(test_mode="test", device="cpu")  # as ns-render dataset does
    finally:
        checkpoint.write_bytes(kept)

    rows = np.loadtxt(tmp_path / "poses.txt")
    times = np.round(rows[:, 0] * 1e9).astype(np.int64)
    inside = (times > times[0] + 10_000_000) & (times < times[-1] - 20_000_000)
    assert inside.sum() > 5
    expected = given.trajectory.poses(torch.from_numpy(times[inside] + 5_000_000)).numpy()
    np.testing.assert_allclose(rows[inside, 1:4], expected[:, :, 3], atol=1e-6)
    np.testing.assert_allclose(Rotation.from_quat(rows[inside, 4:]).as_matrix(), expected[:, :, :3], atol=1e-6)
    camera = json.loads((tmp_path / "poses.txt.json").read_text())
    assert camera["fx"] == given.camera.fx
    assert [row["is_corrected"] for row in camera["corrections"]] == [True] + 5 * [False]
    assert "Corrections of the poses" in (tmp_path / "inspect.html").read_text()
    seen, refined, stated = (
        one.eval_dataset.cameras.camera_to_worlds for one in (manager, loaded.datamanager, pipeline.datamanager)
    )
    assert torch.equal(seen, refined) and not torch.equal(seen, stated)
    again = read_recording(tmp_path / "new").trajectory
    np.testing.assert_allclose(again.poses(torch.from_numpy(times[inside])).numpy(), expected, atol=1e-6)


def test_options_of_a_recording_are_none_beside_a_run(run: Path, recording: Path, tmp_path: Path):
    """Which has read it as it was told."""
    options = format_flags()(event_camera="left")  # type: ignore
    for command in (
        Inspect(recording, tmp_path / "inspect.html", options, run),
        Convert(recording, tmp_path / "new", options, run),
    ):
        with pytest.raises(FlagError, match="--event-camera is taken from the run of --run; leave it out"):
            command.main()
    assert not list(tmp_path.iterdir())


def test_flags_of_meshes_are_none_of_poses(run: Path, tmp_path: Path):
    with pytest.raises(FlagError, match="--voxel is for meshes"):
        Export("poses", run, tmp_path / "poses.txt", voxel=0.1).main()
    with pytest.raises(FlagError, match=r"does not end with \.txt"):
        Export("poses", run, tmp_path / "poses.ply").main()


def test_a_packed_run_is_rendered_elsewhere_though_the_original_is_gone(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    own, runs = tmp_path / "mine" / "recording", tmp_path / "mine" / "runs"
    shutil.copytree(recording, own)
    folder = train(method_config("enerf", own, runs, SMALL)).config_file.parent
    here = load(folder / "config.yml").pipeline.model.state_dict()
    Export("run", folder, tmp_path / "new" / "packed.zip").main()
    shutil.rmtree(tmp_path / "mine")
    with zipfile.ZipFile(tmp_path / "new" / "packed.zip") as packed:
        assert packed.testzip() is None and not [name for name in packed.namelist() if name.startswith(("/", ".."))]
        packed.extractall(tmp_path / "elsewhere")
    monkeypatch.chdir(tmp_path / "elsewhere")
    (config_file,) = Path("outputs").glob("*/enerf/*/config.yml")
    assert str(tmp_path) not in config_file.read_text()
    loaded = load(config_file)
    assert loaded.pipeline.datamanager.recording.path.resolve() == (tmp_path / "elsewhere" / "recording").resolve()
    for name, value in loaded.pipeline.model.state_dict().items():
        torch.testing.assert_close(value, here[name], rtol=0, atol=0)
    assert held_out_views(loaded.pipeline, evidence=False)[0][0].rendered.isfinite().all()


def test_folders_that_are_links_are_packed_as_folders(run: Path, recording: Path, tmp_path: Path):
    linked = tmp_path / "linked"
    linked.mkdir()
    for part in recording.iterdir():
        (linked / part.name).symlink_to(part)
    (linked / "circle").symlink_to(linked)
    config = copied(run, tmp_path / "run", data=linked)
    Export("run", config, tmp_path / "run.zip").main()
    names = zipfile.ZipFile(tmp_path / "run.zip").namelist()
    there = {f"recording/{file.relative_to(recording).as_posix()}" for file in recording.rglob("*") if file.is_file()}
    assert {name for name in names if name.startswith("recording/")} == there


def test_a_recording_that_is_not_whole_alone_is_not_packed(run: Path, recording: Path, tmp_path: Path, monkeypatch):
    """As one of EVIMO2, of which the name of a folder above states the camera."""
    config = copied(run, tmp_path / "run", data=recording)
    read = event_dataparser.read_recording

    def by_its_place(path: Path, *args: Any, **options: Any) -> Any:
        if path != recording:
            raise RecordingError(f"{path} lies in no folder left_camera, which names the camera.")
        return read(path, *args, **options)

    monkeypatch.setattr(event_dataparser, "read_recording", by_its_place)
    with pytest.raises(
        RecordingError, match=r"cannot be packed, since .* \(it lies in no folder left_camera.*enerf convert"
    ):
        Export("run", config, tmp_path / "run.zip").main()
    assert not (tmp_path / "run.zip").exists()


def copied(run: Path, folder: Path, data: Path) -> Path:
    """A copy of a run on another recording."""
    shutil.copytree(run, folder)
    config = yaml.load((run / "config.yml").read_text(), Loader=yaml.Loader)
    manager = config.pipeline.datamanager
    config.data = manager.data = manager.dataparser.data = data
    (folder / "config.yml").write_text(yaml.dump(config))
    return folder


def test_a_run_whose_recording_is_gone_is_not_packed(recording: Path, tmp_path: Path):
    own = tmp_path / "recording"
    shutil.copytree(recording, own)
    folder = train(method_config("enerf", own, tmp_path / "runs", SMALL)).config_file.parent
    shutil.rmtree(own)
    with pytest.raises(RecordingError, match="of the run is not there any more"):
        Export("run", folder, tmp_path / "packed.zip").main()
    assert not (tmp_path / "packed.zip").exists()
    with pytest.raises(FlagError, match="--voxel is for meshes"):
        Export("run", folder, voxel=0.1).main()
