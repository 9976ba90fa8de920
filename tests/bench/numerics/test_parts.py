from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.field_components.field_heads import FieldHeadNames
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp
from small_runs import SMALL

from enerf_ns.bench.numerics import parts
from enerf_ns.bench.numerics.parts import SAMPLES, PartError, error_of_parts, pose_interpolation
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.method.runs import Run, method_config, train
from enerf_ns.sensor.response import linlog

CAMERA = Camera(width=64, height=48, fx=80.0, fy=80.0, cx=31.5, cy=23.5)
TIMES = np.arange(65) * 10_000_000


@pytest.fixture(scope="module", params=["proposal", "uniform"])
def run(recording: Path, request: pytest.FixtureRequest) -> Run:
    """Of two steps, with a field that is not empty and not even."""
    changes = {**SMALL, "pipeline.model.sampling": request.param, "timestamp": request.param}
    run = train(method_config("enerf", recording, recording.parent / "parts", changes))
    geometry = run.pipeline.model.field.geometry
    geometry.init_density = 5.0
    with torch.no_grad():
        geometry.grid.table.mul_(5e3)
    return run


@pytest.fixture(autouse=True)
def few_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts, "NUM_RAYS", 100)
    monkeypatch.setattr(parts, "NUM_PAIRS", 50)


def by_name(rows: list[PartError]) -> dict[tuple[str, str], float]:
    return {(row.name, row.unit): row.error for row in rows}


def test_errors_are_there_of_each_part_and_the_run_is_as_before(run: Run):
    model = run.pipeline.model
    before = {name: value.clone() for name, value in model.state_dict().items()}
    sampler, proposal = model.sampler, model.proposal
    found = error_of_parts(run)
    rows = by_name(found)
    assert len(rows) == len(found), "no row twice"
    quadrature = [error for (name, unit), error in rows.items() if "samples a ray" in name and unit == "dB"]
    numbers = {*SAMPLES, SMALL["pipeline.model.num_samples"]}
    assert len(quadrature) == len(set(quadrature)) == len(numbers) + 1, "of each number, and even"
    assert model.sampler is sampler and model.proposal is proposal and model.training
    assert torch.get_default_dtype() == torch.float32
    for name, value in model.state_dict().items():
        assert torch.equal(value, before[name])
    assert all(np.isfinite(error) and error >= 0.0 for error in rows.values())
    for number, fewer in ((512, 128), (128, 8)):
        more, less = (f"quadrature, {samples} samples a ray" for samples in (number, fewer))
        assert rows[more, "log brightness"] < rows[less, "log brightness"] and rows[more, "dB"] > rows[less, "dB"]
    assert "quadrature, 16 samples a ray (as trained)" in {name for name, _ in rows}
    assert 0.0 < rows["change of log brightness in float32", "thresholds"] < 1e-2


def test_the_converged_render_is_the_integral_of_a_loop(run: Run, monkeypatch: pytest.MonkeyPatch):
    model = run.pipeline.model
    monkeypatch.setattr(model, "_faint", 0.0)  # else a share of the light is left out
    model.eval()
    rays = parts._random_rays(run)[:3]
    with parts._samples(model, 256, even=True):
        found, _ = parts._rendered(model, rays)
    rays = model.collider(rays)
    assert rays.nears is not None and rays.fars is not None
    for number in range(3):
        ray = rays[number : number + 1]
        edges = np.linspace(float(rays.nears[number]), float(rays.fars[number]), 257)
        through, colour = 1.0, 0.0
        for start, end in itertools.pairwise(edges):
            bounds = [torch.tensor([[[value]]], dtype=torch.float32) for value in (start, end)]
            sample = ray.get_ray_samples(bin_starts=bounds[0], bin_ends=bounds[1])
            with torch.no_grad():
                outputs = model.field(sample)
            stopped = -np.expm1(-float(outputs[FieldHeadNames.DENSITY]) * (end - start))
            colour += through * stopped * float(outputs[FieldHeadNames.RGB][..., 0])
            through *= 1.0 - stopped
        assert float(found[number, 0]) == pytest.approx(model.gain * colour, rel=1e-3)
    model.train()


