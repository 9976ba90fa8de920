from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.recording.camera import Camera, CameraModel, check_rotation

PINHOLE = Camera(12, 10, 20.0, 21.0, 6.0, 4.5)
RADTAN = Camera(
    240, 180, 335.419462958, 335.352935612, 129.924663379, 99.1864303447,
    (-0.138592767408, 0.0933736664192, -0.000335586987532, 0.000173720158228, 0.0), "radtan",
)  # fmt: skip
FISHEYE = Camera(
    1280, 720, 1049.5831, 1049.4230, 634.7184, 263.4697, (-0.1151966, -0.0622218, 0.2168261, -0.2352862), "fisheye"
)
"""Real calibrations: slider_depth's DAVIS240C, and TUM-VIE's left event camera."""


def project(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Pixels [N, 2] of points [N, 3], by OpenCV."""
    no_motion, coefficients = np.zeros(3), np.array(camera.distortion)
    if camera.model == "fisheye":
        return cv2.fisheye.projectPoints(points[:, None], no_motion, no_motion, camera.matrix, coefficients)[0][:, 0]
    return cv2.projectPoints(points, no_motion, no_motion, camera.matrix, coefficients)[0][:, 0]


@pytest.mark.parametrize("camera", [PINHOLE, RADTAN, FISHEYE], ids=lambda camera: camera.model)
def test_directions_project_back_to_their_pixels(camera: Camera):
    directions = camera.pixel_directions()
    assert directions.shape == (camera.height, camera.width, 3)
    np.testing.assert_array_equal(directions[..., 2], 1.0)
    y, x = np.mgrid[: camera.height, : camera.width]
    pixels = project(camera, directions.reshape(-1, 3)).reshape(camera.height, camera.width, 2)
    np.testing.assert_allclose(pixels, np.stack([x, y], axis=-1), atol=1e-6)


def test_pinhole_directions_are_the_closed_form():
    np.testing.assert_allclose(PINHOLE.pixel_directions()[2, 9], [(9 - 6.0) / 20.0, (2 - 4.5) / 21.0, 1.0])


def test_pixel_directions_may_be_changed_by_the_caller():
    first = PINHOLE.pixel_directions()
    first[:] = 0.0
    assert PINHOLE.pixel_directions()[..., 2].min() == 1.0


def test_a_distortion_without_inverse_is_refused():
    with pytest.raises(
        ValueError, match=r"radtan distortion .* fits no lens, since it has no inverse at [\d,]+ of 208 pixels tried"
    ):
        Camera(240, 180, 100.0, 100.0, 120.0, 90.0, (-0.6, 0.2, 0.0, 0.0), "radtan")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(width=0), "a camera of 0 x 180 pixels, but whole numbers from 1 to 65535"),
        (dict(height=179.5), "a camera of 240 x 179.5 pixels, but whole"),
        (dict(height=float("nan")), "a camera of 240 x nan pixels"),
        (dict(width=2**16), "a camera of 65536 x 180 pixels"),
        (dict(fx=0.0), "the focal lengths 0 and 335.353, but they must be above 0"),
        (dict(fy=float("nan")), "the focal lengths 335.419 and nan"),
        (dict(fx=1e9), "which fits no lens; state all in pixels"),
        (dict(fx=3353.0, fy=33.5), "focal lengths 3353 and 33.5 .* which fits no lens"),
        (dict(cx=float("inf")), "which fits no lens; state all in pixels"),
        (dict(distortion=(0.1, 0.2, 0.3)), "of the model radtan, but finite numbers k1 k2 p1 p2 and perhaps k3"),
        (dict(distortion=(0.1, 0.2, 0.3, float("nan"))), "of the model radtan, but finite numbers"),
        (dict(model="fisheye"), "of the model fisheye, but finite numbers k1 k2 k3 k4"),
        (dict(model="pinhole"), "of the model pinhole, but no coefficients"),
        (dict(model="lookup", distortion=()), "without a table of directions of its pixels"),
        (dict(model="lookup", distortion=(), directions=np.zeros((240, 180, 2))), r"of shape \(240, 180, 2\), but"),
        (dict(model="lookup", distortion=(), directions=np.full((180, 240, 2), np.nan)), "but finite numbers"),
        (
            dict(model="lookup", distortion=(), directions=np.full((180, 240, 2), 1e5)),
            "reach 100000, which fits",
        ),
    ],
)
def test_what_is_no_camera_is_refused_where_it_is_made(changes: dict, message: str):
    with pytest.raises(ValueError, match=message) as error:
        replace(RADTAN, **changes)
    assert "\n" not in str(error.value)


def test_a_whole_number_of_pixels_becomes_an_integer():
    camera = replace(PINHOLE, width=12.0, height=np.float64(10))
    assert (camera.width, camera.height) == (12, 10) and camera == PINHOLE
    assert type(camera.width) is type(camera.height) is int


def test_a_fold_between_the_pixels_that_are_tried_is_found_when_all_are_asked_for(monkeypatch: pytest.MonkeyPatch):
    """With a step larger than the image, the corners alone are tried; of this lens, they see twice what others do."""
    monkeypatch.setattr("enerf_ns.dataparsers.recording.camera.CHECKED_STEP", 10**6)
    camera = Camera(101, 101, 50.0, 50.0, 50.0, 50.0, (-1.0, 0.5, 0.0, 0.0), "radtan")
    with pytest.raises(ValueError, match=r"has no inverse at [\d,]+ of 10,201 pixels"):
        camera.pixel_directions()


def test_undistorted_camera_of_a_fisheye_has_the_published_intrinsics():
    undistorted = FISHEYE.undistorted()
    found = [undistorted.fx, undistorted.fy, undistorted.cx, undistorted.cy]
    # E-NeRF's code states these for the same calibration
    np.testing.assert_allclose(found, [982.706, 982.556, 632.791, 250.455], atol=0.06)
    assert undistorted.model == "pinhole" and undistorted.distortion == ()


@pytest.mark.parametrize("camera", [RADTAN, FISHEYE], ids=lambda camera: camera.model)
def test_undistorted_image_shows_each_direction_where_the_pinhole_camera_sees_it(camera: Camera):
    """The distorted image holds x and y of the undistorted pixel of each direction, so undistorting gives a ramp."""
    undistorted = camera.undistorted()
    expected = camera.pixel_directions() @ undistorted.matrix.T
    ramp = camera.undistort(expected[..., :2].astype(np.float32))
    y, x = np.mgrid[: camera.height, : camera.width]
    inner = (slice(6, -6), slice(6, -6))
    np.testing.assert_allclose(ramp[inner], np.stack([x, y], axis=-1)[inner], atol=0.05)


def test_undistort_keeps_type_and_channels_and_leaves_pinhole_images_alone():
    for channels in (1, 3):
        image = np.full((180, 240, channels), 7, np.uint8)
        undistorted = RADTAN.undistort(image)
        assert undistorted.dtype == np.uint8 and undistorted.shape == image.shape
        assert (undistorted[10:-10, 10:-10] == 7).all()
    image = np.random.default_rng(0).integers(0, 256, (10, 12, 3), dtype=np.uint8)
    np.testing.assert_array_equal(PINHOLE.undistort(image), image)
    assert PINHOLE.undistorted() == PINHOLE


def lookup_of(camera: Camera) -> Camera:
    """The camera as a table of directions, as the reference code prepares recordings: a rectify map and its matrix."""
    rectified = camera.undistorted()
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).reshape(-1, 1, 2)
    if camera.model == "fisheye":
        undistort = cv2.fisheye.undistortPoints
    else:
        undistort = cv2.undistortPoints
    rectify_map = undistort(
        pixels.astype(np.float64), camera.matrix, np.array(camera.distortion), R=np.eye(3), P=rectified.matrix
    ).reshape(camera.height, camera.width, 2)
    directions = (rectify_map - [rectified.cx, rectified.cy]) / [rectified.fx, rectified.fy]
    return replace(rectified, model="lookup", directions=directions)


@pytest.mark.parametrize(
    "camera",
    [
        Camera(120, 90, 95.0, 96.0, 58.0, 46.0, (-0.14, 0.09, -0.0003, 0.0002), "radtan"),
        Camera(120, 90, 95.0, 96.0, 58.0, 46.0, (-0.115, -0.062, 0.217, -0.235), "fisheye"),
    ],
    ids=["radtan", "fisheye"],
)
def test_a_table_of_directions_is_as_good_as_the_distortion(camera: Camera):
    lookup = lookup_of(camera)
    assert lookup.undistorted() == camera.undistorted()
    np.testing.assert_allclose(lookup.pixel_directions(), camera.pixel_directions(), atol=1e-4)
    rows, columns = np.mgrid[: camera.height, : camera.width]
    smooth = np.stack([127 + 100 * np.sin(columns / 9.0), 127 + 100 * np.cos(rows / 7.0)], axis=-1)
    expected, found = camera.undistort(smooth.astype(np.float32)), lookup.undistort(smooth.astype(np.float32))
    assert np.abs(found - expected)[2:-2, 2:-2].max() < 1.0


@pytest.mark.parametrize("camera", [RADTAN, FISHEYE])
def test_a_depth_map_without_distortion_holds_the_depth_of_each_direction(camera: Camera):
    """Of a slanted plane, to less than it changes within a pixel; of a lens and of a table of its directions."""
    normal = np.array([0.3, -0.2, 1.0])
    depth = (2.0 / (camera.pixel_directions() @ normal)).astype(np.float32)
    expected = 2.0 / (camera.undistorted().pixel_directions() @ normal)
    for one in (camera, lookup_of(camera)):
        found = one.undistort_depth(depth)
        inside = found[2:-2, 2:-2]
        assert np.abs(inside / expected[2:-2, 2:-2] - 1).max() < 0.005
    pinhole = camera.undistorted()
    assert pinhole.undistort_depth(depth) is depth


def test_a_rotation_neither_stretches_nor_mirrors():
    turned = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    check_rotation(turned)
    for wrong in (1.01 * turned, turned @ np.diag([1.0, 1.0, -1.0]), np.zeros((3, 3)), np.full((3, 3), np.nan)):
        with pytest.raises(ValueError, match="is no rotation"):
            check_rotation(wrong)


@pytest.mark.parametrize("model", ["fisheye", "radtan"])
def test_a_distortion_that_leaves_no_picture_is_refused(model: CameraModel):
    """Found by damaged files: each pixel has a direction, but no picture without distortion fits into them."""
    with pytest.raises(ValueError, match="distortion"):
        Camera(1280, 720, 1050.0, 1049.0, 640.0, 260.0, (2.0**31, -0.05, 0.2, -0.2), model)
