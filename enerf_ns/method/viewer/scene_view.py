"""Nerfstudio's viewer adapted to a recording: its first view, its trajectory to play along, events over renders."""

from __future__ import annotations

import threading
import time

import numpy as np
import torch
import viser
import viser.transforms as vtf
from jaxtyping import Float, Float64
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.viewer.render_state_machine import RenderAction
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer
from nerfstudio.viewer.viewer_elements import ViewerControl
from torch import Tensor

from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.method.datamanager import EnerfDataManager
from enerf_ns.method.model import FARTHEST, EnerfModel, Outputs
from enerf_ns.method.nerfstudio_seams import replace_camera_callbacks, replace_renderer, tidy_control_panel
from enerf_ns.method.viewer.overlay import draw_events, for_the_eye, recent_events, unknown
from enerf_ns.method.viewer.seen_rays import SeenRays
from enerf_ns.method.viewer.view_renderer import ViewRenderer

LOOK_WIDTH = 64
"""Width in pixels of the picture from which the depth of the first view is measured."""

BEHIND = 0.2
"""Distance of the first view behind its training camera, as a share of the depth of the scene."""

FRUSTUM = 0.006
"""Scale of the cameras that are drawn, as a share of the same depth; they are about three times as wide."""

MOST_CAMERAS = 16
"""Number of training cameras that are drawn."""

FULL_WIDTH = 640
"""Longer side, in pixels, of the picture of a view at rest; "Max res" in the viewer."""

MIDDLE_BRIGHTNESS = 0.4
"""Displayed value of the median of the first view, if the field learns from events alone."""

PATH_POINTS = 200
"""Number of points of the drawn trajectory."""

PLAY_SECONDS = 10.0
"""Least time in which a recording is played; longer recordings are played in real time."""

PLAY_STEP = 0.125
"""Seconds between two views while playing."""

FIRST_SEEN, SEEN_EVERY = 500, 1.5
"""Step of a training at which the seen volume is first computed, and factor from one such step to the next."""

LOOKED_EVERY = 1.1
"""Factor from one step of a training at which the brightness of the field is measured to the next."""

ACCENT = (255, 211, 105)
"""Colour of the trajectory and the sensor."""

NERFSTUDIO_BACKGROUND, UNKNOWN = (38, 42, 55), (100, 100, 100)
"""Background colour of Nerfstudio's viewer, and the colour here of the lighter squares where nothing was seen."""

PAUSE = 0.1
"""Seconds after a move of a view in which training pauses."""

EDGES = (120, 200, 255)
"""Colour of the points of edges."""

EDGE_WIDTH = 0.003
"""Width of a point of an edge, as a share of the depth of the first view."""

STATED = (150, 150, 150)
"""Colour of the trajectory before corrections."""


