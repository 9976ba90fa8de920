"""The networks E2VID and FireNet, which reconstruct frames from events.

Names and shapes of the layers are those of the published checkpoints.

Rebecq et al., High Speed and High Dynamic Range Video with an Event Camera, TPAMI 2020; Scheerlinck et al., Fast Image
Reconstruction with an Event Camera, WACV 2020.
"""

from __future__ import annotations

import re
import tarfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import reading

State = tuple[Tensor, ...]
"""State of a recurrent layer: tensors [batch, channels, height, width], of which the first is also its output."""


class ConvGRU(nn.Module):
    """Convolutional gated recurrent unit (Ballas et al., ICLR 2016)."""

    def __init__(self, channels: int):
        super().__init__()
        self.reset_gate, self.update_gate, self.out_gate = (
            nn.Conv2d(2 * channels, channels, 3, padding=1) for _ in range(3)
        )

    def forward(self, x: Tensor, state: State | None) -> State:
        hidden = state[0] if state else torch.zeros_like(x)
        both = torch.cat([x, hidden], dim=1)
        update, reset = self.update_gate(both).sigmoid(), self.reset_gate(both).sigmoid()
        candidate = self.out_gate(torch.cat([x, reset * hidden], dim=1)).tanh()
        return (torch.lerp(hidden, candidate, update),)


class ConvLSTM(nn.Module):
    """Convolutional long short-term memory (Shi et al., NeurIPS 2015), without peepholes."""

    def __init__(self, channels: int):
        super().__init__()
        self.Gates = nn.Conv2d(2 * channels, 4 * channels, 3, padding=1)

    def forward(self, x: Tensor, state: State | None) -> State:
        hidden, cell = state or (torch.zeros_like(x), torch.zeros_like(x))
        write, keep, show, candidate = self.Gates(torch.cat([x, hidden], dim=1)).chunk(4, dim=1)
        cell = keep.sigmoid() * cell + write.sigmoid() * candidate.tanh()
        return show.sigmoid() * cell.tanh(), cell


