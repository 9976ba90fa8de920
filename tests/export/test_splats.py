"""Splats are the surface: a file that other programs read, which a slow rasteriser renders as the views show it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_surface import CAMERA, VOXEL, wall

from enerf_ns.export.splats import OPACITY, encode_splats, splat_sizes
from enerf_ns.export.surface import colours_of, points_of

NAMES = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
"""Properties in the order of the reference code, github.com/graphdeco-inria/gaussian-splatting."""


def parsed(content: bytes) -> dict[str, np.ndarray]:
    header, body = content.split(b"end_header\n", 1)
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert lines[3:] == [f"property float {name}" for name in NAMES]
    rows = np.frombuffer(body, "<f4").reshape(int(lines[2].removeprefix("element vertex ")), len(NAMES))
    return dict(zip(NAMES, rows.T.astype(np.float64), strict=True))


@pytest.fixture(scope="module")
def content() -> bytes:
    cloud = points_of(CAMERA, wall(), VOXEL)
    return encode_splats(cloud, splat_sizes(cloud.vertices, CAMERA, wall(), VOXEL))


def test_a_rasteriser_sees_what_the_views_show(content: bytes):
    """Front to back, as the reference code composites: colour = 0.5 + SH0 f_dc, opacity and scale through their
    activations."""
    splats, seen = parsed(content), wall()[1]
    points = (np.stack([splats[axis] for axis in "xyz"], 1) - seen.pose[:, 3]) @ seen.pose[:, :3]
    colours = 0.5 + 0.28209479177387814 * np.stack([splats[f"f_dc_{i}"] for i in range(3)], 1)
    opacity, sizes = 1 / (1 + np.exp(-splats["opacity"])), np.exp(splats["scale_1"])
    picture, through = np.zeros((60, 80, 3)), np.ones((60, 80))
    rows, columns = np.mgrid[:60, :80]
    for i in np.argsort(points[:, 2]):
        x, y, z = points[i]
        apart = (columns - CAMERA.cx - CAMERA.fx * x / z) ** 2 + (rows - CAMERA.cy - CAMERA.fy * y / z) ** 2
        alpha = opacity[i] * np.exp(-0.5 * apart / (CAMERA.fx * sizes[i] / z) ** 2)
        picture += (through * alpha)[..., None] * colours[i]
        through *= 1 - alpha
    inner = np.s_[3:-3, 3:-3]
    assert through[inner].max() < 0.1 and through[inner].mean() < 0.05
    shown = picture[inner] / (1 - through[inner])[..., None]
    assert np.abs(shown - colours_of(wall())[1][inner] / 255.0).max() < 0.06  # views from other places differ, too


def test_splats_are_as_large_as_the_distance_between_points():
    """Far from all views, points are as far apart as pixels; close to one, as voxels."""
    points = np.array([[0.0, 3.0 + 70.0, 1.0], [0.0, 3.5, 1.0]])
    np.testing.assert_allclose(splat_sizes(points, CAMERA, wall(), VOXEL), [0.75, 0.75 * VOXEL])


def test_other_programs_read_the_file(content: bytes, tmp_path: Path):
    import open3d

    (tmp_path / "splats.ply").write_bytes(content)
    reader: Any = open3d.t.io
    read = reader.read_point_cloud(str(tmp_path / "splats.ply"))
    splats = parsed(content)
    np.testing.assert_allclose(read.point.positions.numpy(), np.stack([splats[axis] for axis in "xyz"], 1), atol=1e-6)
    assert np.allclose(1 / (1 + np.exp(-splats["opacity"])), OPACITY)
    turned = np.stack([splats[f"rot_{i}"] for i in range(4)], 1)
    assert (turned == [1, 0, 0, 0]).all()  # w x y z
    assert (splats["scale_0"] == splats["scale_1"]).all() and (splats["scale_0"] == splats["scale_2"]).all()
