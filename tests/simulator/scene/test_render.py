"""The renderer against closed forms, OpenCV's projection, trimesh, slow loops in float64, and finer pictures."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from known_points import points_seen, project, spot_centre
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation
from trimesh.ray import ray_triangle

import enerf_ns.dataparsers
from enerf_ns.dataparsers.formats.eds import PUBLISHED_EVENT_CAMERA, PUBLISHED_RGB_CAMERA
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.simulator.scene import textures
from enerf_ns.simulator.scene.render import Renderer
from enerf_ns.simulator.scene.scenes import SCENES, Scene, Surface, build_scene
from enerf_ns.simulator.trajectories import MOTIONS, look_at

WIDTH, HEIGHT = 48, 36
RNG = np.random.default_rng
WHITE = np.ones((1, 1))
HERE = np.eye(4)[:3]
"""Pose of a camera at the origin that looks along z."""
POSE = np.column_stack([Rotation.from_euler("xyz", [160, 35, -70], degrees=True).as_matrix(), [0.7, -1.1, 2.3]])
"""Any other."""
CAMERAS = {
    "pinhole": Camera(320, 240, 250.0, 240.0, 163.3, 115.9),
    "EDS frames": PUBLISHED_RGB_CAMERA,
    "EDS events": PUBLISHED_EVENT_CAMERA,
    "TUM-VIE events": Camera(
        *(1280, 720, 1049.58, 1049.42, 634.72, 263.47), (-0.1152, -0.06222, 0.2168, -0.2353), "fisheye"
    ),
    "TUM-VIE frames": Camera(
        *(512, 512, 373.66, 373.58, 245.18, 252.37), (0.0197, 0.00196, 0.00209, -0.00095), "fisheye"
    ),
}
"""Like those of the data sets; the frames of TUM-VIE at half their size."""


def camera_of(width: int, height: int, focal_length: float) -> Camera:
    """Without distortion, looking along the middle of its picture."""
    return Camera(width, height, focal_length, focal_length, (width - 1) / 2, (height - 1) / 2)


def quad(corners: ArrayLike, image: np.ndarray = WHITE, uv: ArrayLike = ((0, 0), (1, 0), (1, 1), (0, 1))) -> Surface:
    """Two triangles between four corners, in a grey texture."""
    halves = [[0, 1, 2], [0, 2, 3]]
    return Surface(np.array(corners, float)[halves], np.array(uv, float)[halves], np.ones((2, 3, 1)), image[..., None])


def plane(depth: float, image: np.ndarray) -> Scene:
    """A plane z = depth of 4 by 4 metres, as large as its texture, whose origin is at x = y = 0."""
    corners = np.array([[-2, -2, depth], [2, -2, depth], [2, 2, depth], [-2, 2, depth]])
    return scene_of([quad(corners, image, corners[:, :2] / 4)])


def coloured(triangles: np.ndarray, brightness: ArrayLike) -> Surface:
    """Triangles without texture, each of one brightness."""
    shade = np.broadcast_to(np.reshape(brightness, (-1, 1, 1)), (len(triangles), 3, 1))
    return Surface(triangles, np.zeros((len(triangles), 3, 2)), shade, WHITE[..., None])


def scene_of(surfaces: list[Surface], background: float = 0.0) -> Scene:
    return build_scene(surfaces, (0, 0, 0), (0, 0, 1), background)


def pose_of(rotation: Rotation, position: ArrayLike) -> np.ndarray:
    return np.column_stack([rotation.as_matrix(), position])


def moved(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """From the axes of a camera to the world's."""
    return points @ pose[:, :3].T + pose[:, 3]


@cache
def rays_of(camera: Camera) -> np.ndarray:
    """Directions (x, y, 1) of the pixels' centres, [height, width, 3], by OpenCV."""
    places = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).reshape(-1, 2)
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    seen = points_seen(
        places, np.ones(len(places)), poses, camera.matrix, camera.distortion or np.zeros(4), camera.model
    )
    return seen.reshape(camera.height, camera.width, 3)


def depth_of_plane(normal: ArrayLike, distance: float, rays: np.ndarray) -> np.ndarray:
    """Of the plane of points p with normal . p = distance."""
    return distance / (rays @ np.array(normal, float))


def tilted_quad(normal: np.ndarray, distance: float, size: float, image: np.ndarray = WHITE) -> Surface:
    """A square with its middle on the z axis, in the plane of points p with normal . p = distance."""
    middle = np.array([0, 0, distance / normal[2]])
    across = np.cross([0, 1, 0], normal)
    across = across / np.linalg.norm(across) * size / 2
    down = np.cross(normal, across) / np.linalg.norm(normal)
    sides = np.array([-across - down, across - down, across + down, -across + down])
    return quad(middle + sides, image)