class Convolution(nn.Module):
    """A convolution, optionally followed by batch normalisation and ReLU."""

    def __init__(
        self, inputs: int, outputs: int, size: int, stride: int = 1, batch_norm: bool = False, relu: bool = True
    ):
        super().__init__()
        self.conv2d = nn.Conv2d(inputs, outputs, size, stride, padding=size // 2, bias=not batch_norm)
        self.norm_layer = nn.BatchNorm2d(outputs) if batch_norm else nn.Identity()
        self.relu = relu

    def forward(self, x: Tensor) -> Tensor:
        x = self.norm_layer(self.conv2d(x))
        return x.relu() if self.relu else x


class Upsampling(Convolution):
    """Enlarges a picture to twice its size, then applies a convolution."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(functional.interpolate(x, scale_factor=2.0, mode="bilinear"))


class TransposedConvolution(nn.Module):
    """A transposed convolution to twice the size, optional batch normalisation, and ReLU."""

    def __init__(self, inputs: int, outputs: int, size: int, batch_norm: bool):
        super().__init__()
        self.transposed_conv2d = nn.ConvTranspose2d(inputs, outputs, size, 2, size // 2, 1, bias=not batch_norm)
        self.norm_layer = nn.BatchNorm2d(outputs) if batch_norm else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        return self.norm_layer(self.transposed_conv2d(x)).relu()


class Residual(nn.Module):
    """Two convolutions with a skip connection (He et al., CVPR 2016)."""

    def __init__(self, channels: int, batch_norm: bool = False):
        super().__init__()
        self.conv1, self.conv2 = (nn.Conv2d(channels, channels, 3, padding=1, bias=not batch_norm) for _ in range(2))
        self.bn1, self.bn2 = (nn.BatchNorm2d(channels) if batch_norm else nn.Identity() for _ in range(2))

    def forward(self, x: Tensor) -> Tensor:
        return (x + self.bn2(self.conv2(self.bn1(self.conv1(x)).relu()))).relu()


class Recurrent(nn.Module):
    """A layer followed by a recurrent layer."""

    def __init__(self, conv: nn.Module, recurrent_block: nn.Module):
        super().__init__()
        self.conv, self.recurrent_block = conv, recurrent_block

    def forward(self, x: Tensor, state: State | None) -> State:
        return self.recurrent_block(self.conv(x), state)


class FireNet(nn.Module):
    """Two recurrent layers and a residual block, all at full resolution."""

    name = "FireNet"
    size_multiple = 1
    """Factor that must divide width and height."""

    def __init__(self, num_bins: int, channels: int):
        super().__init__()
        self.num_bins = num_bins
        self.head = Recurrent(Convolution(num_bins, channels, 3), ConvGRU(channels))
        self.resblocks = nn.ModuleList([Recurrent(Residual(channels), ConvGRU(channels)), Residual(channels)])
        self.pred = Convolution(channels, 1, 1, relu=False)

    def forward(
        self, grid: Float[Tensor, "batch num_bins height width"], states: Sequence[State] | None
    ) -> tuple[Float[Tensor, "batch height width"], list[State]]:
        """The frame at the end of a window, in about [0, 1].

        Args:
            grid: Normalised voxel grid.
            states: States after the window before; None for the first window.

        Returns:
            The frame, and the states after this window.
        """
        first, second = states or (None, None)
        first = self.head(grid, first)
        second = self.resblocks[0](first[0], second)
        return self.pred(self.resblocks[1](second[0]))[:, 0], [first, second]


class E2VID(nn.Module):
    """A U-Net whose encoders are recurrent."""

    name = "E2VID"

    def __init__(
        self,
        num_bins: int,
        channels: int,
        num_encoders: int,
        num_residual_blocks: int,
        batch_norm: bool,
        transposed: bool,
    ):
        super().__init__()
        self.num_bins, self.size_multiple = num_bins, 2**num_encoders
        self.head = Convolution(num_bins, channels, 5)
        widths = [channels * 2**level for level in range(num_encoders + 1)]
        self.encoders = nn.ModuleList(
            Recurrent(Convolution(inputs, 2 * inputs, 5, 2, batch_norm), ConvLSTM(2 * inputs)) for inputs in widths[:-1]
        )
        self.resblocks = nn.Sequential(*(Residual(widths[-1], batch_norm) for _ in range(num_residual_blocks)))
        self.decoders = nn.ModuleList(
            TransposedConvolution(inputs, inputs // 2, 5, batch_norm)
            if transposed
            else Upsampling(inputs, inputs // 2, 5, batch_norm=batch_norm)
            for inputs in widths[:0:-1]
        )
        self.pred = Convolution(channels, 1, 1, batch_norm=batch_norm, relu=False)

    def forward(
        self, grid: Float[Tensor, "batch num_bins height width"], states: Sequence[State] | None
    ) -> tuple[Float[Tensor, "batch height width"], list[State]]:
        """The frame at the end of a window, in [0, 1], and the states; for the arguments see `FireNet.forward`."""
        x = head = self.head(grid)
        new_states: list[State] = []
        for encoder, state in zip(self.encoders, states or [None] * len(self.encoders), strict=True):
            new_states.append(encoder(x, state))
            x = new_states[-1][0]
        x = self.resblocks(x)
        for decoder, skipped in zip(self.decoders, reversed(new_states), strict=True):
            x = decoder(x + skipped[0])
        return self.pred(x + head).sigmoid()[:, 0], new_states


Network = FireNet | E2VID


def load_network(path: Path) -> Network:
    """The network of a checkpoint, in evaluation mode. Its type and size are inferred from the layers.

    Args:
        path: A state dict written by `torch.save`, or a dict with a state dict under "state_dict". Code in the file is
            not run.

    Raises:
        RecordingError: The file is missing, is no checkpoint, holds another network, or holds more than tensors and
            plain values.
    """
    layers = _read_layers(path)
    try:
        network = _network_for(layers)
        network.load_state_dict(layers)
    except (KeyError, ValueError, RuntimeError) as error:
        raise RecordingError(
            f"{path} holds the weights of another network (the first of {len(layers)} tensors is "
            f"{next(iter(layers), 'missing')}); give those of E2VID or FireNet as their authors published them."
        ) from error
    return network.eval()


def _read_layers(path: Path) -> dict[str, Tensor]:
    """The tensors of a checkpoint by name, without the name of a module around the network."""
    try:
        with reading(path, "a checkpoint of PyTorch"):
            if tarfile.is_tarfile(path):
                raise ValueError("it is a tar archive, as PyTorch wrote before version 0.1.10")
            content = torch.load(path, map_location="cpu", weights_only=True)
    except RecordingError as error:
        if foreign := re.search(r"GLOBAL (\S+)", str(error.__cause__)):
            raise RecordingError(
                f"{path} holds more than weights ({foreign[1]}), which can run code when it is loaded and is therefore "
                "refused; give a file with the network's state dict alone."
            ) from error
        raise
    state = content.get("state_dict", content) if isinstance(content, dict) else {}
    named = state.items() if isinstance(state, dict) else []
    tensors = {name: value for name, value in named if isinstance(value, Tensor)}
    return {re.sub(r"^\w+\.(?=(head|encoders|resblocks|decoders|pred)\.)", "", name): tensors[name] for name in tensors}


def _network_for(layers: Mapping[str, Tensor]) -> Network:
    """The network with layers of these shapes; raises KeyError or ValueError if there is none."""
    if "head.conv.conv2d.weight" in layers:
        channels, num_bins, *_ = layers["head.conv.conv2d.weight"].shape
        return FireNet(num_bins, channels)
    channels, num_bins, *_ = layers["head.conv2d.weight"].shape
    kinds = [name.split(".") for name in layers]
    return E2VID(
        num_bins,
        channels,
        num_encoders=len({kind[1] for kind in kinds if kind[0] == "encoders"}),
        num_residual_blocks=len({kind[1] for kind in kinds if kind[0] == "resblocks"}),
        batch_norm="pred.norm_layer.weight" in layers,
        transposed="decoders.0.transposed_conv2d.weight" in layers,
    )