class SceneView(ViewerControl):
    """Adapts Nerfstudio's viewer to a recording when the viewer starts (`_setup`).

    Args:
        model: The model that the viewer shows.
        manager: The data manager of its recording.
    """

    def __init__(self, model: EnerfModel, manager: EnerfDataManager):
        self._model, self._manager = model, manager
        self._seen: SeenRays | None = None
        self._seen_at = self._looked_at = 0  # training steps
        self._level = 0.0  # stops
        self._showed_trained = False
        self._edges: viser.PointCloudHandle | None = None
        self._moves, self._turn_to_render = threading.Lock(), threading.Lock()

    def _setup(self, viewer: Viewer) -> None:
        """Fills the viewer. The panel comes first, for browsers that are there before the scene."""
        super()._setup(viewer)
        asked, port = viewer.config.websocket_port, viewer.viser_server.get_port()
        if asked and asked != port:
            told = [line.replace(f":{asked}", f":{port}") for line in viewer.viewer_info]
            viewer.viewer_info = [f"The port {asked} is taken, so that another one is used.", *told]
        outputs, dataset = self._manager.train_dataparser_outputs, self._manager.train_dataset
        self._transform, self._scale = outputs.metadata["transform"].numpy(), outputs.dataparser_scale
        self._camera = self._recording.camera.undistorted()
        self._middle = int(np.argsort(dataset.frames.times)[len(dataset) // 2])
        self._add_panel()
        if viewer.trainer is None:
            viewer.pause_train.visible = viewer.resume_train.visible = False
        self._look_from_the_middle()
        if viewer.trainer is None:
            self._seen = self._seen_now()
        self._tidy_up()
        self._draw_recording()
        self._listen()
        self._state.content = ""
        self.viser_server.on_client_connect(self._open)

    def after_step(self, step: int) -> None:
        """Tells the viewer the step of training. A picture that waits is rendered first, and training pauses while a
        view moves."""
        viewer = self.viewer
        viewer.step = step
        with self._turn_to_render:
            pass
        while viewer.render_statemachines and time.time() - viewer.last_move_time < PAUSE:
            time.sleep(0.01)

    def draw_edges(self, edges: Float[Tensor, "edges 3"]) -> None:
        """Draws points of edges, in scene units: before training until the first picture of the trained field."""
        self._edges = self.viser_server.scene.add_point_cloud(
            "/edges",
            edges.cpu().numpy() * VISER_NERFSTUDIO_SCALE_RATIO,
            colors=EDGES,
            point_size=EDGE_WIDTH * self._depth * VISER_NERFSTUDIO_SCALE_RATIO,
            point_shape="circle",
        )
        self._shows_edges.value = True

    def end(self, step: int, sentence: str) -> None:
        """Says in all browsers that training has ended, after its last step."""
        self.viewer.step = step
        self.viewer.pause_train.visible = self.viewer.resume_train.visible = False
        self._state.content = sentence

    @property
    def _recording(self) -> EventRecording:
        """The recording, with its current corrections."""
        return self._manager.recording

    def _look_from_the_middle(self) -> None:
        """Finds the depth of the first view, which is that of the middle camera in time."""
        dataset, model = self._manager.train_dataset, self._model
        camera = dataset.cameras[self._middle : self._middle + 1].to(model.device)
        camera.rescale_output_resolution(LOOK_WIDTH / float(camera.width))
        self._look_camera = camera
        self._look()  # the first may compile
        begin = time.perf_counter()
        depth = self._look()
        self._rays_per_second = depth.numel() / (time.perf_counter() - begin)
        self._depth = float(depth.median())
        self._up = dataset.cameras.camera_to_worlds[:, :3, 1].double().mean(dim=0).numpy()

    def _look(self) -> Tensor:
        """Depth of the first view of the current field, scene units. Also measures the brightness of that view."""
        model, was_training = self._model, self._model.training
        rays = self._look_camera.generate_rays(camera_indices=0, keep_shape=True)
        outputs = model.eval().get_outputs_for_camera_ray_bundle(rays)
        model.train(was_training)
        if self._manager.config.supervision == "events":  # which do not determine the level of brightness
            self._level = float(np.log2(MIDDLE_BRIGHTNESS / outputs["rgb"].median().clamp(min=1e-6).cpu()))
        return outputs["depth"]

    def _tidy_up(self) -> None:
        """Sets sizes that suit the scene, unless the user did, and hides controls without effect."""
        viewer, defaults = self.viewer, ViewerConfig()
        if viewer.config.camera_frustum_scale == defaults.camera_frustum_scale:
            viewer.config.camera_frustum_scale = FRUSTUM * self._depth * VISER_NERFSTUDIO_SCALE_RATIO
        if viewer.config.max_num_display_images == defaults.max_num_display_images:
            viewer.config.max_num_display_images = MOST_CAMERAS
        if viewer.control_panel.background_color == NERFSTUDIO_BACKGROUND:
            viewer.control_panel.background_color = UNKNOWN
        tidy_control_panel(viewer.control_panel, FULL_WIDTH)

    def _draw_recording(self) -> None:
        """Draws the trajectory, and the sensor on it at the time of the slider."""
        self._drawn = [
            self.viser_server.scene.add_frame("/cameras", show_axes=False),
            self.viser_server.scene.add_frame("/recording", show_axes=False),
        ]
        self._draw_path()
        self._sensor = self.viser_server.scene.add_camera_frustum(
            "/recording/sensor",
            fov=2.0 * np.arctan(0.5 * self._camera.height / self._camera.fy),
            aspect=self._camera.width / self._camera.height,
            scale=self.viewer.config.camera_frustum_scale,
            color=ACCENT,
        )
        self._place_sensor(self._pose(self._moment))

    def _draw_path(self) -> None:
        """Draws the trajectory with its current corrections, and in grey the stated one if it differs."""
        recording, self._path_of = self._recording, self._manager.corrections
        times = recording.instants(PATH_POINTS)
        self._path = np.stack([self._pose(int(t))[:, 3] for t in times])
        lines: dict[str, tuple[np.ndarray, tuple[int, int, int]]] = {"path": (self._path, ACCENT)}
        if recording.as_read is not None:
            stated = recording.as_read.trajectory
            lines["stated"] = np.stack([self._pose(int(t), stated)[:, 3] for t in times]), STATED
        for name, (points, colour) in lines.items():
            self.viser_server.scene.add_spline_catmull_rom(
                f"/recording/{name}",
                points * VISER_NERFSTUDIO_SCALE_RATIO,
                color=colour,
                line_width=2.0,
                segments=PATH_POINTS,
            )

    def _add_panel(self) -> None:
        """Adds the folder of the recording."""
        gui, (first, last) = self.viser_server.gui, np.array(self._recording.span) * 1e-9
        step = 10.0 ** np.floor(np.log10((last - first) / 500.0))
        begin = step * round(self._manager.train_dataset.frames.times[self._middle] * 1e-9 / step)
        with gui.add_folder("Recording", order=self.viewer.stats_markdown.order + 0.5):
            self._state = gui.add_markdown("Loading the scene …")
            self._first_view = gui.add_button("First view", hint="Go back to the view at the beginning")
            self._time = gui.add_slider("Time (s)", first, last, step, begin, hint="A moment of the recording")
            self._plays = gui.add_checkbox("Play", False, hint="Move along the trajectory, over and over")
            self._follows = gui.add_checkbox("Follow", True, hint="Look from where the sensor was at that moment")
            self._events = gui.add_checkbox("Events", False, hint="Draw the events of that moment on the surfaces")
            self._shows_edges = gui.add_checkbox("Edges", False, hint="Draw edges by the depth that events show")
            self._window = gui.add_slider("Last (ms)", 1, 100, 1, 10, hint="Time before the moment with drawn events")
            self._stops = gui.add_slider("Brightness", -4.0, 4.0, 0.1, 0.0, hint="Stops; each doubles the brightness")
            self._gamma = gui.add_slider("Gamma", 0.4, 3.0, 0.1, 1.0, hint="Above 1 brightens what is dark")
            self._depths = gui.add_markdown("")
            self._corrected = gui.add_markdown(self._corrections_in_words)

    def _listen(self) -> None:
        """Makes the folder do what it says, from the moment that the scene is there."""
        for handle in (self._events, self._window, self._stops, self._gamma):
            handle.on_update(lambda _: self._render())
        self._shows_edges.on_update(lambda _: self._show_edges())
        self._time.on_update(lambda _: self._move())
        self._follows.on_update(lambda _: self._move())
        self._plays.on_update(lambda _: threading.Thread(target=self._play, daemon=True).start())
        self._first_view.on_click(lambda event: event.client and self._show_first_view(event.client))

    def _open(self, client: viser.ClientHandle) -> None:
        """Shows a browser the first view, and renders for it from now on."""
        renderer = ViewRenderer(
            self.viewer, client, self._turn_to_render, self._rays_per_second, self._limit, self._shown
        )
        replace_renderer(self.viewer, client, renderer)
        self._show_first_view(client)
        replace_camera_callbacks(client, self._moved)
        renderer.start()

    def _show_first_view(self, client: viser.ClientHandle) -> None:
        """Turns a browser to the view a little behind the middle training camera."""
        pose = self._manager.train_dataset.cameras.camera_to_worlds[self._middle].cpu().double().numpy()
        back = pose[:, 2]
        self._turn(client, pose[:, 3] + BEHIND * self._depth * back, pose[:, 3] - self._depth * back, self._up)

    def _turn(self, client: viser.ClientHandle, position: np.ndarray, target: np.ndarray, up: np.ndarray) -> None:
        """Moves the camera of a browser to a position, and points it at a target."""
        with client.atomic():
            self._fit(client.camera)
            client.camera.up_direction = up
            client.camera.position = position * VISER_NERFSTUDIO_SCALE_RATIO
            client.camera.look_at = target * VISER_NERFSTUDIO_SCALE_RATIO

    def _moved(self, view: viser.CameraHandle) -> None:
        """Renders for a browser whose camera has moved, unless it has gone since."""
        renderer = self.viewer.render_statemachines.get(view.client.client_id)
        if isinstance(renderer, ViewRenderer) and renderer.has_moved(view):
            self._fit(view)
            self.viewer.last_move_time = time.time()  # type: ignore - starts as an int
            self._render_for(view.client)

    def _render(self) -> None:
        """Renders anew for all browsers."""
        for client in self.viser_server.get_clients().values():
            self._render_for(client)

    def _render_for(self, client: viser.ClientHandle) -> None:
        """Renders anew for a browser, unless it has gone since: handles are heard in threads of their own."""
        renderer = self.viewer.render_statemachines.get(client.client_id)
        if renderer is not None:
            renderer.action(RenderAction("move", self.viewer.get_camera_state(client)))

    def _fit(self, view: viser.CameraHandle) -> None:
        """Widens a view until it shows the whole picture of the sensor, also where panels make it narrow."""
        camera = self._camera
        half = 0.5 * max(camera.height / camera.fy, camera.width / camera.fx / view.aspect)
        fov = 2.0 * float(np.arctan(half))
        if abs(view.fov - fov) > 0.01:
            view.fov = fov

    @property
    def _corrections_in_words(self) -> str:
        words = self._manager.corrections.words
        return f"Corrected: {'; '.join(words)}. Grey: the path as it was stated." if words else ""

    def _pose(self, time_ns: int, trajectory: Trajectory | None = None) -> Float64[np.ndarray, "3 4"]:
        """The pose of the sensor in the scene, OpenCV axes, on its own trajectory or on another one."""
        pose = (trajectory or self._recording.trajectory).poses(torch.tensor(time_ns)).numpy()
        rotation, shift = self._transform[:, :3], self._transform[:, 3]
        return np.column_stack([rotation @ pose[:, :3], self._scale * (rotation @ pose[:, 3] + shift)])

    @property
    def _moment(self) -> int:
        """The time of the slider, ns."""
        first, last = self._recording.span
        return min(max(round(self._time.value * 1e9), first), last)

    def _move(self) -> None:
        """Moves the sensor to its pose at the time of the slider, and the views with it.

        viser calls this in several threads. The lock makes them wait, so that the last one sets the latest time.
        """
        with self._moves:
            pose = self._pose(self._moment)
            self._place_sensor(pose)
            if self._follows.value:
                for client in self.viser_server.get_clients().values():
                    self._turn(client, pose[:, 3], pose[:, 3] + self._depth * pose[:, 2], -pose[:, 1])
        self._render()

    def _place_sensor(self, pose: Float64[np.ndarray, "3 4"]) -> None:
        with self.viser_server.atomic():
            self._sensor.position = pose[:, 3] * VISER_NERFSTUDIO_SCALE_RATIO
            self._sensor.wxyz = vtf.SO3.from_matrix(pose[:, :3]).wxyz

    def _play(self) -> None:
        """Advances the time until "Play" is switched off. After the end it starts again."""
        first, last = np.array(self._recording.span) * 1e-9
        step = PLAY_STEP * min(1.0, (last - first) / PLAY_SECONDS)
        while self._plays.value:
            following = self._time.value + step
            self._time.value = following if following <= last else first
            time.sleep(PLAY_STEP)

    def _show_edges(self) -> None:
        """Draws the edges, which takes some seconds when they are first drawn, or hides them."""
        if self._shows_edges.value and self._edges is None:
            self.draw_edges(self._manager.edges()[1])
        if self._edges is not None:
            self._edges.visible = self._shows_edges.value

    def _seen_now(self) -> SeenRays:
        assert self._model.seen_volume is not None
        return SeenRays(self._model.seen_volume())

    def _limit(self, rays: RayBundle, is_whole: bool) -> None:
        """Limits the rays of a picture to the seen volume, and updates what training has changed.

        Args:
            rays: Rays of shape (height, width); nears and fars that are set are only narrowed.
            is_whole: Whether the view rests and its picture is the largest, so that there is time to compute the seen
                volume.
        """
        step, model = self.viewer.step, self._model
        if self.viewer.trainer is not None and step >= LOOKED_EVERY * self._looked_at:
            self._look()
            self._looked_at = max(step, 1)
        if is_whole and self.viewer.trainer is not None and step >= max(FIRST_SEEN, SEEN_EVERY * self._seen_at):
            self._seen = self._seen_now()
            self._seen_at = step
        if is_whole and self._manager.corrections is not self._path_of:
            self._draw_path()
            self._corrected.content = self._corrections_in_words
        if step > 0 and not self._showed_trained:
            self._showed_trained, self._shows_edges.value = True, False
        if self._seen is None or model.config.panorama:
            return
        assert model.config.near_plane is not None
        beyond = (model.config.near_plane, FARTHEST) if model.is_unbounded else None
        nears, fars = self._seen.span(rays.origins, rays.directions, beyond)
        if rays.nears is not None and rays.fars is not None:
            nears, fars = torch.maximum(nears, rays.nears), torch.minimum(fars, rays.fars)
        rays.nears, rays.fars = nears, fars

    def _shown(self, outputs: Outputs, rays: RayBundle) -> Outputs:
        """The outputs that are shown: rgb encoded for a display, with events, and depth in metres.

        Args:
            outputs: Outputs of the model, each of shape (height, width, channels).
            rays: Rays of the picture, shape (height, width).
        """
        rgb, depth, share = outputs["rgb"], outputs["depth"], outputs["accumulation"]
        points = rays.origins + rays.directions * depth
        is_known = torch.ones_like(share, dtype=torch.bool)
        if self._seen is not None:
            is_known = (share > 0.5) & self._seen.may_be_surface(points, self._model.is_unbounded)[..., None]
            rgb = rgb / share.clamp(min=0.5)
        rgb = for_the_eye(rgb, self._level + self._stops.value, self._gamma.value)
        rgb = rgb.where(is_known, unknown(rgb.shape[:2], self.viewer.control_panel.background_color).to(rgb))
        if self._events.value:
            moment = self._moment
            begin = moment - round(self._window.value * 1e6)
            events = recent_events(self._manager.index, self._recording.camera, begin, moment)
            rgb = draw_events(rgb, points, events, self._camera, self._pose(moment))
        shown = Outputs(outputs | {"rgb": rgb, "depth": self._in_metres(depth, is_known & (share > 0.5))})
        path = torch.from_numpy(self._path).to(rays.origins)
        away = float((path - rays.origins[0, 0]).norm(dim=-1).min())
        for handle in self._drawn:  # near the trajectory, drawn lines and cameras hide the scene
            handle.visible = away > 4.0 * FRUSTUM * self._depth
        return shown

    def _in_metres(self, depth: Tensor, is_known: Tensor) -> Tensor:
        """Depth in metres, clipped to the known depths of the view. Also updates the text about depths."""
        metres = depth / self._scale
        known, (row, column) = metres[is_known], (side // 2 for side in metres.shape[:2])
        content = "Nothing was seen here."
        if self._model.config.panorama:
            content = "The camera only turned, so that no depth is known."
        elif len(known):
            near, far = float(known.min()), float(known.max())
            metres = metres.clamp(near, far)
            middle = f"{float(metres[row, column]):.2f} m" if is_known[row, column] else "nothing"
            content = f"In the middle: {middle}  \nIn view, as depth is coloured: {near:.2f} m to {far:.2f} m"
        if content != self._depths.content:
            self._depths.content = content
        return metres
