"""Rendering for a browser: small pictures at once while its view moves, larger ones as soon as it rests."""

from __future__ import annotations

import atexit
import contextlib
import itertools
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.configs import base_config  # noqa: F401 - of the two, this one can be imported first
from nerfstudio.viewer.render_state_machine import RenderAction, RenderStateMachine
from nerfstudio.viewer.utils import get_camera
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer
from nerfstudio.viewer_legacy.server.viewer_utils import IOChangeException, SetTrace
from viser import CameraHandle, ClientHandle

from enerf_ns.method.model import EnerfModel, Outputs

MOVING_SECONDS = 0.15
"""Time (s) that a picture may take while the view moves."""

SMALLEST_SIDE = 160
"""Least longer side of a picture in pixels, however long it takes."""

LARGEST_SIDE = 2048
"""Largest longer side of a picture in pixels, as of the slider "Max res", which browsers alone keep to."""

SIZES = 3
"""Number of pictures of a view from the moment that it rests: small, of middle size, and whole."""

REST = 0.15
"""Time (s) without a move after which a view rests."""

TRAINING_SHARE = 9.0
"""Least time of training between two pictures of a view at rest, in times of one picture."""

SECONDS_TO_ARRIVE = 2.0
"""Time after connecting in which a browser may still report the pose at which it opens by itself."""

LONGEST_RENDER = 10.0
"""Time (s) that the end of a command waits for a picture that is being rendered."""


