"""The method enerf for nerfbaselines, which learns from the events of a recording."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.engine.callbacks import TrainingCallbackLocation

from enerf_ns.dataparsers.event_dataparser import OPENGL_FROM_OPENCV
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.method.runs import load, method_config, set_up

RUN = Path("outputs", "recording", "enerf", "run")
"""Folder of the run within a checkpoint."""


class EnerfMethod:
    """A run of enerf that nerfbaselines trains step by step.

    Args:
        checkpoint: Folder that `save` wrote. Such a run renders, and is not trained further.
        train_dataset: Of `load_recording`; its metadata name the folder of the events.
        config_overrides: Values by the names of ns-train's flags, such as {"max_num_iterations": 500}.

    Raises:
        RecordingError: The data set carries no events, or the checkpoint cannot be loaded.
        FlagError: There is no setting of such a name.
    """

    def __init__(
        self,
        *,
        checkpoint: str | None = None,
        train_dataset: Any = None,
        config_overrides: dict[str, Any] | None = None,
    ):
        self._own, self._loaded_step, self._checkpoint = tempfile.TemporaryDirectory(), None, checkpoint
        if checkpoint is not None:
            stored = Path(checkpoint).absolute()
            config = yaml.load((stored / RUN / "config.yml").read_text(), Loader=yaml.Loader)
            config.output_dir = stored / RUN.parts[0]
            file = Path(self._own.name) / "config.yml"
            file.write_text(yaml.dump(config))
            run = load(file)
            self._trainer, self._pipeline, self._config = None, run.pipeline, run.config
            self._loaded_step = int(run.config.load_step or 0) + 1
            return
        events = (train_dataset or {}).get("metadata", {}).get("events")
        if events is None:
            raise RecordingError("This data set carries no events; load a recording with the loader enerf-recording.")
        changes = {  # its command line gives text
            name: yaml.safe_load(value) if isinstance(value, str) else value
            for name, value in (config_overrides or {}).items()
        }
        config = method_config("enerf", Path(events), Path(self._own.name), changes)
        config.timestamp = RUN.name
        self._config = config.resolved()
        self._trainer = set_up(self._config)
        self._pipeline = self._trainer.pipeline

    @classmethod
    def get_method_info(cls) -> dict[str, Any]:
        """Requirements and outputs of the method, before it is made."""
        return {
            "method_id": "",
            "required_features": frozenset(),
            "supported_camera_models": frozenset(("pinhole",)),
            "supported_outputs": ("color", "depth", "accumulation"),
            "can_resume_training": False,
        }

    def get_info(self) -> dict[str, Any]:
        """Requirements and outputs, and the settings and the step of this run."""
        config = self._config
        return {
            **self.get_method_info(),
            "num_iterations": config.max_num_iterations,
            "batch_size": int(self._pipeline.datamanager.get_train_rays_per_batch()),
            "loaded_step": self._loaded_step,
            "loaded_checkpoint": self._checkpoint,
            "hparams": {"max_num_iterations": config.max_num_iterations},
        }

    def get_train_embedding(self, index: int) -> None:
        """There are no embeddings of frames."""
        return None

    def train_iteration(self, step: int) -> dict[str, float]:
        """Trains one step, from 0; its losses and metrics by name."""
        trainer = self._trainer
        if trainer is None:
            raise RecordingError("A run from a checkpoint is not trained further; train it anew.")
        self._pipeline.train()
        self._run_callbacks(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        loss, losses, metrics = trainer.train_iteration(step)
        self._run_callbacks(step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
        self._step = step
        return {name: float(value.detach()) for name, value in {"loss": loss, **losses, **metrics}.items()}

    def _run_callbacks(self, step: int, where: TrainingCallbackLocation) -> None:
        assert self._trainer is not None
        for callback in self._trainer.callbacks:
            callback.run_callback_at_location(step, location=where)

    def save(self, path: str) -> None:
        """Writes the config and the parameters into a folder."""
        folder = Path(path) / RUN
        (folder / "nerfstudio_models").mkdir(parents=True, exist_ok=True)
        if self._trainer is None:
            assert self._checkpoint is not None
            shutil.copytree(Path(self._checkpoint) / RUN, folder, dirs_exist_ok=True)
            return
        self._trainer.save_checkpoint(getattr(self, "_step", 0))
        stored = sorted(self._trainer.checkpoint_dir.glob("*.ckpt"))[-1]
        shutil.copy(stored, folder / "nerfstudio_models" / stored.name)
        config = replace(self._config, experiment_name=RUN.parts[1], timestamp=RUN.name)
        (folder / "config.yml").write_text(yaml.dump(config))

    @torch.no_grad()
    def render(self, camera: Any, *, options: Any = None) -> dict[str, np.ndarray]:
        """Renders one camera.

        Args:
            camera: Pinhole camera of nerfbaselines, camera to world in OpenCV axes, metres.
            options: Not used.

        Returns:
            color, linear brightness (height, width, 3); depth along the ray in metres, and accumulation (height,
            width).
        """
        camera, outputs = camera.item(), self._pipeline.datamanager.train_dataparser_outputs
        transform, scale = outputs.metadata["transform"].numpy(), outputs.dataparser_scale
        pose = transform[:, :3] @ np.asarray(camera.poses, np.float64)[:3]
        pose[:, 3] = scale * (pose[:, 3] + transform[:, 3])
        pose[:, :3] = pose[:, :3] @ OPENGL_FROM_OPENCV
        fx, fy, cx, cy = map(float, camera.intrinsics)
        width, height = map(int, camera.image_sizes)
        shown = Cameras(
            torch.from_numpy(pose[None]).float(), fx, fy, cx, cy, width, height, camera_type=CameraType.PERSPECTIVE
        ).to(self._pipeline.device)
        self._pipeline.eval()
        rays = shown.generate_rays(camera_indices=0, keep_shape=True)
        found = self._pipeline.model.get_outputs_for_camera_ray_bundle(rays)
        return {
            "color": found["rgb"].cpu().numpy(),
            "depth": (found["depth"][..., 0] / scale).cpu().numpy(),
            "accumulation": found["accumulation"][..., 0].cpu().numpy(),
        }