def nearest_by_loop(scene: Scene, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth (0: nothing) and brightness of untextured triangles along rays [N, 3]: Möller and Trumbore, in float64."""
    depth, brightness = np.full(len(rays), np.inf), np.full(len(rays), scene.background)
    for corners, shade in zip(scene.triangles.astype(float), scene.shade[:, 0, 0], strict=True):
        a, b = corners[1] - corners[0], corners[2] - corners[0]
        across = np.cross(rays, b)
        determinant = across @ a
        with np.errstate(divide="ignore", invalid="ignore"):
            u = across @ -corners[0] / determinant
            other = np.cross(-corners[0], a)
            v, t = rays @ other / determinant, b @ other / determinant
            hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < depth)
        depth[hit], brightness[hit] = t[hit], shade
    return np.where(np.isfinite(depth), depth, 0), brightness


def soup(count: int, seed: int) -> np.ndarray:
    """Triangles anywhere around the camera, many through each other and many through the plane of the camera."""
    rng = RNG(seed)
    return rng.uniform(-2, 2, (count, 1, 3)) + rng.normal(0, 0.8, (count, 3, 3))


# What is seen where


def test_plane_seen_from_the_front_has_its_distance_as_depth_and_its_brightness():
    renderer = Renderer(plane(1.7, np.full((textures.SIZE, textures.SIZE), 0.6)), camera_of(WIDTH, HEIGHT, 40.0))
    pose = pose_of(Rotation.from_euler("z", 20, degrees=True), [0.1, -0.2, 0.3])
    np.testing.assert_allclose(renderer.depth(pose), 1.4, atol=1e-5)
    np.testing.assert_allclose(renderer.brightness(pose), 0.6, atol=1e-6)


def test_rays_that_hit_nothing_have_depth_and_brightness_zero():
    renderer = Renderer(plane(1.0, WHITE), camera_of(WIDTH, HEIGHT, 40.0))
    away = pose_of(Rotation.from_euler("y", 180, degrees=True), [0, 0, 0])
    assert (renderer.depth(away) == 0).all() and (renderer.brightness(away) == 0).all()


def test_a_dot_is_drawn_where_opencv_projects_it():
    spot = np.array([0.25, -0.125])
    image = np.zeros((textures.SIZE, textures.SIZE))
    column, row = np.round(spot * textures.TEXELS_PER_METRE).astype(int)
    image[row - 4 : row + 4, column - 4 : column + 4] = 1
    camera = camera_of(160, 120, 150.0)
    rotation, position = Rotation.from_euler("xyz", [6, -8, 15], degrees=True), np.array([0.2, 0.1, 0.4])
    drawn = Renderer(plane(2.0, image), camera).brightness(pose_of(rotation, position))
    centre = [(drawn * grid).sum() / drawn.sum() for grid in np.meshgrid(np.arange(160), np.arange(120))]
    world_to_camera = rotation.inv()
    expected, _ = cv2.projectPoints(
        np.array([[*spot, 2.0]]),
        world_to_camera.as_rotvec(),
        -world_to_camera.apply(position),
        camera.matrix,
        np.zeros(4),
    )
    np.testing.assert_allclose(centre, expected.ravel(), atol=0.05)


@pytest.mark.parametrize("name", CAMERAS)
def test_spots_on_a_tilted_plane_are_drawn_where_opencv_projects_them(name):
    """All over the picture. Each is in the middle of a texture of its own quad; all quads lie in one plane."""
    camera = CAMERAS[name]
    matrix, distortion = camera.matrix, camera.distortion or np.zeros(4)
    grid = np.meshgrid(np.linspace(10.3, camera.width - 11.4, 9), np.linspace(10.2, camera.height - 11.3, 7))
    pixels = np.stack(grid, axis=-1).reshape(-1, 2)
    eye = np.tile(np.eye(4), (len(pixels), 1, 1))
    rays = points_seen(pixels, np.ones(len(pixels)), eye, matrix, distortion, camera.model)
    normal = np.array([0.2, -0.3, 1])
    middles = rays * depth_of_plane(normal, 2.0, rays)[:, None]
    across = np.array([1, 0, -0.2]) / np.hypot(1, 0.2)
    down = np.cross(normal, across) / np.linalg.norm(normal)
    texel = np.arange(32) - 15.5
    spot = np.exp(-(texel**2 + texel[:, None] ** 2) / (2 * 4.0**2))
    surfaces = []
    for middle in middles:
        x, y = across * 7 * middle[2] / camera.fx, down * 7 * middle[2] / camera.fy
        corners = middle + np.array([-x - y, x - y, x + y, -x + y])
        surfaces.append(quad(moved(corners, POSE), spot))
    drawn = 255 * Renderer(scene_of(surfaces), camera).brightness(POSE)
    poses = np.tile(np.vstack([POSE, [0, 0, 0, 1]]), (len(pixels), 1, 1))
    expected = project(moved(middles, POSE), poses, matrix, distortion, camera.model)
    np.testing.assert_allclose(expected, pixels, atol=1e-3)
    centres = np.array([spot_centre(drawn, place) for place in expected])
    assert np.linalg.norm(centres - expected, axis=1).max() < 0.05


@pytest.mark.parametrize("name", CAMERAS)
def test_depth_of_a_plane_is_along_the_axis_of_the_camera(name):
    normal, rays = np.array([0.3, -0.2, 1]), rays_of(CAMERAS[name])
    assert np.ptp(np.linalg.norm(rays, axis=-1)) > 0.1
    renderer = Renderer(scene_of([tilted_quad(normal, 3.0, 200.0)]), CAMERAS[name])
    for angles in ([0, 0, 0], [-25, 5, 170], [10, 22, -60]):
        pose = pose_of(Rotation.from_euler("xyz", angles, degrees=True), [0.4, -0.3, -0.5])
        expected = depth_of_plane(normal, 3.0 - float(normal @ pose[:, 3]), rays @ pose[:, :3].T)
        assert 0 < expected.min() and expected.max() < 20
        np.testing.assert_allclose(renderer.depth(pose), expected, rtol=2e-5)


def test_depth_of_a_camera_given_by_its_directions():
    camera = camera_of(40, 30, 30.0)
    directions = camera.pixel_directions()[..., :2]
    bent = directions * (1 + 0.2 * (directions**2).sum(-1, keepdims=True))
    surface = tilted_quad(np.array([0.3, 0.1, 1]), 2.0, 60.0)
    found = Renderer(scene_of([surface]), replace(camera, model="lookup", directions=bent)).depth(HERE)
    expected = depth_of_plane([0.3, 0.1, 1], 2.0, np.dstack([bent, np.ones((30, 40))]))
    np.testing.assert_allclose(found, expected, rtol=2e-5)


def test_depth_of_a_ball():
    """Its mesh lies inside it by at most the sagitta of its longest edge."""
    centre, radius = np.array([0.2, -0.1, 3.0]), 1.0
    mesh = trimesh.creation.icosphere(5, radius)
    sagitta = radius - np.sqrt(radius**2 - mesh.edges_unique_length.max() ** 2 / 3)
    camera = camera_of(120, 100, 110.0)
    found = Renderer(scene_of([coloured(moved(mesh.triangles + centre, POSE), 1)]), camera).depth(POSE)
    rays = rays_of(camera)
    squared, along = (rays**2).sum(-1), rays @ centre
    root = along**2 - squared * (centre @ centre - radius**2)
    depth = (along - np.sqrt(np.maximum(root, 0))) / squared
    hit = root > 0
    behind = found - depth
    normals = (rays * depth[..., None] - centre) / radius
    grazing = -(normals * rays).sum(-1) / np.sqrt(squared)
    well_inside = hit & (grazing > 0.3)
    assert well_inside.sum() > 2000
    assert behind[well_inside].min() > -1e-5
    assert (behind * grazing)[well_inside].max() < 1.2 * sagitta < 1e-3
    assert (found[~hit] == 0).all()


def test_what_is_seen_is_what_trimesh_finds_nearest():
    scene = SCENES["shapes"](RNG(0))
    camera = camera_of(WIDTH, HEIGHT, 40.0)
    trajectory = MOTIONS["shake"](10**9, scene.camera, scene.target, RNG(1))
    pose = trajectory.poses(torch.tensor(345_678_901)).numpy()
    mesh = trimesh.Trimesh(
        scene.triangles.reshape(-1, 3), np.arange(3 * len(scene.triangles)).reshape(-1, 3), process=False
    )
    rays = camera.pixel_directions().reshape(-1, 3)
    origins = np.tile(pose[:, 3], (len(rays), 1))
    points, ray, _ = ray_triangle.RayMeshIntersector(mesh).intersects_location(origins, rays @ pose[:, :3].T)
    depth = np.full(len(rays), np.inf)
    np.minimum.at(depth, ray, (points - pose[:, 3]) @ pose[:, 2])
    found = Renderer(scene, camera).depth(pose).ravel()
    assert np.mean(np.abs(found - depth) < 1e-3) > 0.995  # a ray along an edge may go to either side


@pytest.mark.parametrize("seed", range(3))
def test_depth_of_triangles_all_around_is_what_a_slow_loop_finds(seed):
    scene = scene_of([coloured(soup(120, seed), 1)])
    assert ((scene.triangles[..., 2] > 0).any(1) & (scene.triangles[..., 2] < 0).any(1)).sum() > 20
    camera = Camera(61, 47, 25.0, 25.0, 28.1, 24.7)
    expected, _ = nearest_by_loop(scene, rays_of(camera).reshape(-1, 3))
    found = Renderer(scene, camera).depth(HERE).ravel()
    wrong = np.abs(found - expected) > 1e-4 * expected
    assert wrong.mean() < 0.001  # of a ray along an edge
    assert 0.1 < (expected > 0).mean() and len(np.unique(expected)) > 1000


# What is not seen


@pytest.mark.parametrize("background", [0.0, 0.3, 7.5])
def test_the_background_is_where_nothing_is_hit(background):
    corners = [[-0.5, -0.5, 2], [0.5, -0.5, 2], [0.5, 0.5, 2], [-0.5, 0.5, 2]]
    renderer = Renderer(scene_of([quad(corners, 0.6 * WHITE)], background), camera_of(40, 40, 40.0))
    brightness, depth = renderer.brightness(HERE), renderer.depth(HERE)
    np.testing.assert_allclose(brightness[12:28, 12:28], 0.6, rtol=1e-6)
    np.testing.assert_allclose(depth[12:28, 12:28], 2, rtol=1e-6)
    beside = np.ones((40, 40), bool)
    beside[9:31, 9:31] = False
    np.testing.assert_allclose(brightness[beside], background, rtol=1e-6)
    assert (depth[beside] == 0).all()


def test_triangles_behind_the_camera_are_not_seen():
    triangles = soup(200, 5)
    triangles[..., 2] = -0.01 - np.abs(triangles[..., 2])
    renderer = Renderer(scene_of([coloured(triangles, 1)], 0.25), camera_of(50, 40, 15.0))
    assert (renderer.brightness(HERE) == 0.25).all() and (renderer.depth(HERE) == 0).all()


def test_a_floor_that_reaches_behind_the_camera_is_seen_up_to_the_horizon():
    floor = quad([[-900, 1.5, -700], [800, 1.5, -900], [950, 1.5, 1100], [-1000, 1.5, 900]], 0.8 * WHITE)
    camera = Camera(60, 50, 40.0, 40.0, 29.5, 20.0)
    renderer = Renderer(scene_of([floor], 0.1), camera)
    rays = rays_of(camera)
    depth = np.where(rays[..., 1] > 0, 1.5 / np.where(rays[..., 1] > 0, rays[..., 1], 1), 0)
    np.testing.assert_allclose(renderer.depth(HERE), depth, rtol=1e-5)
    brightness = renderer.brightness(HERE)
    np.testing.assert_allclose(brightness[:20], 0.1, rtol=1e-6)
    np.testing.assert_allclose(brightness[21:], 0.8, rtol=1e-6)
    np.testing.assert_allclose(brightness[20], 0.45, atol=0.05)


@pytest.mark.parametrize(
    "angles", [(0, 0, 0), (90, 0, 0), (0, 90, 0), (0, 180, 0), (0, 0, 45), (33, -71, 12), (-140, 20, 99)]
)
def test_the_inside_of_a_box_is_seen_on_all_sides(angles):
    lower, upper = np.array([-1.0, -2, -1.5]), np.array([2.0, 1, 3])
    box = trimesh.creation.box(bounds=[lower, upper])
    levels = np.array([0.2, 0.3, 0.4, 0.5, 0.6, 0.7])
    sides = np.where(box.face_normals.min(1) < -0.5, 3 + box.face_normals.argmin(1), box.face_normals.argmax(1))
    camera = camera_of(64, 64, 20.0)
    pose = pose_of(Rotation.from_euler("xyz", angles, degrees=True), [0.3, -0.4, 0.2])
    renderer = Renderer(scene_of([coloured(box.triangles, levels[sides])], 2.0), camera)
    rays = rays_of(camera) @ pose[:, :3].T
    with np.errstate(divide="ignore"):
        exits = np.concatenate([(upper - pose[:, 3]) / rays, (lower - pose[:, 3]) / rays], axis=-1)
    exits[exits <= 0] = np.inf
    np.testing.assert_allclose(renderer.depth(pose), exits.min(-1), rtol=1e-5)
    brightness = renderer.brightness(pose)
    assert brightness.max() < 0.7 + 1e-5
    first, second = np.sort(exits, axis=-1)[..., :2].transpose(2, 0, 1)
    away_from_edges = second > 1.2 * first
    assert away_from_edges.sum() > 2000
    np.testing.assert_allclose(brightness[away_from_edges], levels[exits.argmin(-1)][away_from_edges], rtol=1e-5)


def test_triangles_without_area_and_those_seen_along_their_plane_change_nothing():
    rng = RNG(2)
    corner, other = rng.uniform([-1, -1, 0.5], [1, 1, 2.5], (2, 30, 3))
    point, line = np.stack([corner] * 3, axis=1), np.stack([corner, (corner + other) / 2, other], axis=1)
    needle = np.stack([corner, other, other], axis=1)
    edge_on = rng.uniform(0.5, 3, (30, 3, 3)) * np.where(np.arange(30)[:, None, None] % 2, [0, 1, 1], [1, 0, 1])
    through_camera = np.stack([np.zeros((30, 3)), corner, other], axis=1)
    wall = quad([[-5, -5, 2], [5, -5, 2], [5, 5, 2], [-5, 5, 2]], 0.5 * WHITE)
    camera = Camera(64, 48, 40.0, 40.0, 32.0, 24.0)
    alone = Renderer(scene_of([wall]), camera)
    for degenerate in (point, line, needle, edge_on, through_camera):
        renderer = Renderer(scene_of([coloured(degenerate, 1), wall, coloured(degenerate[::-1], 1)]), camera)
        np.testing.assert_array_equal(renderer.brightness(HERE), alone.brightness(HERE))
        np.testing.assert_array_equal(renderer.depth(HERE), alone.depth(HERE))


def test_triangles_behind_a_wall_are_not_seen_at_any_slant():
    """Thousands whose plane passes the camera within rounding."""
    rng = RNG(4)
    pose = pose_of(Rotation.from_quat(RNG(3).normal(size=4)), [3.0, -2, 1])
    wall = quad(moved(np.array([[-50, -50, 1], [50, -50, 1], [50, 50, 1], [-50, 50, 1.0]]), pose), 0.5 * WHITE)
    rays = rng.uniform(-1, 1, (3000, 2, 3)) * [1, 1, 0] + [0, 0, 1]
    edge_on = np.stack([1.5 * rays[:, 0], 4 * rays[:, 0] + 0.3 * rays[:, 1], 2 * rays[:, 1]], axis=1)
    renderer = Renderer(scene_of([wall, coloured(moved(edge_on, pose), 1)]), camera_of(80, 80, 40.0))
    np.testing.assert_allclose(renderer.brightness(pose), 0.5, rtol=1e-5)
    np.testing.assert_allclose(renderer.depth(pose), 1, rtol=1e-5)


@pytest.mark.parametrize("distance", [1e-2, 1e-4, 1e-6])
def test_a_wall_just_in_front_of_the_camera_is_seen(distance):
    renderer = Renderer(scene_of([quad([[-5, -5, 2], [5, -5, 2], [5, 5, 2], [-5, 5, 2]])]), camera_of(40, 30, 30.0))
    pose = pose_of(Rotation.identity(), [0, 0, 2 - distance])
    np.testing.assert_allclose(renderer.depth(pose), 2 - pose[2, 3], rtol=1e-6)
    np.testing.assert_allclose(renderer.brightness(pose), 1, rtol=1e-6)


def test_a_distortion_without_inverse_is_refused():
    with pytest.raises(ValueError, match="has no inverse at"):
        Renderer(plane(1.0, WHITE), Camera(64, 48, 30.0, 30.0, 31.5, 23.5, (-2.0, 0.0, 0.0, 0.0), "radtan"))


# Which of several surfaces is seen


@pytest.mark.parametrize("seed", range(3))
def test_the_nearest_surface_is_seen_whatever_the_order_of_the_triangles(seed):
    rng = RNG(seed)
    triangles, levels = soup(150, 10 + seed), rng.uniform(0.1, 1, 150)
    camera = Camera(61, 47, 25.0, 25.0, 28.1, 24.7)
    first = Renderer(scene_of([coloured(triangles, levels)], 0.05), camera)
    brightness, depth = first.brightness(HERE), first.depth(HERE)
    for _ in range(3):
        order = rng.permutation(150)
        turned = np.stack([np.roll(triangles[k], rng.integers(3), axis=0)[:: rng.choice([-1, 1])] for k in order])
        again = Renderer(scene_of([coloured(triangles[order], levels[order])], 0.05), camera)
        np.testing.assert_array_equal(again.depth(HERE), depth)
        np.testing.assert_array_equal(again.brightness(HERE), brightness)
        again = Renderer(scene_of([coloured(turned, levels[order])], 0.05), camera)
        np.testing.assert_allclose(again.depth(HERE), depth, rtol=1e-4)
        np.testing.assert_allclose(again.brightness(HERE), brightness, atol=0.07)  # one sample along an edge
        assert np.mean(np.abs(again.brightness(HERE) - brightness) > 1e-5) < 0.003


def test_planes_through_each_other_meet_where_the_closed_form_says():
    one, other = np.array([0.5, 0.1, 1]), np.array([-0.4, 0.2, 1])
    surfaces = [tilted_quad(one, 2.0, 20.0, 0.2 * WHITE), tilted_quad(other, 2.2, 20.0, 0.9 * WHITE)]
    camera = camera_of(100, 80, 90.0)
    renderer = Renderer(scene_of(surfaces), camera)
    rays = rays_of(camera)
    depths = np.stack([depth_of_plane(one, 2.0, rays), depth_of_plane(other, 2.2, rays)])
    np.testing.assert_allclose(renderer.depth(HERE), depths.min(0), rtol=1e-5)
    share = (renderer.brightness(HERE) - 0.2) / 0.7
    line = one / 2.0 - other / 2.2
    covered = coverage(camera, -line)
    np.testing.assert_allclose(share, covered, atol=2.3 / 16)
    assert abs((share - covered).mean()) < 1e-3


@pytest.mark.parametrize("name", ["pinhole", "TUM-VIE events"])
def test_no_ray_slips_between_the_triangles_of_a_sphere(name):
    camera, middle, seen_at = CAMERAS[name], np.array([5.0, 2, -1]), np.array([0.05, -0.02, 4.0])
    renderer = Renderer(scene_of([coloured(trimesh.creation.icosphere(5, 1.0).triangles + middle, 1)]), camera)
    rays = rays_of(camera)
    inside = np.linalg.norm(np.cross(rays, seen_at), axis=-1) / np.linalg.norm(rays, axis=-1) < 0.97
    assert inside.sum() > 5000
    for seed in range(4):
        rotation = Rotation.from_quat(RNG(seed).normal(size=4))
        pose = pose_of(rotation, middle - rotation.apply(seen_at))
        np.testing.assert_allclose(renderer.brightness(pose)[inside], 1, rtol=1e-6)
        assert (renderer.depth(pose)[inside] > 0).all()


@pytest.mark.parametrize("regular", [True, False], ids=["grid", "random"])
def test_no_ray_slips_between_the_triangles_of_a_plane(regular):
    """Nor where edges run exactly through samples. Of samples within rounding of a corner, one in thousands is lost."""
    if regular:
        points = np.stack(np.meshgrid(np.arange(-40, 41), np.arange(-40, 41)), axis=-1).reshape(-1, 2) / 16
    else:
        points = np.concatenate([RNG(0).uniform(-2.4, 2.4, (4000, 2)), [[-3, -3], [3, -3], [3, 3], [-3, 3]]])
    corners = np.column_stack([points, np.ones(len(points))])[Delaunay(points).simplices]
    camera = Camera(96, 80, 32.0, 32.0, 48.0, 40.0)
    turned = [pose_of(Rotation.from_quat(RNG(k).normal(size=4)), RNG(k).normal(size=3)) for k in range(4)]
    for pose in [HERE, *turned]:
        renderer = Renderer(scene_of([coloured(moved(corners, pose), 1)]), camera)
        np.testing.assert_allclose(renderer.brightness(pose), 1, rtol=1e-6)
        depth = renderer.depth(pose)
        assert (depth == 0).sum() <= (1 if regular and pose is not HERE else 0)
        np.testing.assert_allclose(depth[depth > 0], 1, rtol=1e-4)


# Edges


def coverage(camera: Camera, line: np.ndarray) -> np.ndarray:
    """Share [height, width] of each pixel's area where line . (x, y, 1) >= 0: the square, clipped at the line."""
    a, b = line[0] / camera.fx, line[1] / camera.fy
    c = line[2] - a * camera.cx - b * camera.cy
    shares = np.zeros((camera.height, camera.width))
    for row, column in np.ndindex(shares.shape):
        pixel = np.array([column, row])
        square = pixel + np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
        kept = []
        for start, end in zip(square, np.roll(square, -1, axis=0), strict=True):
            at_start, at_end = start @ [a, b] + c, end @ [a, b] + c
            if at_start >= 0:
                kept.append(start - pixel)
            if (at_start >= 0) != (at_end >= 0):
                kept.append(start + (end - start) * at_start / (at_start - at_end) - pixel)
        if kept:
            x, y = np.array(kept).T
            shares[row, column] = abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
    return shares


def half_plane(line: np.ndarray) -> Scene:
    """A scene that is white where line . (x, y, 1) >= 0, else black."""
    normal = line[:2] / np.hypot(*line[:2])
    start, along = -normal * line[2] / np.hypot(*line[:2]), 50 * np.array([-normal[1], normal[0]])
    corners = np.array([start - along, start + along, start + along + 50 * normal, start - along + 50 * normal])
    return scene_of([quad(np.column_stack([corners, np.ones(4)]))])


def test_a_pixel_on_an_edge_has_the_brightness_of_the_covered_area():
    """By 16 samples: upright and level edges are met to half a sample, and others to 2.3, the worst there is."""
    camera = camera_of(24, 20, 30.0)
    errors = []
    for angle in (0, 90, 180, 270, *np.arange(7.3, 360, 14.57)):
        offset = RNG(round(10 * angle)).uniform(-5, 5) / 30
        line = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), offset])
        covered = coverage(camera, line)
        error = Renderer(half_plane(line), camera).brightness(HERE) - covered
        partly = (covered > 1e-9) & (covered < 1 - 1e-9)
        assert np.abs(error[~partly]).max() < 1e-5
        assert np.abs(error).max() < (0.5 if angle % 90 == 0 else 2.3) / 16 + 1e-4
        if angle % 90:
            errors.append(error[partly])
    errors = np.concatenate(errors)
    assert len(errors) > 400
    assert abs(errors.mean()) < 0.003 and errors.std() < 0.05


