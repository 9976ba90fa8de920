"""Training as a person sees it: what the recording holds at the start, where everything lies at the end."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Optional, Type  # noqa: UP035 - tyro reads these annotations on Python 3.10

from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE
from rich.table import Table

from enerf_ns.choices import Choice, resolve
from enerf_ns.dataparsers.errors import FlagError, exit_with_a_sentence
from enerf_ns.dataparsers.files import write_whole
from enerf_ns.dataparsers.indexing import index_events
from enerf_ns.dataparsers.problems import find_problems
from enerf_ns.dataparsers.recording import EventRecording
from enerf_ns.dataparsers.scene_box import scene_normalisation
from enerf_ns.enerf_pipeline import EnerfPipeline, EnerfPipelineConfig
from enerf_ns.probe import view_direction_gain
from enerf_ns.ranges import check_ranges


@dataclass
class EnerfTrainerConfig(TrainerConfig):
    """Nerfstudio's trainer; reads and checks the recording before anything is written."""

    _target: Type = field(default_factory=lambda: EnerfTrainer)  # noqa: UP006
    pipeline: EnerfPipelineConfig = field(default_factory=EnerfPipelineConfig)
    preset: Optional[str] = None  # noqa: UP045
    """The selections of the E-NeRF paper for one of its sequences; flags that are set stand. One of eds00, eds11,
    mocap-1d-trans, mocap-desk2, mocap-desk2-6views, shake-carpet1, shake-moon1, shake-moon2, spiral1, spiral1-sparse,
    spiral1-more-sparse, spiral2."""

    def resolved(self) -> EnerfTrainerConfig:
        """A copy with absolute paths, with the length of the learning rates' decay, and with what is chosen for the
        recording (`pipeline.resolution`), whose events are read and checked.

        Raises:
            RecordingError: The recording cannot be used.
            FlagError: A setting cannot be followed.
        """
        check_ranges(self)
        config = deepcopy(self)
        pipeline, parser = config.pipeline, config.pipeline.datamanager.dataparser
        data = self.data or pipeline.datamanager.data or (parser.data if parser.data != Path() else None)
        if data is None:
            raise FlagError("--data is missing; give the folder of a recording")
        config.data = pipeline.datamanager.data = parser.data = data.expanduser().resolve()
        config.output_dir = self.output_dir.expanduser().resolve()
        for group in config.optimizers.values():
            group["scheduler"].max_steps = group["scheduler"].max_steps or self.max_num_iterations
        if not pipeline.resolution.choices:
            recording = parser.setup().recording()
            optimizer, device = config.optimizers["fields"]["optimizer"], config.machine.device_type
            pipeline.resolution = resolve(
                pipeline, recording, self.preset, lambda filled: view_direction_gain(filled, optimizer, device)
            )
        index_events(config.recording())
        return config

    def recording(self) -> EventRecording:
        """The recording that is learnt from, of a config that is resolved."""
        return self.pipeline.resolution.applied_to(self.pipeline).datamanager.dataparser.setup().recording()

    def save_config(self) -> None:
        """Show what the recording holds and what is made of it, then store both with the run."""
        with exit_with_a_sentence():
            config = self.resolved()
            CONSOLE.print(recording_table(config))
        resolution = config.pipeline.resolution
        for line in resolution.selection:
            CONSOLE.print(f"* {line}", highlight=False, markup=False)
        CONSOLE.print(choices_table(resolution.choices))
        super(EnerfTrainerConfig, config).save_config()
        choices = [asdict(choice) for choice in resolution.choices]
        write_whole(config.get_base_dir() / "choices.json", json.dumps(choices, indent=2))

    def setup(self, **kwargs: Any) -> EnerfTrainer:
        """The trainer, of what this config comes to on its recording."""
        with exit_with_a_sentence():
            return self._target(self.resolved(), **kwargs)


class EnerfTrainer(Trainer):
    """Nerfstudio's trainer, ending with a list of what was made."""

    config: EnerfTrainerConfig
    pipeline: EnerfPipeline

    def _after_train(self) -> None:
        super()._after_train()
        config = shlex.quote(str(self.base_dir / "config.yml"))
        CONSOLE.rule("Training is done")
        for what, where in {
            "checkpoint": str(self.checkpoint_dir),
            "scores, picture and video": f"enerf report {config}",
            "scores alone": f"ns-eval --load-config {config} --output-path scores.json",
            "video of your own": f"ns-render interpolate --load-config {config} --output-path video.mp4",
            "look around": f"ns-viewer --load-config {config}",
        }.items():
            CONSOLE.print(f"[bold]{what}:[/bold] {where}", soft_wrap=True, highlight=False)


def recording_table(config: EnerfTrainerConfig) -> Table:
    """What the recording of a resolved config holds."""
    recording = config.recording()
    index, camera = index_events(recording), recording.camera
    first, last = index.span
    seconds = max(last - first, 1) * 1e-9
    parser = config.pipeline.resolution.applied_to(config.pipeline).datamanager.dataparser
    depth = parser.depth_range
    rows = {
        "folder": f"{recording.path} ({recording.format})",
        "events": f"{len(index):,}, {100 * index.num_positive / len(index):.0f} % on",
        "span": f"{seconds:.2f} s",
        "rate": f"{len(index) / seconds / 1e6:.2f} million events/s, "
        f"{len(index) / (camera.width * camera.height):.1f} a pixel",
        "sensor": f"{camera.width} x {camera.height}, {camera.model}",
        "poses": f"{len(recording.trajectory.times):,}",
    }
    for name, frames in {"frames": recording.frames, "blurred frames": recording.blurred_frames}.items():
        if frames is None:
            rows[name] = "none"
            continue
        depth_note = ", with depth" if frames.depth_filenames else ""
        rows[name] = f"{len(frames.times)}, {frames.camera.width} x {frames.camera.height}{depth_note}"
    if depth is not None:
        _, scale, box = scene_normalisation(recording, *depth, parser.box)
        rows["depths"] = f"{depth[0]:.2f} m to {depth[1]:.2f} m"
        rows["box"] = " x ".join(f"{side:.2f}" for side in (box[1] - box[0]) / scale) + " m"
    table = Table(title="Recording", show_header=False, title_justify="left")
    for name, value in rows.items():
        table.add_row(name, value)
    for note in (*recording.notes, *index.notes):
        table.add_row("note", f"[yellow]{note}[/yellow]")
    for problem in find_problems(recording, depth):
        table.add_row("[red]problem[/red]", f"[red]{problem.what}[/red] {problem.advice}")
    return table


def choices_table(choices: Sequence[Choice]) -> Table:
    """What is kept and what is left out, why, and by which flag it is forced."""
    prefix = "--pipeline."
    table = Table(title="Parts of the method", caption=f"forced by {prefix}FLAG VALUE, those of event-data at the end")
    table.title_justify = table.caption_justify = "left"
    for column in ("part", "", "what", "why", "flag"):
        table.add_column(column)
    for choice in choices:
        kept = "[green]kept[/green]" if choice.kept else "[dim]left out[/dim]"
        table.add_row(choice.part, kept, choice.value, choice.why, f"[dim]{choice.flag.removeprefix(prefix)}[/dim]")
    return table
