"""The specification for nerfbaselines, which is not installed here: what it registers, and the parts that it names."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module
from importlib.metadata import distribution
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from small_runs import SMALL

from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.method.held_out_views import held_out_view
from enerf_ns.nerfbaselines.method import EnerfMethod
from enerf_ns.nerfbaselines.protocol import LogAffineSet

REGISTERED = """
import sys, types
found = []
sys.modules["nerfbaselines"] = types.SimpleNamespace(register=found.append)
import enerf_ns.nerfbaselines.spec
print(found)
print([name for name in ("torch", "numpy", "nerfstudio") if name in sys.modules])
"""


def test_the_specification_loads_nothing_and_names_what_is_there():
    run = subprocess.run([sys.executable, "-c", REGISTERED], capture_output=True, text=True, check=True)
    registered, loaded = run.stdout.splitlines()
    assert loaded == "[]"
    by_id = {spec["id"]: spec for spec in eval(registered)}
    assert set(by_id) == {"enerf", "enerf-recording", "enerf-simulated", "log-affine-set"}
    for spec in by_id.values():
        for value in spec.values():
            if isinstance(value, str) and value.startswith("enerf_ns."):
                module, _, name = value.partition(":")
                assert callable(getattr(import_module(module), name))
    assert by_id["enerf-simulated"]["evaluation_protocol"] in by_id


def test_the_entry_point_names_the_specification():
    points = [point for point in distribution("enerf-ns").entry_points if point.group == "nerfbaselines.specs"]
    assert [point.value for point in points] in ([], ["enerf_ns.nerfbaselines.spec"])  # none before the next set-up
    assert 'enerf = "enerf_ns.nerfbaselines.spec"' in (Path(__file__).parents[1] / "pyproject.toml").read_text()


def test_the_protocol_fits_one_scale_and_one_power_over_all_frames():
    """Renders that differ from frames by these alone are exact; a scale of its own for each frame is not."""
    frames = [np.random.default_rng(seed).uniform(0.1, 0.9, (20, 20, 3)).astype(np.float32) for seed in range(2)]

    def scores(scales: tuple[float, float]) -> dict[str, float]:
        protocol = LogAffineSet()
        protocol.evaluate({"color": frames[0][::-1]}, {"images": [frames[0]]})  # one that is shown during training
        pairs = zip(scales, frames, strict=True)
        return protocol.accumulate_metrics(
            protocol.evaluate({"color": scale * frame**1.3}, {"images": [frame]}) for scale, frame in pairs
        )

    assert scores((3.0, 3.0))["psnr"] > 50 and scores((3.0, 3.0))["ssim"] > 0.999
    assert scores((3.0, 0.5))["psnr"] < 25


def camera_of(method: EnerfMethod) -> Any:
    """The first held-out camera as nerfbaselines gives it."""
    frames = method._pipeline.datamanager.eval_dataset.frames
    lens = frames.picture_camera
    camera = SimpleNamespace(
        poses=frames.trajectory.poses(torch.from_numpy(frames.times)).numpy()[0].astype(np.float32),
        intrinsics=np.array([lens.fx, lens.fy, lens.cx + 0.5, lens.cy + 0.5], np.float32),
        image_sizes=np.array([lens.width, lens.height]),
    )
    camera.item = lambda: camera
    return camera


def test_a_method_renders_held_out_cameras_and_is_the_same_after_it_was_stored(recording: Path, tmp_path: Path):
    changes = {name: str(value) for name, value in SMALL.items() if name != "timestamp"}
    method = EnerfMethod(train_dataset={"metadata": {"events": str(recording)}}, config_overrides=changes)
    losses = [method.train_iteration(step)["loss"] for step in range(2)]
    assert np.isfinite(losses).all() and method.get_info()["num_iterations"] == 2
    camera = camera_of(method)
    shown = method.render(camera)
    expected = held_out_view(method._pipeline.eval(), 0)
    np.testing.assert_allclose(shown["color"], expected.rendered.numpy(), atol=1e-4)
    method.save(str(tmp_path / "stored"))
    (tmp_path / "stored").rename(tmp_path / "moved")
    restored = EnerfMethod(checkpoint=str(tmp_path / "moved"))
    assert restored.get_info()["loaded_step"] == 2
    for name, value in restored.render(camera).items():
        np.testing.assert_array_equal(value, shown[name])


def test_a_data_set_without_events_is_refused():
    with pytest.raises(RecordingError, match="carries no events"):
        EnerfMethod(train_dataset={"metadata": {}})
