"""Camera models: the direction of each pixel, and images without lens distortion."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int, Shaped

ROUND_TRIP_TOLERANCE = 1e-6
"""Largest distance between a pixel and the projection of its direction, pixels."""

SHORTEST_FOCAL_LENGTH, LONGEST_FOCAL_LENGTH = 0.01, 1e4
"""Shortest and longest focal length, as a multiple of the width or height: views of 179 and of 0.006 degrees."""

MOST_STRETCHED = 4
"""Largest ratio of the two focal lengths. Anamorphic lenses stretch an image up to twofold, and so do sensors whose
pixels are not square."""

FARTHEST_PRINCIPAL_POINT = 10
"""Largest distance of the principal point from the middle of the image, as a multiple of the width or height."""

STEEPEST_DIRECTION = 1e4
"""Largest x / z and y / z of the direction of a pixel."""

ROTATION_TOLERANCE = 1e-3
"""Largest entry of the difference between R times its transpose and the identity, for a rotation R."""

LARGEST_SIDE = 2**16 - 1
"""Largest width or height of a camera, pixels. Larger coordinates do not fit the types of stored events."""

MOST_PIXELS = 2**26
"""Largest number of pixels of a camera: more than ten times those of any event camera."""

COEFFICIENTS = {
    "pinhole": ((0,), "no coefficients"),
    "radtan": ((4, 5), "finite numbers k1 k2 p1 p2 and perhaps k3"),
    "fisheye": ((4,), "finite numbers k1 k2 k3 k4"),
    "lookup": ((0,), "no coefficients"),
}
"""Possible numbers of distortion coefficients of each model, and the coefficients in words."""

CHECKED_STEP = 16
"""Step between the pixels at which the constructor checks that the distortion has an inverse. It checks all corners."""

INVERSION_STEPS = 60
"""Iterations that invert a table of directions. Each halves the error of an even table. They converge if the table is
stretched up to fourfold."""


CameraModel = Literal["pinhole", "radtan", "fisheye", "lookup"]


@dataclass(frozen=True)
class Camera:
    """A calibrated camera, in OpenCV's conventions: integer pixel indices are pixel centres.

    Raises:
        ValueError: The size is not in whole pixels, a focal length is not above 0, the number of finite distortion
            coefficients does not fit the model, or the camera fits no lens. The message can follow "FILE holds".
    """

    width: int
    """Width of the image, pixels."""
    height: int
    """Height of the image, pixels."""
    fx: float
    """Horizontal focal length in pixels; `fy` is the vertical one."""
    fy: float
    cx: float
    """Column of the principal point in pixels; `cy` is its row."""
    cy: float
    distortion: tuple[float, ...] = ()
    """Coefficients of the distortion. radtan: k1, k2, p1, p2 and, if given, k3 (Brown-Conrady); fisheye: k1 to k4
    (Kannala-Brandt)."""
    model: CameraModel = "pinhole"
    directions: Float64[np.ndarray, "height width 2"] | None = field(default=None, compare=False)
    """For the model lookup: x / z and y / z of the direction of each pixel. Then fx, fy, cx and cy are the intrinsics
    of the undistorted camera."""

    def __post_init__(self) -> None:
        if not all(0 < side <= LARGEST_SIDE and side == int(side) for side in (self.width, self.height)):
            raise ValueError(
                f"a camera of {self.width:g} x {self.height:g} pixels, but whole numbers from 1 to {LARGEST_SIDE} were "
                "expected."
            )
        if self.width * self.height > MOST_PIXELS:
            raise ValueError(
                f"a camera of {self.width:g} x {self.height:g} pixels, but at most {MOST_PIXELS:,} were expected."
            )
        for name in ("width", "height"):
            object.__setattr__(self, name, int(getattr(self, name)))
        if not (self.fx > 0 and self.fy > 0):
            raise ValueError(f"the focal lengths {self.fx:g} and {self.fy:g}, but they must be above 0 (pixels).")
        counts, expected = COEFFICIENTS[self.model]
        if len(self.distortion) not in counts or not np.isfinite(self.distortion).all():
            raise ValueError(
                f"the distortion {self.distortion} of the model {self.model}, but {expected} were expected."
            )
        axes = ((self.width, self.fx, self.cx), (self.height, self.fy, self.cy))
        fits = all(
            SHORTEST_FOCAL_LENGTH * side < focal_length < LONGEST_FOCAL_LENGTH * side
            and abs(principal_point - side / 2) < FARTHEST_PRINCIPAL_POINT * side
            for side, focal_length, principal_point in axes
        )
        if not fits or max(self.fx, self.fy) > MOST_STRETCHED * min(self.fx, self.fy):
            raise ValueError(
                f"a camera of {self.width} x {self.height} pixels with the focal lengths {self.fx:g} and {self.fy:g} "
                f"and the principal point ({self.cx:g}, {self.cy:g}), which fits no lens; state all in pixels."
            )
        if self.model == "lookup":
            self._check_directions()
        else:
            columns, rows = (
                np.union1d(np.arange(0, side, CHECKED_STEP), side - 1) for side in (self.width, self.height)
            )
            self._directions_at(*np.meshgrid(columns, rows))
            try:
                self.undistorted()
            except ValueError as error:
                raise ValueError(
                    f"the distortion {self.distortion} of the model {self.model}, which leaves no picture without "
                    "distortion; check the coefficients."
                ) from error

    @property
    def matrix(self) -> Float64[np.ndarray, "3 3"]:
        """The intrinsic matrix, which projects camera coordinates with z = 1 to pixels without distortion."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def pixel_directions(self) -> Float64[np.ndarray, "height width 3"]:
        """Returns the direction of each pixel's centre: camera axes (x right, y down, z forward), with z = 1.

        Raises:
            ValueError: The distortion has no inverse at some pixel, so the calibration is wrong. The message can follow
                "FILE holds".
        """
        return self._pixel_directions.copy()

    def pixel_steps(self) -> tuple[Float64[np.ndarray, "height width 2"], Float64[np.ndarray, "height width 2"]]:
        """Returns the change of `pixel_directions` (x, y) from each column to the next, and from each row to the next.

        The method uses central differences, which are exact for a camera without distortion.
        """
        directions = self._pixel_directions[..., :2]

        def step(axis: int, of_one: tuple[float, float]) -> np.ndarray:
            count = directions.shape[axis]
            if count == 1:
                return np.full_like(directions, of_one)
            return np.gradient(directions, axis=axis, edge_order=2 if count > 2 else 1)

        return step(1, (1 / self.fx, 0)), step(0, (0, 1 / self.fy))

    @cached_property
    def _pixel_directions(self) -> np.ndarray:
        if self.directions is not None:
            return np.dstack([self.directions, np.ones((self.height, self.width))])
        return self._directions_at(*np.meshgrid(np.arange(self.width), np.arange(self.height)))

    def _check_directions(self) -> None:
        if self.directions is None:
            raise ValueError("a camera of the model lookup without a table of directions of its pixels; give one.")
        shape = (self.height, self.width, 2)
        if self.directions.shape != shape or not np.isfinite(self.directions).all():
            raise ValueError(
                f"a table of directions of pixels of shape {self.directions.shape}, but finite numbers of shape "
                f"(height, width, 2) = {shape} were expected."
            )
        if not np.abs(self.directions).max() < STEEPEST_DIRECTION:
            raise ValueError(
                f"a table of directions of pixels, in which x / z and y / z reach "
                f"{np.abs(self.directions).max():g}, which fits no lens; make it again."
            )

    def _directions_at(
        self, columns: Int[np.ndarray, "rows columns"], rows: Int[np.ndarray, "rows columns"]
    ) -> Float64[np.ndarray, "rows columns 3"]:
        """Returns the directions of some pixels; raises ValueError if the distortion has no inverse there."""
        pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2).astype(float)
        coefficients = np.array(self.distortion)
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-9)
        if self.model == "fisheye":
            points = cv2.fisheye.undistortPoints(pixels, self.matrix, coefficients, criteria=criteria)
        elif self.model == "radtan":
            points = cv2.undistortPointsIter(pixels, self.matrix, coefficients, np.eye(3), np.eye(3), criteria)
        else:
            points = (pixels - [self.cx, self.cy]) / [self.fx, self.fy]
        directions = np.concatenate([points, np.ones_like(points[..., :1])], axis=-1)
        if self.model == "fisheye":
            projected = cv2.fisheye.distortPoints(points, self.matrix, coefficients)
        else:
            projected = cv2.projectPoints(directions, np.zeros(3), np.zeros(3), self.matrix, coefficients)[0]
        wrong = ~(np.linalg.norm(projected - pixels, axis=-1) <= ROUND_TRIP_TOLERANCE)
        if wrong.any():
            raise ValueError(
                f"the {self.model} distortion {self.distortion}, which fits no lens, since it has no inverse at "
                f"{wrong.sum():,} of {wrong.size:,} pixels tried; calibrate again."
            )
        return directions.reshape(*columns.shape, 3)

    def without_lens(self) -> Camera:
        """Returns the pinhole camera with the same focal lengths and principal point."""
        return Camera(self.width, self.height, self.fx, self.fy, self.cx, self.cy)

    @property
    def has_sides_swapped(self) -> bool:
        """Whether the principal point is closer to the middle of a picture of height x width than of width x height."""
        middle = (self.width - 1) / 2, (self.height - 1) / 2
        away = math.hypot(self.cx - middle[0], self.cy - middle[1])
        return math.hypot(self.cx - middle[1], self.cy - middle[0]) < away

    def undistorted(self) -> Camera:
        """Returns the pinhole camera of the same size whose image holds only pixels that this camera sees.

        The matrix is from OpenCV's `getOptimalNewCameraMatrix` with alpha = 0 or, for fisheye, from
        `estimateNewCameraMatrixForUndistortRectify` with balance = 0. A lookup camera states the matrix itself. A
        pinhole camera is returned unchanged.
        """
        if self.model == "pinhole":
            return self
        if self.model == "lookup":
            return self.without_lens()
        size, coefficients = (self.width, self.height), np.array(self.distortion)
        if self.model == "fisheye":
            matrix = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
                self.matrix, coefficients, size, np.eye(3), balance=0.0
            )
        else:
            matrix, _ = cv2.getOptimalNewCameraMatrix(self.matrix, coefficients, size, 0.0)
        fx, fy, cx, cy = (float(matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
        return Camera(self.width, self.height, fx, fy, cx, cy)

    def undistort(
        self, image: Shaped[np.ndarray, "height width channels"]
    ) -> Shaped[np.ndarray, "height width channels"]:
        """Returns the image of the camera `undistorted()`, bilinearly interpolated, of the same type."""
        if self.model == "pinhole":
            return image
        if self.model == "lookup":
            column, row = cv2.split(self._seen_by)
            return cv2.remap(image, column, row, cv2.INTER_LINEAR).reshape(image.shape)
        matrix, coefficients = self.undistorted().matrix, np.array(self.distortion)
        if self.model == "fisheye":
            return cv2.fisheye.undistortImage(image, self.matrix, coefficients, Knew=matrix).reshape(image.shape)
        return cv2.undistort(image, self.matrix, coefficients, newCameraMatrix=matrix).reshape(image.shape)

    def undistort_depth(self, depth: Float32[np.ndarray, "height width"]) -> Float32[np.ndarray, "height width"]:
        """Returns the depth map of the camera `undistorted()`, at nearest pixels, since depths at edges do not mix."""
        if self.model == "pinhole":
            return depth
        if self.model == "lookup":
            column, row = cv2.split(self._seen_by)
        else:
            initialise = cv2.fisheye.initUndistortRectifyMap if self.model == "fisheye" else cv2.initUndistortRectifyMap
            size, matrix = (self.width, self.height), self.undistorted().matrix
            column, row = initialise(self.matrix, np.array(self.distortion), np.eye(3), matrix, size, cv2.CV_32FC1)
        return cv2.remap(depth, column, row, cv2.INTER_NEAREST)

    def downscaled(self, factor: float) -> Camera:
        """Returns this pinhole camera with larger pixels.

        Args:
            factor: Width of a new pixel in old pixels, at least 1. Rests at the right and lower border that fill no
                whole pixel are cut off.

        Raises:
            ValueError: No whole pixel remains. The message can follow "FILE holds".
        """
        assert self.model == "pinhole"
        cx, cy = ((centre + 0.5) / factor - 0.5 for centre in (self.cx, self.cy))
        return Camera(int(self.width / factor), int(self.height / factor), self.fx / factor, self.fy / factor, cx, cy)

    @cached_property
    def _seen_by(self) -> Float32[np.ndarray, "height width 2"]:
        """For a lookup camera, the place in the distorted image of each pixel of the undistorted image.

        The table maps distorted places to undistorted places. A fixed-point iteration inverts it.
        """
        assert self.directions is not None
        table = (self.directions * [self.fx, self.fy] + [self.cx, self.cy]).astype(np.float32)
        rows, columns = np.mgrid[: self.height, : self.width].astype(np.float32)
        wanted = np.dstack([columns, rows])
        place = wanted.copy()
        for _ in range(INVERSION_STEPS):
            column, row = cv2.split(place)
            place += 0.5 * (wanted - cv2.remap(table, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
        return place


def check_rotation(matrix: Float64[np.ndarray, "3 3"]) -> None:
    """Checks that a matrix is a rotation.

    Raises:
        ValueError: The matrix stretches or mirrors by more than 1e-3.
    """
    error = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    determinant = float(np.linalg.det(matrix))
    if not (error <= ROTATION_TOLERANCE and determinant > 0):
        raise ValueError(
            f"is no rotation, since it is off orthonormal by {error:.2g} with determinant {determinant:.3g}"
        )
