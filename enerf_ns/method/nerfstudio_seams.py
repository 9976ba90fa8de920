"""The seams to Nerfstudio, viser, torch and tyro: all that this package uses of them beyond their public interfaces.

Functions here reach into a package where it has no public way. `SEAMS` lists these places, and those of overridden
methods and of the rooms below. tests/method/test_nerfstudio_seams.py walks the list: after an update of a package it
names each place that has moved.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import nerfstudio.engine.trainer  # noqa: F401 - before its writer, which would import it in a circle
import torch
from nerfstudio.model_components.ray_samplers import Sampler
from nerfstudio.utils import writer
from torch import Tensor
from torch.distributed import all_reduce, get_world_size
from torch.nn import Module, Parameter
from torch.nn.parallel import DistributedDataParallel

if TYPE_CHECKING:
    from nerfstudio.viewer.control_panel import ControlPanel
    from nerfstudio.viewer.render_state_machine import RenderStateMachine
    from nerfstudio.viewer.viewer import Viewer
    from viser import CameraHandle, ClientHandle


@dataclass(frozen=True)
class Seam:
    """A place in another package that its next version may change without notice."""

    place: str
    """Module, a colon, and the name in it, as `package.module:Class.attribute`."""
    use: str
    """The use that this package makes of the place, and the module that makes it."""
    parameters: tuple[str, ...] | None = None
    """Names of the parameters of a function or method; None for anything else."""


READ_IN = {"nerfstudio": "1.1.5", "viser": "0.2.7", "torch": "2.11.0", "tyro": "1.0.17"}
"""Version of each package in which its seams were read."""

SAMPLER_COUNTERS = ("_step", "_steps_since_update")

_TRAINER = "nerfstudio.engine.trainer:Trainer"
_EXPERIMENT = "nerfstudio.configs.experiment_config:ExperimentConfig"
_SAMPLERS = "nerfstudio.model_components.ray_samplers"
_RENDERER = "nerfstudio.viewer.render_state_machine:RenderStateMachine"
_PANEL = "nerfstudio.viewer.control_panel:ControlPanel"
_ENCODING = "nerfstudio.field_components.encodings:HashEncoding"
_HELP = "tyro._backends._tyro_help_formatting"

SEAMS = (
    # private methods that are overridden
    Seam(f"{_TRAINER}._after_train", "method.trainer ends an interrupted run here, and prints the end", ("self",)),
    Seam(f"{_TRAINER}._train_complete_viewer", "method.trainer waits later, after its last lines"),
    Seam(f"{_TRAINER}._update_viewer_state", "method.trainer lets the viewer look at the step by itself"),
    Seam(
        "nerfstudio.data.dataparsers.base_dataparser:DataParser._generate_dataparser_outputs",
        "dataparsers.event_dataparser makes the outputs of a recording",
        ("self", "split", "kwargs"),
    ),
    Seam(
        "nerfstudio.viewer.viewer_elements:ViewerControl._setup",
        "method.viewer.scene_view starts here; the viewer finds it among the attributes of the pipeline",
        ("self", "viewer"),
    ),
    Seam(f"{_RENDERER}.run", "method.viewer.view_renderer renders in a loop of its own", ("self",)),
    Seam(f"{_RENDERER}.action", "method.viewer.view_renderer takes note of moves", ("self", "action")),
    Seam(
        f"{_RENDERER}._send_output_to_viewer",
        "method.viewer.view_renderer sends a picture",
        ("self", "outputs", "static_render"),
    ),
    # public methods that are overridden, and that Nerfstudio's commands call for something else
    Seam(f"{_EXPERIMENT}.save_config", "method.trainer resolves the config and prints its tables here", ("self",)),
    Seam(f"{_EXPERIMENT}.print_to_terminal", "method.trainer prints nothing here", ("self",)),
    Seam(
        f"{_EXPERIMENT}.get_checkpoint_dir", "method.trainer sets load_step here, for Nerfstudio's commands", ("self",)
    ),
    Seam(
        "nerfstudio.engine.optimizers:Optimizers.optimizer_scaler_step_some",
        "method.guarded_steps leaves out a step that is not finite",
        ("self", "grad_scaler", "param_groups"),
    ),
    Seam(f"{_ENCODING}.pytorch_fwd", "kernels.fast_hash_encoding computes the encoding", ("self", "in_tensor")),
    # attributes that no documentation names
    Seam(f"{_TRAINER}._start_step", "method.trainer reads the step that training begins at"),
    Seam(f"{_TRAINER}.callbacks", "method.trainer adds the scores at the end"),
    Seam(f"{_TRAINER}.viewer_state", "method.trainer prints the address of the viewer"),
    Seam(f"{_TRAINER}.stop_training", "method.trainer stops after a signal"),
    Seam(
        "nerfstudio.pipelines.base_pipeline:VanillaPipeline._model",
        "method.pipeline puts the model into DistributedDataParallel, since Nerfstudio takes every device for a GPU",
    ),
    Seam(
        "nerfstudio.data.utils.dataloaders:EvalDataloader.cameras",
        "method.datamanager replaces the cameras when poses are corrected",
    ),
    Seam("nerfstudio.configs.dataparser_configs:all_dataparsers", "method.datamanager offers the formats as commands"),
    Seam("nerfstudio.utils.writer:EVENT_WRITERS", "start_new_logs, flush_tensorboard"),
    Seam("nerfstudio.utils.writer:EVENT_STORAGE", "start_new_logs"),
    Seam("nerfstudio.utils.writer:TensorboardWriter.tb_writer", "flush_tensorboard"),
    *(Seam(f"{_SAMPLERS}:ProposalNetworkSampler.{name}", "sampler_counters") for name in SAMPLER_COUNTERS),
    Seam(f"{_SAMPLERS}:ProposalNetworkSampler.pdf_sampler", "rendering.ray_samplers samples without counting steps"),
    Seam(
        f"{_SAMPLERS}:ProposalNetworkSampler.initial_sampler", "rendering.ray_samplers samples without counting steps"
    ),
    Seam(f"{_SAMPLERS}:PDFSampler.histogram_padding", "rendering.ray_samplers pads weights as Nerfstudio does"),
    Seam(f"{_SAMPLERS}:SpacedSampler.spacing_fn", "rendering.ray_samplers spaces samples as Nerfstudio does"),
    Seam(f"{_SAMPLERS}:SpacedSampler.spacing_fn_inv", "rendering.ray_samplers spaces samples as Nerfstudio does"),
    *(Seam(f"{_RENDERER}.{name}", "method.viewer.view_renderer") for name in ("check_interrupt", "client")),
    *(Seam(f"{_RENDERER}.{name}", "replace_renderer") for name in ("running", "render_trigger")),
    *(
        Seam(f"nerfstudio.viewer_legacy.server.viewer_utils:{name}", "method.viewer.view_renderer interrupts a render")
        for name in ("SetTrace", "IOChangeException")
    ),
    Seam("nerfstudio.viewer.viewer:Viewer.make_stats_markdown", "method.viewer.view_renderer says the step"),
    Seam("nerfstudio.viewer.viewer:Viewer.render_statemachines", "replace_renderer, method.viewer.scene_view"),
    *(
        Seam(f"nerfstudio.viewer.viewer:Viewer.{name}", "method.viewer.scene_view")
        for name in ("last_move_time", "stats_markdown", "pause_train", "resume_train")
    ),
    *(Seam(f"{_PANEL}.{name}", "tidy_control_panel") for name in ("_max_res", "_train_speed", "_train_util")),
    Seam("viser._viser:CameraHandle._state", "replace_camera_callbacks"),
    Seam("viser.infra._infra:WebsockServer.start", "method.viewer.guard", ("self",)),
    Seam("viser.infra._infra:WebsockServer._http_server_root", "method.viewer.guard serves the page alone"),
    Seam(
        "viser.infra._infra:WebsockMessageHandler._handle_incoming_message",
        "method.viewer.guard leaves out impossible cameras",
        ("self", "client_id", "message"),
    ),
    Seam("viser:GuiApi._handle_gui_updates", "method.viewer.guard checks values", ("self", "client_id", "message")),
    Seam("viser:GuiApi._handle_file_transfer_start", "method.viewer.guard takes no files"),
    Seam("viser:GuiApi._gui_input_handle_from_id", "method.viewer.guard"),
    Seam("viser._gui_handles:_GuiInputHandle._impl", "method.viewer.guard"),
    Seam("viser._gui_handles:_GuiHandleState.message_type", "method.viewer.guard tells text from other inputs"),
    Seam("viser._viser:_CameraHandleState.camera_cb", "replace_camera_callbacks"),
    *(
        Seam(f"{_ENCODING}.{name}", "kernels.fast_hash_encoding; it also sets the class of encodings that exist")
        for name in ("hash_table", "scalings", "tcnn_encoding")
    ),
    Seam("nerfstudio.field_components.mlp:MLP.layers", "kernels.network and network_numba read the weights"),
    Seam("nerfstudio.utils.rich_utils:CONSOLE", "terminal.without_chatter replaces print and log within a block"),
    *(Seam(f"torch.optim.adam:Adam.{name}", "leave_out_fused_step") for name in ("found_inf", "grad_scale")),
    Seam(
        "torch.nn.parallel:DistributedDataParallel._set_params_and_buffers_to_ignore_for_model",
        "leave_out_of_parallel; average_left_out reads _ddp_ignored, which it sets",
        ("module", "params_and_buffers_to_ignore"),
    ),
    # without which flags.speak_for_methods leaves help and errors to tyro
    Seam(
        f"{_HELP}:format_help",
        "flags groups the flags of this package's methods",
        ("prog", "parser_spec", "args", "subparser_frontier", "verbose"),
    ),
    Seam(
        f"{_HELP}:unrecognized_args_error",
        "flags names the nearest flag",
        (
            *("prog", "unrecognized_args_and_progs", "subparser_frontier", "args", "parser_spec"),
            *("console_outputs", "add_help"),
        ),
    ),
    Seam("tyro._docstrings:parse_docstring_from_object", "flags joins the lines of help", ("obj",)),
    Seam("tyro._arguments:generate_argument_helptext", "flags shows the text of a flag", ("arg", "lowered", "compact")),
)
"""All seams, those of this module and those of others."""


def start_new_logs() -> None:
    """Ends the logs of all runs before in this process, so that the next run writes to its own alone.

    Nerfstudio 1.1.5 keeps its writers, and what they have not yet written, in lists of the module
    `nerfstudio.utils.writer`. It only adds to them, since `ns-train` trains one run a process.
    """
    writer.EVENT_WRITERS.clear()
    writer.EVENT_STORAGE.clear()


def flush_tensorboard() -> None:
    """Stores what was logged for TensorBoard.

    Nerfstudio 1.1.5 writes to its `SummaryWriter`, which stores every two minutes, and has no function that flushes it.
    """
    writer.write_out_storage()
    for log in writer.EVENT_WRITERS:
        if isinstance(log, writer.TensorboardWriter):
            log.tb_writer.flush()


def sampler_counters(sampler: Sampler) -> dict[str, int]:
    """The counters of steps in a proposal sampler, by name; empty for other samplers.

    They decide in which steps the proposal network learns. Nerfstudio 1.1.5 neither stores nor shows them, so that a
    run that is continued would learn in other steps.
    """
    return {name: value for name, value in vars(sampler).items() if name in SAMPLER_COUNTERS}


def set_sampler_counters(sampler: Sampler, counters: Mapping[str, int]) -> None:
    """Sets the counters that `sampler_counters` gave (Nerfstudio 1.1.5)."""
    vars(sampler).update(counters)


def leave_out_fused_step(optimizer: torch.optim.Optimizer, left_out: Tensor) -> None:
    """Makes the next step of a fused Adam change nothing if a boolean on its device is true.

    The fused kernels of torch 2.11 read these two attributes, by which GradScaler leaves out steps. There is no public
    way to do so without a GradScaler, but to wait for the boolean, in which time a GPU idles.
    """
    optimizer.found_inf = left_out.float()  # type: ignore[attr-defined]
    optimizer.grad_scale = None  # type: ignore[attr-defined]


def leave_out_of_parallel(model: Module, modules: tuple[str, ...]) -> None:
    """Makes DistributedDataParallel leave out the parameters of some modules of a model, which it is then to wrap.

    Parameters that are used outside the forward pass of the model make it fail. torch 2.11 has no public way to leave
    them out. `average_left_out` averages their gradients in its place.

    Args:
        model: The model; every process starts with equal parameters in these modules.
        modules: Names of attributes of the model.
    """
    left_out = [name for name, _ in model.named_parameters() if name.partition(".")[0] in modules]
    DistributedDataParallel._set_params_and_buffers_to_ignore_for_model(model, left_out)


def average_left_out(parameters: Iterable[Parameter]) -> None:
    """Averages, over all processes, the gradients of those parameters that `leave_out_of_parallel` left out."""
    for parameter in parameters:
        if parameter.grad is not None and getattr(parameter, "_ddp_ignored", False):
            all_reduce(parameter.grad)
            parameter.grad /= get_world_size()


def tidy_control_panel(panel: ControlPanel, max_width: int) -> None:
    """Sets "Max res" (pixels), and hides the controls that have no effect.

    "Train Speed" sets "Max res" and "Train Util", which nothing reads. The panel of Nerfstudio 1.1.5 has no setter for
    the first, and no way to leave out the others.
    """
    panel._max_res.value = max_width
    panel._train_speed.set_hidden(True)
    panel._train_util.set_hidden(True)
    panel.update_control_panel()


def replace_renderer(viewer: Viewer, client: ClientHandle, renderer: RenderStateMachine) -> None:
    """Stops the thread that renders for a browser before it has rendered anything, and puts another in its place.

    The viewer of Nerfstudio 1.1.5 makes one of its own class for each browser, whose class cannot be chosen.
    """
    own = viewer.render_statemachines[client.client_id]
    own.running = False
    own.render_trigger.set()  # for which it waits
    viewer.render_statemachines[client.client_id] = renderer


def replace_camera_callbacks(client: ClientHandle, callback: Callable[[CameraHandle], None]) -> None:
    """Calls one function alone when a browser says where its camera is.

    Nerfstudio 1.1.5 registers a callback that fails for a browser that has gone, with viser's lock in hand. Nobody
    gives the lock back then: no message is sent any more, and Python does not end. viser 0.2.7 has no way to remove a
    callback.
    """
    client.camera._state.camera_cb.clear()
    client.camera.on_update(callback)
