"""`enerf export`: meshes and point clouds of trained runs, in metres and in the axes of the recording."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Optional  # tyro reads these annotations on Python 3.10

import numpy as np
import tyro

from enerf_ns.dataparsers.errors import FlagError, OutputError, RecordingError, printable
from enerf_ns.dataparsers.files import absolute, expanded, write_together
from enerf_ns.dataparsers.formats.registry import check_outside_recordings

SUFFIXES = (".ply", ".glb")

VOXEL_PIXELS = 1.5
"""Side of a voxel, in pixels on the median of what is known."""


@dataclass
class Export:
    """Make a mesh or a point cloud of what a run knows, in metres and in the axes of the recording.

    What no camera saw, or no event told of, stays empty. Where the recording was simulated, or a reference is given, it
    is scored, and the scores are written beside it.
    """

    what: Annotated[Literal["mesh", "pointcloud"], tyro.conf.Positional]
    """A mesh, or points."""
    run: Annotated[Path, tyro.conf.Positional]
    """Folder of the run, or its config.yml."""
    output: Optional[Path] = None  # noqa: UP045
    """File to be written, .ply or .glb (glTF). None: mesh.ply or pointcloud.ply in the folder of the run."""
    voxel: Optional[float] = None  # noqa: UP045
    """Side of a voxel within which depth is averaged, in metres. None: 1.5 pixels on the median of what is known."""
    reference: Optional[Path] = None  # noqa: UP045
    """Mesh that the result is scored against, in metres, in the axes of the recording. None: the simulated scene."""

    def main(self) -> None:
        from enerf_ns.evaluation.runs import load
        from enerf_ns.export.scoring import simulated_scene, surface_scores
        from enerf_ns.export.surface import fused, pixel_size, points_of, surface_views
        from enerf_ns.report.run_files import read_run
        from enerf_ns.simulator.scene.scene_files import load_scene

        if self.voxel is not None and not 0.0 < self.voxel < np.inf:
            raise FlagError(f"--voxel is {self.voxel:g}, but must be metres above 0.")
        files = read_run(self.run)
        output = absolute(self.output or files.config_file.parent / f"{self.what}.ply")
        if output.suffix not in SUFFIXES:
            raise FlagError(f"--output {output} ends with neither .ply nor .glb; give a file that does.")
        if output.is_dir():
            raise OutputError(f"--output {output} is a folder; give the name of a file.")
        check_outside_recordings("--output", output, files.config.data, self.reference)
        if not files.stored:
            raise RecordingError(f"{files.config_file.parent} has no whole checkpoint; wait for one, or train again.")
        notes: list[str] = []
        scene = load_scene(expanded(self.reference), np.random.default_rng(0), notes) if self.reference else None

        pipeline = load(files.config_file).pipeline
        path = pipeline.datamanager.recording.path
        scene = scene or simulated_scene(path)
        camera, views = surface_views(pipeline)
        voxel = self.voxel or VOXEL_PIXELS * pixel_size(camera, views)
        surface = (fused if self.what == "mesh" else points_of)(camera, views, voxel)
        if not len(surface.vertices):
            raise RecordingError(
                f"{files.config_file.parent} shows no surface at voxels of {voxel:.3g} m; give another --voxel, or "
                "train it longer."
            )
        content = surface.export(file_type=output.suffix[1:])
        assert isinstance(content, bytes)
        written, lines = {output.name: content}, []
        low, high = surface.bounds
        size = " x ".join(f"{side:.2f}" for side in high - low)
        lines.append(f"{len(surface.vertices):,} points, {size} m, voxels of {voxel:.3g} m: {output}")
        if scene is not None:
            scores = surface_scores(surface, scene, camera, [view.pose for view in views])
            table = {"reference": str(self.reference or path), "voxel": voxel, **scores.as_dict()}
            written[f"{output.stem}.json"] = (json.dumps(table, indent=2) + "\n").encode()
            lines.append(str(scores))
        try:
            write_together(output.parent, written)
        except OSError as error:
            raise OutputError(f"{output} cannot be written ({error.strerror}); give another --output.") from error
        for line in [*(f"note: {note}" for note in notes), *lines]:
            print(printable(line))