def supersampled(scene: Scene, camera: Camera, pose: np.ndarray, times: int = 8) -> np.ndarray:
    """The mean over each pixel of a picture so many times as fine."""
    fine = Camera(
        *(times * camera.width, times * camera.height, times * camera.fx, times * camera.fy),
        *(times * (camera.cx + 0.5) - 0.5, times * (camera.cy + 0.5) - 0.5),
    )
    picture = Renderer(scene, fine).brightness(pose)
    return picture.reshape(camera.height, times, camera.width, times, -1).mean((1, 3)).squeeze(-1)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name == "moon" else ()) for name in SCENES]
)
def test_a_picture_is_the_mean_of_one_eight_times_as_fine(name):
    scene = SCENES[name](RNG(0)).grey()
    pose = pose_of(look_at(scene.camera, scene.target), scene.camera)
    camera = camera_of(64, 48, 55.0)
    found, expected = Renderer(scene, camera).brightness(pose), supersampled(scene, camera, pose)
    error = np.abs(found - expected)
    assert expected.std() > 0.05
    assert abs((found - expected).mean()) < 0.002
    assert error.mean() < 0.015 and np.quantile(error, 0.99) < 0.1


# Textures and shade


def test_a_linear_texture_is_seen_in_perspective():
    """Brightness is u all along a tilted plane, also where the texture is much finer than the pixels."""
    size = 256
    ramp = np.tile((np.arange(size) + 0.5) / size, (size, 1))
    normal = np.array([0.7, -0.4, 1])
    camera = camera_of(80, 60, 120.0)
    rays = rays_of(camera)
    points = rays * depth_of_plane(normal, 2.0, rays)[..., None]
    for extent in (4.0, 12.0):
        surface = tilted_quad(normal, 2.0, extent, ramp)
        start, right, *_ = surface.triangles[0]
        u = (points - start) @ (right - start) / extent**2
        assert u.min() > 0.05 and u.max() < 0.95 and np.ptp(u) > 0.15
        found = Renderer(scene_of([surface]), camera).brightness(HERE)
        np.testing.assert_allclose(found, u, atol=2e-4)


