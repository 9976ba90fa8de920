"""Whether gloss is found where there is some, and nowhere else."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from scipy.spatial.transform import Rotation

from enerf_ns.choices.resolver import resolve
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.method import probe
from enerf_ns.method.config import enerf
from enerf_ns.method.probe import view_direction_gain
from enerf_ns.simulator.event_sensor import EventSensor, SensorSettings
from enerf_ns.simulator.sampling import adaptive_renders

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
DISTANCE = 2.0
LIGHT = np.array([0.0, -0.196, -0.981])


def plane_on_an_arc(folder: Path, gloss: float) -> Path:
    """A plane with a texture and a highlight of some brightness, seen for a second from an arc of 80 degrees."""
    generator = np.random.default_rng(0)
    waves, phases = generator.normal(size=(24, 2)) * 6, generator.uniform(0, 2 * np.pi, 24)
    x, y = np.meshgrid(np.arange(WIDTH) - (WIDTH - 1) / 2, np.arange(HEIGHT) - (HEIGHT - 1) / 2)
    directions = np.stack([x / FOCAL, y / FOCAL, np.ones_like(x)], axis=-1).reshape(-1, 3)

    def pose(time: int) -> tuple[Rotation, np.ndarray]:
        turn = np.radians([40 * np.sin(2e-9 * np.pi * time), 8 * np.cos(4e-9 * np.pi * time)])
        rotation = Rotation.from_euler("yx", turn)
        return rotation, np.array([0, 0, DISTANCE]) + rotation.apply([0, 0, -DISTANCE])

    def brightness(time, pixels=None):
        rotation, centre = pose(time)
        seen = rotation.apply(directions if pixels is None else directions[pixels])
        points = centre + (DISTANCE - centre[2]) / seen[:, 2:] * seen
        texture = 0.3 + 0.2 * np.tanh(np.sin(points[:, :2] @ waves.T + phases).sum(1) / 3)
        reflected = seen / np.linalg.norm(seen, axis=1, keepdims=True) * [1, 1, -1]
        result = texture + gloss * np.exp((reflected @ LIGHT - 1) / 0.03)
        return result.reshape(HEIGHT, WIDTH) if pixels is None else result

    sensor = EventSensor(SensorSettings(contrast_thresholds=(0.2, 0.2)), brightness(0), 0)
    times = np.arange(0, 10**9 + 1, 5_000_000)
    pieces = [
        sensor.advance(render.brightness, render.time, render.before)
        for render in adaptive_renders(brightness, times)
        if render.time > 0
    ]
    (folder / "events").mkdir(parents=True)
    for name, dtype in (("x", np.uint16), ("y", np.uint16), ("t", np.int64), ("p", np.int8)):
        np.save(folder / "events" / f"{name}.npy", np.concatenate([getattr(p, name) for p in pieces]).astype(dtype))
    rows = [(time, *pose(time)) for time in times.tolist()]
    lines = [" ".join(map(str, [time, *centre.tolist(), *turn.as_quat().tolist()])) for time, turn, centre in rows]
    (folder / "poses.txt").write_text("\n".join(lines))
    camera = {"width": WIDTH, "height": HEIGHT, "model": "pinhole", "fx": FOCAL, "fy": FOCAL}
    camera |= {"cx": (WIDTH - 1) / 2, "cy": (HEIGHT - 1) / 2}
    known = {"contrast_thresholds": [0.2, 0.2], "response": "logarithm:0.001", "depth_range": [1.0, 4.0]}
    (folder / "recording.json").write_text(json.dumps({"camera": camera, **known}))
    return folder


@pytest.mark.sweep(1)
@pytest.mark.slow
@pytest.mark.parametrize(("gloss", "expected"), [(0.0, False), (1.0, True)])
def test_gloss_is_found_where_there_is_some(tmp_path: Path, gloss: float, expected: bool):
    recording = read_recording(plane_on_an_arc(tmp_path / "plane", gloss))
    config: Any = copy.deepcopy(enerf.config.pipeline)
    config.datamanager.dataparser.data = recording.path
    config.model.contraction = False  # the light's mirror image lies beyond the box, and may be put there
    optimizer = enerf.config.optimizers["fields"]["optimizer"]
    resolution = resolve(config, recording, probe=lambda filled: view_direction_gain(filled, optimizer, "cpu"))
    row = next(choice for choice in resolution.choices if choice.part == "view direction")
    assert row.kept == resolution.values["model.view_direction"] == expected
    assert "goes 67 degrees around" in row.why and "held-out pairs" in row.why


@pytest.mark.parametrize("supervision", ["events", "events+frames", "frames"])
def test_a_probe_leaves_random_numbers_alone_and_answers_twice_the_same(recording: Path, monkeypatch, supervision: str):
    monkeypatch.setattr(probe, "STEPS", 2)
    config: Any = copy.deepcopy(enerf.config.pipeline)
    manager, model = config.datamanager, config.model
    manager.dataparser.data, manager.supervision = recording, supervision
    model.num_levels, model.log2_table_size, model.num_samples = 3, 10, 8
    filled = resolve(config, read_recording(recording)).applied_to(config)
    before = torch.get_rng_state()
    first = view_direction_gain(filled, AdamOptimizerConfig(lr=1e-2), "cpu")
    assert (torch.get_rng_state() == before).all()
    probe._gain.cache_clear()
    assert view_direction_gain(filled, AdamOptimizerConfig(lr=1e-2), "cpu") == first
    assert np.isfinite(first).all() and first[1] > 0
