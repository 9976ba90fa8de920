"""E2VID and FireNet against their equations in loops, their published sizes and shapes, and files that are not them."""

from __future__ import annotations

import io
import os
import pickle
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.reconstruction.networks import E2VID, ConvGRU, ConvLSTM, FireNet, Residual, load_network


def convolved(layer: nn.Conv2d, x: np.ndarray) -> np.ndarray:
    """A 3 x 3 convolution in loops; beyond the border there are zeros."""
    assert layer.bias is not None
    weight, bias = layer.weight.detach().double().numpy(), layer.bias.detach().double().numpy()
    _, height, width = x.shape
    padded = np.pad(x, ((0, 0), (1, 1), (1, 1)))
    result = np.zeros((len(bias), height, width))
    for channel in range(len(bias)):
        for row in range(height):
            for column in range(width):
                seen = padded[:, row : row + 3, column : column + 3]
                result[channel, row, column] = bias[channel] + (weight[channel] * seen).sum()
    return result


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def inputs(number: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.normal(size=(2, 3, 4)) for _ in range(number)]


def tensor(x: np.ndarray) -> Tensor:
    return torch.from_numpy(x).float()[None]


def close(found: Tensor, expected: np.ndarray) -> None:
    np.testing.assert_allclose(found.detach().numpy()[0], expected, rtol=0, atol=1e-5)


@torch.no_grad()
def test_gated_recurrent_unit():
    torch.manual_seed(0)
    layer = ConvGRU(2)
    hidden, state = np.zeros((2, 3, 4)), None
    for x in inputs(3):
        both = np.concatenate([x, hidden])
        update, reset = sigmoid(convolved(layer.update_gate, both)), sigmoid(convolved(layer.reset_gate, both))
        candidate = np.tanh(convolved(layer.out_gate, np.concatenate([x, reset * hidden])))
        hidden = (1 - update) * hidden + update * candidate
        state = layer(tensor(x), state)
        close(state[0], hidden)


@torch.no_grad()
def test_long_short_term_memory():
    torch.manual_seed(0)
    layer = ConvLSTM(2)
    hidden = cell = np.zeros((2, 3, 4))
    state = None
    for x in inputs(3):
        gates = convolved(layer.Gates, np.concatenate([x, hidden]))
        write, keep, show = (sigmoid(gates[2 * i : 2 * i + 2]) for i in range(3))
        cell = keep * cell + write * np.tanh(gates[6:])
        hidden = show * np.tanh(cell)
        state = layer(tensor(x), state)
        close(state[0], hidden)
        close(state[1], cell)


@torch.no_grad()
def test_residual_block():
    torch.manual_seed(0)
    layer = Residual(2)
    (x,) = inputs(1)
    inner = convolved(layer.conv2, np.maximum(convolved(layer.conv1, x), 0))
    close(layer(tensor(x)), np.maximum(x + inner, 0))


def e2vid(**changes: Any) -> E2VID:
    torch.manual_seed(0)
    settings: dict[str, Any] = dict(num_encoders=3, num_residual_blocks=2, batch_norm=False, transposed=False)
    network = E2VID(num_bins=5, channels=4, **{**settings, **changes})
    for value in network.buffers():
        if value.is_floating_point():
            value.uniform_(0.5, 1.5)
    return network


def firenet() -> FireNet:
    torch.manual_seed(0)
    return FireNet(5, 16)


def test_they_are_as_large_as_published():
    """The file of FireNet holds 37,777 parameters; papers that compare with E2VID state 10.7 million."""
    assert sum(parameter.numel() for parameter in firenet().parameters()) == 37_777
    network = E2VID(5, 32, 3, 2, batch_norm=True, transposed=False)
    assert round(sum(parameter.numel() for parameter in network.parameters()) / 1e6, 1) == 10.7


@torch.no_grad()
@pytest.mark.parametrize("network", [firenet(), e2vid(), e2vid(transposed=True, num_encoders=2)])
def test_frames_depend_on_what_was_before(network: FireNet | E2VID):
    size = 2 * network.size_multiple, 3 * network.size_multiple
    first, second = torch.randn(2, 1, 5, *size)
    frame, states = network(first, None)
    alone, _ = network(second, None)
    after, _ = network(second, states)
    assert frame.shape == after.shape == (1, *size)
    assert (after - alone).abs().max() > 1e-4
    if isinstance(network, E2VID):
        assert 0 < after.min() and after.max() < 1


# ------------------------------------------------------------------------------------------------------- checkpoints


def saved(path: Path, network: nn.Module, prefix: str, **format: Any) -> Path:
    """As the authors published them: the state dict of a module around the network, and more beside."""
    state = {prefix + name: value for name, value in network.state_dict().items()}
    torch.save({"arch": "any", "epoch": 3, "config": {"gpu": [0]}, "state_dict": state}, path, **format)
    return path


