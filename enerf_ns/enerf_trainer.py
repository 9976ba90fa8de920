"""Training as a person sees it: what the recording holds at the start, where everything lies at the end."""

from __future__ import annotations

import json
import shlex
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Optional, Type  # noqa: UP035 - tyro reads these annotations on Python 3.10

from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE
from rich.table import Table

from enerf_ns.choices import Choice, absolute, fill_in_choices
from enerf_ns.dataparsers.errors import RecordingError, UserError
from enerf_ns.dataparsers.event_dataparser import EventDataParser, scene_normalisation
from enerf_ns.dataparsers.indexing import index_events
from enerf_ns.dataparsers.problems import find_problems
from enerf_ns.dataparsers.recording import EventRecording
from enerf_ns.enerf_pipeline import EnerfPipelineConfig
from enerf_ns.paper_selections import PresetName, apply_preset


@dataclass
class EnerfTrainerConfig(TrainerConfig):
    """Nerfstudio's trainer; reads and checks the recording before anything is written."""

    _target: Type = field(default_factory=lambda: EnerfTrainer)  # noqa: UP006
    pipeline: EnerfPipelineConfig = field(default_factory=EnerfPipelineConfig)
    preset: Optional[PresetName] = None  # noqa: UP045
    """The selections of the E-NeRF paper for one of its sequences; flags that are set stand."""

    def prepare(self) -> tuple[EventRecording, list[str], list[Choice]]:
        """Read the recording and fill in what is open: paths, decay of the learning rate, preset, choices.

        Returns:
            The recording, what to say about the preset, and the choices.

        Raises:
            RecordingError: if the recording cannot be used. Nothing has been written then.
        """
        manager = self.pipeline.datamanager
        if self.data is None:
            self.data = manager.data
        if self.data is None and manager.dataparser.data != Path():
            self.data = manager.dataparser.data
        if self.data is None:
            raise RecordingError("--data is missing; give the folder of a recording")
        self.data = manager.data = manager.dataparser.data = absolute(self.data)
        self.output_dir = absolute(self.output_dir)
        for group in self.optimizers.values():
            group["scheduler"].max_steps = group["scheduler"].max_steps or self.max_num_iterations
        recording = EventDataParser(manager.dataparser).recording()
        selection: list[str] = []
        if self.preset is not None:
            from enerf_ns.enerf_config import METHODS  # here, since it imports this module

            selection = apply_preset(self, METHODS[self.method_name], recording)
            recording = EventDataParser(manager.dataparser).recording()
        choices = fill_in_choices(self.pipeline, recording)
        index_events(recording)
        return recording, selection, choices

    def save_config(self) -> None:
        """Show what the recording holds and what is made of it, then store both with the run."""
        try:
            recording, selection, choices = self.prepare()
        except UserError as error:
            raise SystemExit(f"enerf: {error}") from error
        CONSOLE.print(recording_table(recording, self))
        for line in selection:
            CONSOLE.print(f"* {line}", highlight=False)
        CONSOLE.print(choices_table(choices))
        super().save_config()
        (self.get_base_dir() / "choices.json").write_text(json.dumps([asdict(choice) for choice in choices], indent=2))


class EnerfTrainer(Trainer):
    """Nerfstudio's trainer, ending with a list of what was made."""

    config: EnerfTrainerConfig

    def setup(self, test_mode="val") -> None:
        self.config.prepare()
        super().setup(test_mode)

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


def recording_table(recording: EventRecording, config: EnerfTrainerConfig) -> Table:
    """What the recording holds."""
    index, camera = index_events(recording), recording.camera
    first, last = index.span
    seconds = max(last - first, 1) * 1e-9
    parser = config.pipeline.datamanager.dataparser
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


def choices_table(choices: list[Choice]) -> Table:
    """What is kept and what is left out, and why."""
    table = Table(title="Parts of the method", title_justify="left")
    for column in ("part", "", "what", "why"):
        table.add_column(column)
    for choice in choices:
        table.add_row(
            choice.part, "[green]kept[/green]" if choice.kept else "[dim]left out[/dim]", choice.value, choice.why
        )
    return table
