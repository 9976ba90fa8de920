"""Rows of the sensor. The parts of the sensor decide their settings themselves."""

from __future__ import annotations

from enerf_ns.choices.scene import Scene
from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.sensor.part import GREY
from enerf_ns.sensor.response import ColourFilter


def parts(scene: Scene) -> None:
    """What is the sensor like, and what of it is learned?"""
    for part in scene.config.model.sensor._target.parts():
        if "choose" in vars(part):
            part.choose(scene)


def colour_filter(scene: Scene) -> None:
    """Which colour does each pixel see?

    Raises:
        FlagError: The pattern does not exist.
    """
    camera = scene.recording.camera
    pattern = scene.use("model.sensor.bayer_pattern", lambda: scene.recording.bayer_pattern or GREY)
    scene.use("model.sensor.width", lambda: camera.width)
    scene.use("model.sensor.height", lambda: camera.height)
    if pattern != GREY:
        try:
            ColourFilter(pattern, camera.width)
        except ValueError as error:
            raise FlagError(f"--pipeline.model.bayer-pattern is {error}") from error