@torch.no_grad()
@pytest.mark.parametrize(
    ("network", "prefix"),
    [
        (firenet(), "net."),
        (firenet(), ""),
        (e2vid(), "unetrecurrent."),
        (e2vid(batch_norm=True), "unetrecurrent."),
        (e2vid(transposed=True, num_encoders=4, num_residual_blocks=1), ""),
        (e2vid(transposed=True, batch_norm=True), "unetrecurrent."),
    ],
)
def test_a_checkpoint_tells_its_network(tmp_path: Path, network: FireNet | E2VID, prefix: str):
    found = load_network(saved(tmp_path / "weights.pth", network, prefix))
    assert type(found) is type(network) and not found.training
    grid = torch.randn(1, 5, 32, 48)
    torch.testing.assert_close(found(grid, None)[0], network.eval()(grid, None)[0], rtol=0, atol=0)


def test_a_bare_state_dict(tmp_path: Path):
    torch.save(firenet().state_dict(), tmp_path / "weights.pth")
    assert isinstance(load_network(tmp_path / "weights.pth"), FireNet)


def test_the_published_firenet(firenet_weights: Path):
    network = load_network(firenet_weights)
    assert isinstance(network, FireNet) and network.num_bins == 5


class Attack:
    """A pickle that calls a function when it is loaded."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def attacked(path: Path, kind: str) -> Path:
    content = {"state_dict": firenet().state_dict(), "logger": Attack(path.with_name("ran"))}
    if kind == "pickle":
        path.write_bytes(pickle.dumps(content))
    elif kind == "tar":
        with tarfile.open(path, "w") as archive:
            for name in ("storages", "tensors", "pickle"):
                data = pickle.dumps(content)
                member = tarfile.TarInfo(name)
                member.size = len(data)
                archive.addfile(member, io.BytesIO(data))
    else:
        torch.save(content, path, _use_new_zipfile_serialization=kind == "zip")
    return path


@pytest.mark.parametrize("kind", ["zip", "legacy", "pickle", "tar"])
def test_code_in_a_checkpoint_is_not_run(tmp_path: Path, kind: str):
    path = attacked(tmp_path / "weights.pth", kind)
    with pytest.raises(RecordingError) as caught:
        load_network(path)
    assert not (tmp_path / "ran").exists()
    reason = {"tar": "it is a tar archive", "pickle": "cannot be read as a checkpoint"}
    assert reason.get(kind, "mkdir), which can run code") in str(caught.value)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_the_attack_would_work(tmp_path: Path):
    torch.load(attacked(tmp_path / "weights.pth", "zip"), weights_only=False)
    assert (tmp_path / "ran").exists()


def without(network: nn.Module, name: str) -> dict[str, Tensor]:
    return {key: value for key, value in network.state_dict().items() if key != name}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "is missing; a checkpoint of PyTorch was expected"),
        (b"", "is empty"),
        (b"weights", "cannot be read as a checkpoint of PyTorch"),
        (b"\x80\x02}q\x00.", "cannot be read as a checkpoint of PyTorch"),
        ({}, "holds the weights of another network (the first of 0 tensors is missing)"),
        ([1.0], "holds the weights of another network"),
        ({"state_dict": [1.0]}, "holds the weights of another network"),
        ({"features.0.weight": torch.zeros(3)}, "the first of 1 tensors is features.0.weight"),
        ({"head.conv2d.weight": torch.zeros(3)}, "holds the weights of another network"),
        ({"head.conv.conv2d.weight": torch.zeros(16, 1, 3, 3)}, "holds the weights of another network"),
        (without(firenet(), "pred.conv2d.bias"), "holds the weights of another network"),
        (without(e2vid(), "decoders.1.conv2d.weight"), "holds the weights of another network"),
        ({**firenet().state_dict(), "pred.conv2d.bias": torch.zeros(2)}, "holds the weights of another network"),
        ({**firenet().state_dict(), "more": torch.zeros(2)}, "holds the weights of another network"),
    ],
)
def test_files_that_are_not_theirs(tmp_path: Path, content: Any, message: str):
    path = tmp_path / "weights.pth"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        torch.save(content, path)
    with pytest.raises(RecordingError) as caught:
        load_network(path)
    assert message in str(caught.value) and str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_file_that_is_cut_short(tmp_path: Path):
    path = saved(tmp_path / "weights.pth", firenet(), "net.")
    path.write_bytes(path.read_bytes()[:-20_000])
    with pytest.raises(RecordingError, match="cannot be read as a checkpoint of PyTorch"):
        load_network(path)