def test_a_magnified_texture_is_interpolated_bilinearly_and_repeats():
    image = RNG(0).uniform(0, 1, (8, 8))
    corners = np.array([[-3.0, -3, 2], [3, -3, 2], [3, 3, 2], [-3, 3, 2]])
    surface = quad(corners, image, corners[:, :2] / 2.3)
    camera = camera_of(120, 100, 80.0)
    fine = camera_of(120 * 8, 100 * 8, 80.0 * 8)
    places = 2 * rays_of(fine)[..., 1::-1] / 2.3 * 8 - 0.5
    expected = map_coordinates(image, places.transpose(2, 0, 1), order=1, mode="grid-wrap")
    expected = expected.reshape(100, 8, 120, 8).mean((1, 3))
    found = Renderer(scene_of([surface]), camera).brightness(HERE)
    np.testing.assert_allclose(found, expected, atol=0.01)
    assert np.abs(found - expected).mean() < 1e-3


def test_a_minified_texture_keeps_its_mean():
    checks = (np.indices((textures.SIZE, textures.SIZE)) // 2).sum(0) % 2
    renderer = Renderer(plane(1.5, checks), camera_of(WIDTH, HEIGHT, 24.0))
    np.testing.assert_allclose(renderer.brightness(HERE), 0.5, atol=0.01)


@pytest.mark.parametrize("slant", [0, 60])
def test_the_mean_of_a_texture_is_the_same_from_any_distance(slant):
    noise = RNG(0).uniform(0, 1, (256, 256))
    corners = 200 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    scene = scene_of([quad(corners, noise, corners[:, :2] / 2)])
    rotation = Rotation.from_euler("x", slant, degrees=True)
    for distance in (0.5, 2, 8, 25):
        picture = Renderer(scene, camera_of(80, 60, 90.0)).brightness(
            pose_of(rotation, rotation.apply([0, 0, -distance]))
        )
        np.testing.assert_allclose(picture.mean(), noise.mean(), atol=0.01 if distance > 1 else 0.02)
        if distance == 25:
            np.testing.assert_allclose(picture, noise.mean(), atol=0.12)


def test_a_texture_that_repeats_within_a_sample_is_its_mean():
    image = np.repeat([[0.0], [1.0]], 32, axis=0).repeat(64, axis=1)
    corners = 400 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    scene = scene_of([quad(corners, image, corners[:, :2])])
    pose = pose_of(Rotation.from_euler("z", 10, degrees=True), [0.1, 0.2, -90.0 * 3.2])
    np.testing.assert_allclose(Renderer(scene, camera_of(80, 60, 90.0)).brightness(pose), 0.5, atol=1e-6)


def test_brightness_has_no_jump_as_the_camera_moves_away():
    """From a level of the texture to the next it is a blend: a step half as long makes a change half as large."""
    image = (RNG(0).uniform(0, 1, (64, 64)) > 0.5).astype(float)
    row, column = np.argwhere(image == 1)[0]
    corners = 60 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    renderer = Renderer(scene_of([quad(corners, image, corners[:, :2])]), camera_of(3, 3, 60.0))

    def largest_change(steps: int) -> float:
        poses = [
            pose_of(Rotation.identity(), [(column + 0.5) / 64, (row + 0.5) / 64, -distance])
            for distance in np.geomspace(0.1, 15, steps + 1)
        ]
        middle = np.array([renderer.brightness(pose)[1, 1] for pose in poses])
        assert middle[0] > 0.9 and middle.min() < 0.6
        return np.abs(np.diff(middle)).max()

    coarse, fine = largest_change(1000), largest_change(4000)
    assert coarse < 0.003 and fine < 0.4 * coarse


def test_shade_is_interpolated_between_the_corners_in_space():
    rng = RNG(1)
    corners = np.array([[-4.0, -3, 2], [5, -2, 6], [0.5, 6, 9]])
    shade = rng.uniform(0, 3, (3, 3))
    surface = Surface(corners[None], np.zeros((1, 3, 2)), shade[None], np.ones((1, 1, 1)))
    scene = scene_of([replace(surface, triangles=moved(surface.triangles, POSE))])
    camera = camera_of(90, 70, 60.0)
    rays = rays_of(camera)
    weights = rays @ np.linalg.inv(corners)
    inside = (weights > 0.02).all(-1)
    weights /= weights.sum(-1, keepdims=True)
    assert inside.sum() > 500
    found = Renderer(scene, camera).brightness(POSE)
    assert found.shape == (70, 90, 3)
    np.testing.assert_allclose(found[inside], (weights @ shade)[inside], atol=2e-3)


def test_three_channels_are_three_grey_pictures():
    rng = RNG(3)
    image, triangles = rng.uniform(0, 1, (32, 32, 3)), soup(60, 3) + np.array([0, 0, 1])
    uv, shade = rng.uniform(0, 3, (60, 3, 2)), rng.uniform(0, 1, (60, 3, 3))
    camera = camera_of(50, 40, 30.0)
    scene = scene_of([Surface(triangles, uv, shade, image)], 0.2)
    colour = Renderer(scene, camera)
    for channel in range(3):
        part = slice(channel, channel + 1)
        grey = Renderer(replace(scene, shade=scene.shade[..., part], texels=scene.texels[:, part]), camera)
        np.testing.assert_array_equal(colour.brightness(HERE)[..., channel], grey.brightness(HERE))
        np.testing.assert_array_equal(colour.depth(HERE), grey.depth(HERE))


# Sizes and scales


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (5, 3), (1000, 2)])
def test_pictures_of_any_size_are_cut_from_larger_ones(size):
    width, height = size
    scene = SCENES["carpet"](RNG(0))
    pose = pose_of(look_at(scene.camera, scene.target), scene.camera)
    small = Camera(width, height, 300.0, 300.0, width / 3, 1.2)
    large = replace(small, width=width + 21, height=height + 18, cx=small.cx + 10, cy=small.cy + 7)
    cut = np.s_[7 : 7 + height, 10 : 10 + width]
    for name in ("depth", "brightness"):
        found, expected = (getattr(Renderer(scene, camera), name)(pose) for camera in (small, large))
        assert found.shape == (height, width) and found.dtype == np.float32
        np.testing.assert_allclose(found, expected[cut], atol=1e-4)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_larger_and_smaller_scenes_look_the_same(scale):
    scene = SCENES["shapes"](RNG(0))
    pose = pose_of(look_at(scene.camera, scene.target), scene.camera + 0.05)
    camera = camera_of(64, 48, 55.0)
    scaled = replace(
        scene,
        triangles=(scene.triangles.astype(float) * scale).astype(np.float32),
        texels_per_metre=scene.texels_per_metre / np.float32(scale),
    )
    scaled_pose = np.column_stack([pose[:, :3], pose[:, 3] * scale])
    one, other = Renderer(scene, camera), Renderer(scaled, camera)
    ratio = other.depth(scaled_pose) / one.depth(pose)
    assert np.mean(np.abs(ratio / scale - 1) > 1e-4) < 0.001  # of a ray along an edge
    difference = np.abs(other.brightness(scaled_pose) - one.brightness(pose))
    assert np.mean(difference > 1e-3) < 0.005 and difference.max() < 0.13