def test_what_the_brightness_fit_leaves_is_that_of_numpy(run: Run, monkeypatch: pytest.MonkeyPatch):
    shade = torch.linspace(0.6, 0.1, 32).expand(24, 32)[..., None].expand(-1, -1, 3)

    def outputs(rays: Any) -> dict[str, torch.Tensor]:
        return {"rgb": shade.clone(), "depth": torch.ones(24, 32, 1)}

    monkeypatch.setattr(run.pipeline.model, "get_outputs_for_camera_ray_bundle", outputs)
    dataset = run.pipeline.datamanager.eval_dataset
    recorded = torch.stack([dataset[number]["image"][..., :3] for number in range(3)])
    y = linlog(recorded.double()).flatten().numpy()
    if np.polyfit(linlog(shade.double()).expand(3, -1, -1, -1).flatten().numpy(), y, 1)[0] < 0:
        shade = torch.flip(shade, [1])
    x = linlog(shade.double()).expand(3, -1, -1, -1).flatten().numpy()
    slope, offset = np.polyfit(x, y, 1)
    (row,) = parts._brightness_fit(run)
    assert slope > 0 and row.name == "brightness after the fit (log-affine-set, 3 frames)"
    assert row.error == pytest.approx(np.sqrt(np.mean((slope * x + offset - y) ** 2)), rel=1e-5)


def test_a_run_without_frames_has_no_brightness_fit(run: Run, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(run.pipeline.datamanager.eval_dataset, "are_frames", False)
    names = [row.name for row in error_of_parts(run)]
    assert not [name for name in names if name.startswith("brightness")] and len(names) > 20


def test_pose_interpolation_is_that_of_scipy():
    angle = 2 * np.pi * np.linspace(0, 1, 65)[:, None]
    positions = 0.3 * np.concatenate([np.sin(angle), np.cos(angle), np.sin(2 * angle)], axis=1)
    rotations = Rotation.from_rotvec(0.2 * np.concatenate([np.sin(angle), np.sin(3 * angle), np.cos(angle)], axis=1))
    trajectory = Trajectory(TIMES, positions, rotations.as_quat())
    rows = by_name(pose_interpolation(trajectory, np.array([[TIMES[0], TIMES[-1]]]), CAMERA, 2.0))
    for keep in (2, 4, 8):
        left_out = np.flatnonzero(np.arange(65) % keep)
        spline = CubicSpline(TIMES[::keep], positions[::keep])
        turned = Slerp(TIMES[::keep], rotations[::keep])(TIMES[left_out])
        errors = np.linalg.norm(spline(TIMES[left_out]) - positions[left_out], axis=1)
        turns = (turned.inv() * Rotation.from_quat(rotations.as_quat()[left_out])).magnitude()
        name = f"pose interpolation, one of {keep} poses"
        assert rows[name, "m"] == pytest.approx(np.sqrt(np.mean(errors**2)), rel=1e-6)
        assert rows[name, "degrees"] == pytest.approx(np.degrees(np.sqrt(np.mean(turns**2))), rel=1e-6)
    assert not [name for name, _ in rows if "16" in name], "too few poses would be left"


def test_pixels_of_a_sideways_error_are_the_focal_length_times_the_error_over_the_depth():
    positions = np.stack([0.1 * np.sin(0.7 * np.arange(65)), np.zeros(65), np.zeros(65)], axis=1)
    trajectory = Trajectory(TIMES, positions, np.tile([0.0, 0.0, 0.0, 1.0], (65, 1)))
    rows = by_name(pose_interpolation(trajectory, np.array([[TIMES[0], TIMES[-1]]]), CAMERA, 2.5))
    for keep in (2, 4, 8):
        name = f"pose interpolation, one of {keep} poses"
        assert rows[name, "pixels at 2.5 m"] == pytest.approx(80.0 * rows[name, "m"] / 2.5) and rows[name, "m"] > 1e-4
        assert rows[name, "degrees"] == 0.0


def test_poses_in_parts_that_are_not_used_do_not_count():
    """Of a motion along a cubic, which the spline follows, but for one jump."""
    positions = (np.arange(65.0)[:, None] / 65.0) ** 3 * [0.1, 0.2, 0.3]
    positions[33] += 1.0
    trajectory = Trajectory(TIMES, positions, np.tile([0.0, 0.0, 0.0, 1.0], (65, 1)))
    whole, parted = np.array([[TIMES[0], TIMES[-1]]]), np.array([[TIMES[0], TIMES[32]], [TIMES[34], TIMES[-1]]])
    errors = [by_name(pose_interpolation(trajectory, used, CAMERA, 2.0)) for used in (whole, parted)]
    name = "pose interpolation, one of 2 poses", "m"
    assert errors[0][name] > 0.1 and errors[1][name] < 1e-12
