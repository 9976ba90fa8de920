"""Cameras that are inside of something or see nothing are found, and no others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import ArrayLike

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.simulator.scene import textures
from enerf_ns.simulator.scene.render import Renderer
from enerf_ns.simulator.scene.scenes import SCENES, Scene, Surface, build_scene
from enerf_ns.simulator.scene.view_check import check_view, winding_number
from enerf_ns.simulator.sources import RenderedScene
from enerf_ns.simulator.trajectories import MOTIONS, look_at

END = 200_000_000
"""ns"""


def scene_of(*meshes: trimesh.Trimesh) -> Scene:
    image = textures.plain()[..., None]
    surfaces = [
        Surface(np.asarray(m.triangles), np.zeros((len(m.faces), 3, 2)), np.ones((len(m.faces), 3, 1)), image)
        for m in meshes
    ]
    return build_scene(surfaces, (0, 0, 0), (0, 1, 0))


def box(size: ArrayLike, centre: ArrayLike, inwards: bool = False) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(size)
    mesh.apply_translation(centre)
    if inwards:
        mesh.invert()
    mesh.unmerge_vertices()
    return mesh


def line(start: ArrayLike, end: ArrayLike, towards: ArrayLike = (0, 1, 0)) -> Trajectory:
    """A straight way with even speed, looking in one direction."""
    quaternion = look_at(np.zeros(3), np.array(towards, float)).as_quat()
    return Trajectory(np.array([0, END]), np.array([start, end], float), np.tile(quaternion, (2, 1)))


def check(scene: Scene, trajectory: Trajectory, **camera: Any) -> list[str]:
    lens = Camera(**{"width": 40, "height": 30, "fx": 40.0, "fy": 40.0, "cx": 19.5, "cy": 14.5, **camera})
    notes: list[str] = []
    check_view("it", "the camera", RenderedScene(Renderer(scene, lens), trajectory), 0, END, notes)
    return notes


def test_winding_number_is_one_inside_zero_outside_and_a_half_in_the_middle_of_half_a_ball():
    ball = trimesh.creation.icosphere(3)
    rng = np.random.default_rng(0)
    for radius, expected in ((0.9, 1), (1.1, 0)):
        for point in rng.normal(size=(20, 3)):
            point *= radius / np.linalg.norm(point)
            assert winding_number(ball.triangles, point) == pytest.approx(expected, abs=1e-9)
            assert winding_number(ball.triangles[:, ::-1], point) == pytest.approx(-expected, abs=1e-9)
    corner = np.array([[[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]])
    assert winding_number(corner, np.zeros(3)) == pytest.approx(1 / 8)


def test_a_camera_in_a_room_between_solids_is_outside():
    scene = scene_of(box([6, 6, 6], [0, 0, 0], inwards=True), box([1, 1, 1], [0, 2, 0]))
    assert check(scene, line([-1, 0, 0], [1, 0, 0])) == []


def test_a_camera_in_a_solid_in_a_room_is_inside():
    """At this place the winding number of all surfaces together is 0."""
    scene = scene_of(box([6, 6, 6], [0, 0, 0], inwards=True), box([1, 1, 1], [0, 2, 0]))
    with pytest.raises(RecordingError, match=r"^it: 0\.\d+ s after the beginning the camera is at .* looks outwards"):
        check(scene, line([0, 0, 0], [0, 2, 0]))


def test_a_thin_wall_that_is_passed_through_between_two_frames_is_found_at_its_time():
    scene = scene_of(box([6, 6, 6], [0, 0, 0], inwards=True), box([2, 1e-4, 2], [0, 1, 0]))
    with pytest.raises(RecordingError, match=r"0\.100 s after the beginning .* \(0\.123, 1, 0\.2\) m, inside"):
        check(scene, line([0.123, 0, 0.2], [0.123, 2, 0.2]))


def test_passing_through_an_open_surface_is_allowed():
    plane = trimesh.Trimesh([[-1, 1, -1], [1, 1, -1], [1, 1, 1], [-1, 1, 1]], [[0, 1, 2], [0, 2, 3]], process=False)
    for mesh in (plane, trimesh.Trimesh(plane.vertices, plane.faces[:, ::-1], process=False)):
        scene = scene_of(box([6, 6, 6], [0, 0, 0], inwards=True), mesh)
        for x in (0, 0.3):
            check(scene, line([x, 0, 0], [x, 2, 0]))


@pytest.mark.parametrize("way", [([0, 0, 0.2], [0, 6, 0.2]), ([0, 6, 0.2], [0, 0, 0.2])])
def test_a_camera_that_leaves_or_enters_a_room_through_its_wall_is_refused(way):
    with pytest.raises(RecordingError, match=r"^it: 0\.100 s after .* passes through a wall, at \(0, 3"):
        check(scene_of(box([6, 6, 6], [0, 0, 0], inwards=True)), line(*way))


def test_a_room_whose_faces_look_outwards_is_refused_with_what_to_do():
    with pytest.raises(RecordingError, match="if that is a room, turn its faces to look inwards"):
        check(scene_of(box([6, 6, 6], [0, 0, 0])), line([-1, 0, 0], [1, 0, 0]))


@pytest.mark.sweep(3)
@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("scene", SCENES)
def test_the_own_motions_are_fine_in_the_own_scenes(scene: str, motion: str):
    made = SCENES[scene](np.random.default_rng(0))
    trajectory = MOTIONS[motion](END, made.camera, made.target, np.random.default_rng(1))
    assert check(made, trajectory) == []


def test_a_camera_that_never_sees_anything_is_refused():
    scene = scene_of(box([1, 1, 1], [0, 3, 0]))
    with pytest.raises(
        RecordingError, match=r"never sees anything, .* \(-0\.5, 2\.5, -0\.5\) and \(0\.5, 3\.5, 0\.5\)"
    ):
        check(scene, line([0, 0, 0], [1, 0, 0], towards=(0, -1, 0)))


def test_a_camera_that_sees_nothing_at_times_is_noted_with_these():
    """The far right edge of the box is the last that leaves the picture, at its left side."""
    scene = scene_of(box([1, 1, 1], [0, 3, 0]))
    notes = check(scene, line([0, 0, 0], [6, 0, 0]), fx=20.0, fy=20.0)
    assert len(notes) == 1
    gone = (3.5 * 19.5 / 20 + 0.5) / 6 * 0.2
    start = float(notes[0].split(" first ")[1].split()[0])
    assert start == pytest.approx(gone, abs=0.2 / 50)


def test_a_single_pixel_that_sees_something_is_enough():
    scene = scene_of(box([0.06, 0.06, 0.06], [0.05, 2, 0.05]))
    assert check(scene, line([0, 0, 0], [1e-3, 0, 0])) == []
