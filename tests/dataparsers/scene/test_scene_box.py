from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from geometry import unproject
from recordings import write_davis, write_esim

from enerf_ns.dataparsers.event_dataparser import EventDataParserConfig
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.scene.scene_box import scene_normalisation

NEAR, FAR = 0.5, 4.0


def test_the_box_holds_what_the_camera_sees_between_near_and_far(tmp_path: Path):
    folder = write_davis(tmp_path / "davis")
    recording = read_recording(folder)
    transform, scale, box = scene_normalisation(recording, NEAR, FAR)
    assert np.ptp(box, axis=0).max() == pytest.approx(2.0)
    np.testing.assert_allclose(box.sum(axis=0), 0.0, atol=1e-9)

    random = np.random.default_rng(0)
    seen = []
    for time in random.integers(recording.trajectory.start, recording.trajectory.end, 20):
        for corner in ((0, 0), (23, 0), (0, 17), (23, 17)):
            seen += [unproject(np.array(corner), depth, int(time), recording.camera) for depth in (NEAR, FAR)]
    points = scale * (np.array(seen) @ transform[:, :3].T + transform[:, 3])
    assert (points > box[0] - 1e-3).all() and (points < box[1] + 1e-3).all()
    assert (np.ptp(points, axis=0) > 0.9 * np.ptp(box, axis=0)).all(), "the box is not much larger than that"


def test_what_the_camera_sees_before_the_depth_of_contraction_lies_in_the_box_that_it_leaves(tmp_path: Path):
    recording = read_recording(write_davis(tmp_path / "davis"))
    near_part = scene_normalisation(recording, NEAR, 1.5)
    transform, scale, box = scene_normalisation(recording, NEAR, FAR, contraction_depth=1.5)
    np.testing.assert_allclose(transform, near_part[0], atol=1e-12)
    assert scale == pytest.approx(near_part[1])
    even_transform, even_scale, even_box = scene_normalisation(recording, NEAR, FAR)
    for corner, even_corner in zip(box, even_box, strict=True):
        in_world, expected = corner / scale - transform[:, 3], even_corner / even_scale - even_transform[:, 3]
        np.testing.assert_allclose(in_world, expected, atol=1e-9)
    for depth in (0.01, FAR, 100.0):
        limited = scene_normalisation(recording, NEAR, FAR, contraction_depth=depth)
        expected = scene_normalisation(recording, NEAR, min(max(depth, NEAR), FAR))
        assert limited[1] == pytest.approx(expected[1])


def test_a_box_is_a_cube_of_the_world(tmp_path: Path):
    folder = write_esim(tmp_path / "esim")
    config = EventDataParserConfig(data=folder, depth_range=(NEAR, FAR), box=(2.0, 1.0, -3.0, 4.0))
    outputs = config.setup().get_dataparser_outputs("train")
    transform, scale = outputs.dataparser_transform.numpy(), outputs.dataparser_scale
    for corner, mapped in (((-2, -3, -7), (-1, -1, -1)), ((6, 5, 1), (1, 1, 1)), ((2, 1, -3), (0, 0, 0))):
        np.testing.assert_allclose(scale * (transform @ [*corner, 1.0]), mapped, atol=1e-6)
    np.testing.assert_array_equal(outputs.scene_box.aabb, [[-1, -1, -1], [1, 1, 1]])