@pytest.mark.parametrize("name", ["pinhole", "EDS frames"])
def test_far_from_the_origin_only_the_corners_are_rounded(name):
    """At 1e4 m the corners of triangles are multiples of 1/1024 m. Where they already were, nothing is lost."""
    corners = np.array([[-3.0, -3, 2], [3, -3, 4.5], [3, 3, 5.25], [-3, 3, 2.75]])
    camera, away, beside = CAMERAS[name], np.array([8193.0, -8704, 10_000]), np.array([0.1, 0.2, -0.3]) / 3
    near, far = (Renderer(scene_of([quad(corners + origin)]), camera) for origin in (np.zeros(3), away))
    here, there = (pose_of(Rotation.identity(), origin + beside) for origin in (np.zeros(3), away))
    np.testing.assert_allclose(far.depth(there), near.depth(here), rtol=1e-6)
    np.testing.assert_allclose(far.brightness(there), near.brightness(here), rtol=1e-6)

    normal = np.array([0.3, -0.2, 1])
    surface = tilted_quad(normal, 2.0, 20.0)
    far = Renderer(scene_of([replace(surface, triangles=surface.triangles + away)]), camera)
    expected = depth_of_plane(normal, 2.0 - float(normal @ beside), rays_of(camera))
    np.testing.assert_allclose(far.depth(there), expected, atol=2e-3)