class ViewRenderer(RenderStateMachine):
    """Renders for one browser.

    The loop of Nerfstudio's own class loses a move that comes while it takes up the one before. It never renders again
    after an interruption without a following move. During training it renders after so many steps as it computes from
    the first few pictures and steps, which are slow: often thousands. This loop looks at the current view and the step
    by itself.

    Args:
        viewer: Nerfstudio's viewer.
        client: The browser, at the pose at which it opened by itself.
        turn: Held while a picture waits or is rendered. Training waits for it between two steps, since a lock may go
            back to the thread that has just released it.
        rays_per_second: Measured speed of rendering.
        limit: Sets near and far ends of the rays of a picture; its second argument says whether it is the whole one.
        shown: Returns the outputs that are shown, from the outputs of the model and their rays.
    """

    def __init__(
        self,
        viewer: Viewer,
        client: ClientHandle,
        turn: threading.Lock,
        rays_per_second: float,
        limit: Callable[[RayBundle, bool], None],
        shown: Callable[[Outputs, RayBundle], Outputs],
    ):
        super().__init__(viewer, VISER_NERFSTUDIO_SCALE_RATIO, client)
        self.rays_per_second, self._turn, self._limit, self._shown = rays_per_second, turn, limit, shown
        self._requests = itertools.count()
        self._asked = self._drawn = -1  # the last request, and the one that is drawn
        self._moved_at, self._pose = 0.0, np.zeros(0)
        self._opened_at = client.camera.position
        self._arrived_by = time.monotonic() + SECONDS_TO_ARRIVE
        self._step = -1  # of the last picture

    def action(self, action: RenderAction) -> None:
        """Asks for pictures of the current view. Steps of training are ignored: the loop looks at them by itself."""
        if action.action != "step":
            self._moved_at = time.monotonic()
            self._asked = next(self._requests)
            self.render_trigger.set()

    def has_moved(self, view: CameraHandle) -> bool:
        """Whether a camera has another pose than when this was last asked: browsers repeat what they have said."""
        pose = np.concatenate([view.wxyz, view.position, [view.fov, view.aspect]])
        before, self._pose = self._pose, pose
        return not np.array_equal(before, pose)

    def stop(self) -> None:
        """Ends the thread, and the picture that it renders."""
        self.running = False
        self._asked = next(self._requests)
        self.render_trigger.set()
        self.join(LONGEST_RENDER)

    def run(self) -> None:
        # Python ends beside a thread that computes by aborting ("terminate called without an active exception")
        atexit.register(self.stop)
        try:
            self._render_views()
        finally:
            atexit.unregister(self.stop)

    def _render_views(self) -> None:
        size, again = 0, 0.0
        while self.running:
            self.render_trigger.wait(0.2 if size == SIZES else 0.05)
            self.render_trigger.clear()
            now, asked = time.monotonic(), self._asked
            if not self.viewer.ready or (
                now < self._arrived_by and (self.client.camera.position == self._opened_at).all()
            ):
                continue
            self._say_step()
            if asked != self._drawn:
                size = 0
            elif size == SIZES:
                if self.viewer.step == self._step or now < again:
                    continue
                size -= 1
            elif size > 0 and now < self._moved_at + REST:
                continue
            self._drawn, self._step = asked, self.viewer.step
            try:
                outputs = self._draw(size)
            except IOChangeException:
                continue
            self._send_output_to_viewer(outputs, static_render=size > 0)
            is_whole = max(outputs["rgb"].shape[:2]) >= self._whole
            size += 2 if is_whole and size == 0 else 1  # the whole one is sent again at rest, in better quality
            finished = time.monotonic()
            again = finished + TRAINING_SHARE * (finished - now)

    def _say_step(self) -> None:
        """Shows the step of training in the panel."""
        text = self.viewer.make_stats_markdown(self.viewer.step, None)
        if text != self.viewer.stats_markdown.content:
            self.viewer.stats_markdown.content = text

    def check_interrupt(self, frame: FrameType, event: str, arg: Any) -> Any:
        """Ends a render, on its next line of Python, once another view is asked for."""
        if event == "line" and self._asked != self._drawn:
            raise IOChangeException
        return self.check_interrupt

    def _draw(self, size: int) -> Outputs:
        """The outputs of the model for the current view, changed as the panel says. The rays are made once for both.

        Args:
            size: 0 for the picture of a view that moves, which is not interrupted, up to `SIZES` - 1 for the whole one.

        Raises:
            IOChangeException: Another view was asked for.
        """
        panel, model = self.viewer.control_panel, self.viewer.get_model()
        state = self.viewer.get_camera_state(self.client)
        assert isinstance(model, EnerfModel)
        height, width = self._resolution(size, state.aspect)
        camera = get_camera(state, height, width).to(model.device)
        interrupts = SetTrace(self.check_interrupt) if size > 0 else contextlib.nullcontext()
        with self._turn, self.viewer.train_lock or contextlib.nullcontext(), torch.no_grad():
            begin, was_training = time.perf_counter(), model.training
            model.eval()
            try:
                with interrupts:
                    box = panel.crop_obb if panel.crop_viewport else None
                    rays = camera.generate_rays(camera_indices=0, keep_shape=True, obb_box=box)
                    self._limit(rays, size == SIZES - 1)
                    outputs = model.get_outputs_for_camera_ray_bundle(rays)
            finally:
                model.train(was_training)
        self.rays_per_second = height * width / (time.perf_counter() - begin)
        if panel.layer_depth:
            axis = -camera.camera_to_worlds[0, :, 2]
            outputs["gl_z_buf_depth"] = outputs["depth"] * (rays.directions @ axis)[..., None]
        return self._shown(outputs, rays)

    @property
    def _whole(self) -> int:
        """Longer side of the whole picture in pixels."""
        return min(max(self.viewer.control_panel.max_res, 1), LARGEST_SIDE)

    def _resolution(self, size: int, aspect: float) -> tuple[int, int]:
        """Height and width (pixels) of a picture. The middle one is as much larger than the small as than the whole."""
        whole, longer = self._whole, max(aspect, 1.0 / aspect)
        small = (self.rays_per_second * MOVING_SECONDS * longer) ** 0.5
        small = min(max(small, SMALLEST_SIDE), whole)
        side = (small, (small * whole) ** 0.5, whole)[size]
        height, width = (side, side * aspect) if aspect < 1.0 else (side / aspect, side)
        return max(round(height), 1), max(round(width), 1)
