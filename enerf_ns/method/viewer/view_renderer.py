"""Rendering for a browser: small pictures at once while its view moves, a large one as soon as it rests."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

import numpy as np
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.configs import base_config  # noqa: F401 - of the two, this one can be imported first
from nerfstudio.utils import writer
from nerfstudio.utils.writer import EventName
from nerfstudio.viewer.render_state_machine import RenderAction, RenderStateMachine
from nerfstudio.viewer.utils import CameraState, get_camera
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer
from nerfstudio.viewer_legacy.server.viewer_utils import SetTrace
from viser import ClientHandle

from enerf_ns.method.model import EnerfModel, Outputs

MOVING_SECONDS = 0.1
"""Time (s) that a picture may take while the view moves."""

SMALLEST_WIDTH = 160
"""Least width of a picture in pixels, however long it takes."""

SECONDS_TO_ARRIVE = 2.0
"""Time after connecting in which a browser may still report the pose at which it opens by itself."""


class ViewRenderer(RenderStateMachine):
    """Renders for one browser.

    Nerfstudio's own class shows 47 x 30 pixels while the view moves, and the same once more when it rests, before it
    renders the whole picture.

    Args:
        viewer: Nerfstudio's viewer.
        client: The browser, at the pose at which it opened by itself.
        rays_per_second: Measured speed of rendering.
        limit: Sets near and far ends of the rays of a picture; its second argument says whether the view rests.
        shown: Returns the outputs that are shown, from the outputs of the model and their rays.
    """

    def __init__(
        self,
        viewer: Viewer,
        client: ClientHandle,
        rays_per_second: float,
        limit: Callable[[RayBundle, bool], None],
        shown: Callable[[Outputs, RayBundle], Outputs],
    ):
        super().__init__(viewer, VISER_NERFSTUDIO_SCALE_RATIO, client)
        self.rays_per_second, self._limit, self._shown = rays_per_second, limit, shown
        self.transitions["low_move"]["static"] = "high"
        self._opened_at = client.camera.position / VISER_NERFSTUDIO_SCALE_RATIO
        self._arrived_by = time.perf_counter() + SECONDS_TO_ARRIVE

    def action(self, action: RenderAction) -> None:
        stays = time.perf_counter() < self._arrived_by and action.action == "move"
        if not (stays and np.allclose(action.camera_state.c2w[:, 3], self._opened_at)):
            super().action(action)

    def _render_img(self, camera_state: CameraState) -> Outputs:
        """The outputs of the model for a view, changed as the panel says. The rays are made once for both."""
        panel, model = self.viewer.control_panel, self.viewer.get_model()
        assert isinstance(model, EnerfModel)
        if self.state != "high":  # else the first picture of a move is interrupted, for one that was finished before
            self.interrupt_render_flag = False
        height, width = self._calculate_image_res(camera_state.aspect)
        camera = get_camera(camera_state, height, width).to(model.device)
        with self.viewer.train_lock or contextlib.nullcontext(), torch.no_grad():
            begin, was_training = time.perf_counter(), model.training
            model.eval()
            try:
                with SetTrace(self.check_interrupt):
                    box = panel.crop_obb if panel.crop_viewport else None
                    rays = camera.generate_rays(camera_indices=0, keep_shape=True, obb_box=box)
                    self._limit(rays, self.state == "high")
                    outputs = model.get_outputs_for_camera_ray_bundle(rays)
            finally:
                model.train(was_training)
        self.rays_per_second = height * width / (time.perf_counter() - begin)
        if writer.is_initialized():
            name = EventName.VIS_RAYS_PER_SEC
            writer.put_time(name, duration=self.rays_per_second, step=self.viewer.step, avg_over_steps=True)
        if panel.layer_depth:
            axis = -camera.camera_to_worlds[0, :, 2]
            outputs["gl_z_buf_depth"] = outputs["depth"] * (rays.directions @ axis)[..., None]
        return self._shown(outputs, rays)

    def _calculate_image_res(self, aspect_ratio: float) -> tuple[int, int]:
        if self.state == "high":
            return super()._calculate_image_res(aspect_ratio)
        width = (self.rays_per_second * MOVING_SECONDS * aspect_ratio) ** 0.5
        width = min(max(width, SMALLEST_WIDTH), self.viewer.control_panel.max_res)
        return max(round(width / aspect_ratio), 1), round(width)
