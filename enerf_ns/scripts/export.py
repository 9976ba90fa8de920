"""`enerf export`: mesh, points, splats or refined poses of a run, in metres and in the axes of the recording; or the
run and its recording in one file."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Optional  # tyro reads these annotations on Python 3.10

import numpy as np
import tyro

from enerf_ns.dataparsers.formats.registry import check_outside_recordings
from enerf_ns.dataparsers.recording.errors import FlagError, OutputError, RecordingError, printable, quoted
from enerf_ns.dataparsers.recording.files import absolute, expanded, write_together

if TYPE_CHECKING:
    from enerf_ns.method.pipeline import EnerfPipeline

SUFFIXES = {
    "mesh": (".ply", ".glb"),
    "pointcloud": (".ply", ".glb"),
    "splats": (".ply",),
    "poses": (".txt",),
    "run": (".zip",),
}


@dataclass
class Export:
    """Write a mesh, points, splats or the refined poses of a run, in metres and in the axes of the recording; or pack
    the run.

    Regions that no camera saw, or whose depth the events do not determine, stay empty. If the recording was simulated,
    or a reference is given, the mesh or cloud is compared with it, and the scores are written beside it, as in
    mesh.ply.json.

    Poses are those of the event camera after training, camera to world in OpenCV axes, on the clock of the events. The
    file has one line t px py pz qx qy qz qw for each pose (TUM format). The file poses.txt.json beside it holds the
    lens.

    A packed run is a ZIP file with the run and its recording, which another machine unpacks and views.
    """

    what: Annotated[Literal["mesh", "pointcloud", "splats", "poses", "run"], tyro.conf.Positional]
    """Output: a mesh, a point cloud, Gaussian splats at the points (for viewers of 3D Gaussian splatting), poses,
    or the run itself."""
    run: Annotated[Path, tyro.conf.Positional]
    """Folder of the run, or its config.yml."""
    output: Optional[Path] = None  # noqa: UP045
    """File to write: .ply or .glb (glTF) for a mesh or a point cloud, .ply for splats, .txt for poses, .zip for the
    run. Default: mesh.ply, pointcloud.ply, splats.ply, poses.txt or run.zip in the folder of the run."""
    voxel: Optional[float] = None  # noqa: UP045
    """Side in metres of the voxels in which depth is averaged. Default: 1.5 pixels at the median known depth."""
    reference: Optional[Path] = None  # noqa: UP045
    """Mesh to compare the result with, in metres and in the axes of the recording. Default: the simulated scene, if the
    recording was simulated."""

    def main(self) -> None:
        from trimesh import PointCloud

        from enerf_ns.export.packing import pack_run
        from enerf_ns.export.scoring import simulated_scene, surface_scores
        from enerf_ns.export.splats import encode_splats, splat_sizes
        from enerf_ns.export.surface import VOXEL_PIXELS, fused, pixel_size, points_of, surface_views
        from enerf_ns.method.runs import load
        from enerf_ns.report.run_files import read_run
        from enerf_ns.simulator.scene.scene_files import load_scene

        if self.voxel is not None and not 0.0 < self.voxel < np.inf:
            raise FlagError(f"--voxel is {self.voxel:g}, but must be metres above 0.")
        files = read_run(self.run)
        suffixes = SUFFIXES[self.what]
        output = absolute(self.output or files.config_file.parent / f"{self.what}{suffixes[0]}")
        if output.suffix not in suffixes:
            raise FlagError(f"--output {output} does not end with {' or '.join(suffixes)}; give a file that does.")
        if output.is_dir():
            raise OutputError(f"--output {output} is a folder; give the name of a file.")
        check_outside_recordings("--output", output, files.config.data, self.reference)
        if not files.stored:
            raise RecordingError(f"{files.config_file.parent} has no whole checkpoint; wait for one, or train again.")
        if self.what in ("poses", "run"):
            for flag, value in (("--voxel", self.voxel), ("--reference", self.reference)):
                if value is not None:
                    raise FlagError(f"{flag} is for meshes and points; leave it out.")
        if self.what == "run":
            config_file = pack_run(files.config, files.folder, output)
            print(printable(f"the run and its recording, {output.stat().st_size / 1e6:.1f} MB: {output}"))
            print(f"view it, where it was unpacked: ns-viewer --load-config {quoted(config_file)}")
            return
        if self.what == "poses":
            self._write_poses(load(files.config_file).pipeline, files.config_file, output)
            return
        notes: list[str] = []
        scene = load_scene(expanded(self.reference), np.random.default_rng(0), notes) if self.reference else None

        pipeline = load(files.config_file).pipeline
        path = pipeline.datamanager.recording.path
        scene = scene or simulated_scene(path, notes)
        camera, views = surface_views(pipeline)
        voxel = self.voxel or VOXEL_PIXELS * pixel_size(camera, views)
        surface = (fused if self.what == "mesh" else points_of)(camera, views, voxel)
        if not len(surface.vertices):
            raise RecordingError(
                f"{files.config_file.parent} shows no surface at voxels of {voxel:.3g} m; give another --voxel, or "
                "train it longer."
            )
        if self.what == "splats":
            assert isinstance(surface, PointCloud)
            content = encode_splats(surface, splat_sizes(surface.vertices, camera, views, voxel))
        else:
            content = surface.export(file_type=output.suffix[1:])
        assert isinstance(content, bytes)
        written, lines = {output.name: content}, []
        low, high = surface.bounds
        size = " x ".join(f"{side:.2f}" for side in high - low)
        lines.append(f"{len(surface.vertices):,} points, {size} m, voxels of {voxel:.3g} m: {output}")
        if scene is not None:
            scores = surface_scores(surface, scene, camera, [view.pose for view in views])
            table = {"reference": str(self.reference or path), "voxel": voxel, **asdict(scores)}
            written[f"{output.name}.json"] = (json.dumps(table, indent=2) + "\n").encode()
            lines.append(str(scores))
        _write(output, written)
        for line in [*(f"note: {note}" for note in notes), *lines]:
            print(printable(line))

    def _write_poses(self, pipeline: EnerfPipeline, config_file: Path, output: Path) -> None:
        from enerf_ns.dataparsers.formats.writer import camera_json, encode_tum
        from enerf_ns.poses.findings import findings

        recording = pipeline.datamanager.recording
        found = findings(pipeline.poses, pipeline.datamanager.distance)
        camera = {**camera_json(recording.camera), "corrections": [row.as_dict() for row in found]}
        about = (json.dumps(camera, indent=2) + "\n").encode()
        _write(output, {output.name: encode_tum(recording.trajectory, recording.zero), f"{output.name}.json": about})
        corrected = [f"{row.what}: {row.value}" for row in found if row.is_corrected]
        for line in corrected or ["No error of the poses was found. They are those of the recording."]:
            print(printable(line))
        print(printable(f"{len(recording.trajectory.times):,} poses: {output}"))
        print(
            f"a recording with them: enerf convert {quoted(recording.path)} --run {quoted(config_file)} "
            f"--output-dir {quoted(recording.path.with_name(f'{recording.path.name}-refined'))}"
        )


def _write(output: Path, files: dict[str, bytes]) -> None:
    """Writes the output and the files beside it.

    Raises:
        OutputError: They cannot be written.
    """
    try:
        write_together(output.parent, files)
    except OSError as error:
        raise OutputError(f"{output} cannot be written ({error.strerror}); give another --output.") from error