# Some of the pixels alone


@pytest.mark.parametrize("size", [(1, 1), (5, 3), (18, 35), (64, 48)])
@pytest.mark.parametrize("colour", [False, True], ids=["grey", "colour"])
def test_some_pixels_alone_are_as_in_the_picture(size, colour):
    rng = RNG(0)
    width, height = size
    channels = 3 if colour else 1
    image, triangles = rng.uniform(0, 1, (32, 32, channels)), soup(60, 3) + np.array([0, 0, 1])
    scene = scene_of([Surface(triangles, rng.uniform(0, 3, (60, 3, 2)), np.ones((60, 3, 1)), image)], 0.2)
    renderer = Renderer(scene, camera_of(width, height, 0.6 * width))
    picture = renderer.brightness(HERE).reshape(width * height, *([3] if colour else []))
    count = len(picture)
    subsets = [np.arange(count), np.arange(count)[::-1], np.arange(0), np.array([0, 0]), np.array([count - 1])]
    subsets += [np.arange(width - 1, count, width), np.arange(count - width, count)]
    subsets += [rng.permutation(count)[: max(1, round(share * count))] for share in (0.01, 0.1, 0.5, 0.9)]
    for pixels in subsets:
        found = renderer.brightness(HERE, pixels)
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, picture[pixels])


# Threads and processes


def test_pictures_from_several_threads_are_those_from_one():
    scene = SCENES["shapes"](RNG(0))
    renderer = Renderer(scene, camera_of(100, 80, 80.0))
    trajectory = MOTIONS["shake"](10**9, scene.camera, scene.target, RNG(1))
    poses = trajectory.poses(torch.linspace(0, 1e9, 24).long()).numpy()
    with ThreadPoolExecutor(4) as pool:
        pictures, depths = list(pool.map(renderer.brightness, poses)), list(pool.map(renderer.depth, poses))
    for pose, picture, depth in zip(poses, pictures, depths, strict=True):
        np.testing.assert_array_equal(picture, renderer.brightness(pose))
        np.testing.assert_array_equal(depth, renderer.depth(pose))


PICTURE = """
import hashlib, numpy as np
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.simulator.scene.render import Renderer
from enerf_ns.simulator.scene.scenes import SCENES
renderer = Renderer(SCENES["carpet"](np.random.default_rng(0)), Camera(64, 48, 55.0, 55.0, 31.5, 23.5))
pose = np.array([[1.0, 0, 0, 0], [0, -0.6, 0.8, -0.75], [0, -0.8, -0.6, 1.3]])
print(hashlib.sha256(renderer.brightness(pose).tobytes() + renderer.depth(pose).tobytes()).hexdigest())
"""


def start(folder: Path, **environment: str) -> subprocess.Popen[str]:
    """Renders the same picture in a new process, which prints what tells it from others."""
    return subprocess.Popen(
        [sys.executable, "-c", PICTURE],
        cwd=folder,
        env={**os.environ, **environment},
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def printed(process: subprocess.Popen[str]) -> str:
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    return out.strip()


@pytest.mark.exhaustive
def test_other_processes_render_the_same_whatever_is_compiled_already(tmp_path):
    expected, fresh = printed(start(tmp_path)), str(tmp_path / "fresh")
    two_at_once = [start(tmp_path, NUMBA_CACHE_DIR=fresh) for _ in range(2)]
    assert [printed(process) for process in two_at_once] == [expected, expected]
    assert list((tmp_path / "fresh").rglob("render.*.nbc"))
    assert printed(start(tmp_path, NUMBA_CACHE_DIR=fresh)) == expected


@pytest.mark.slow
def test_a_process_that_can_write_no_compiled_code_renders_the_same(tmp_path):
    """Neither to Numba's folder, nor beside the modules, nor to the user's: files stand where folders should."""
    package = tmp_path / "site" / "enerf_ns"
    without_compiled = shutil.ignore_patterns("__pycache__")
    shutil.copytree(Path(enerf_ns.__file__).parent, package, ignore=without_compiled)
    shutil.copytree(
        Path(enerf_ns.dataparsers.__path__[0]), package / "dataparsers", ignore=without_compiled, dirs_exist_ok=True
    )
    for folder in [package, *(path for path in package.rglob("*") if path.is_dir())]:
        (folder / "__pycache__").touch()
    (tmp_path / "file").touch()
    nowhere = str(tmp_path / "file" / "below")
    environment = {name: nowhere for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME")}
    process = start(tmp_path, PYTHONPATH=str(package.parent), PYTHONDONTWRITEBYTECODE="1", **environment)
    assert printed(process) == printed(start(tmp_path))
