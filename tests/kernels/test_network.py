"""Compiled networks against PyTorch's networks."""

from __future__ import annotations

import copy
from collections.abc import Iterator

import pytest
import torch
from nerfstudio.field_components.mlp import MLP
from torch import Tensor

from enerf_ns.kernels.hash_grid import BACKENDS
from enerf_ns.kernels.network import Network
from enerf_ns.kernels.network_numba import BLOCK, TASK


def is_compiled(output: Tensor) -> bool:
    node = output.grad_fn
    while node is not None and "_Network" not in node.name():
        node = node.next_functions[0][0] if node.next_functions else None
    return node is not None


def results(network: MLP, x: Tensor, weight: Tensor) -> list[Tensor]:
    """Returns the output, and the gradients of its weighted sum with respect to inputs and parameters."""
    output = network(x)
    return [output, *torch.autograd.grad((output * weight).sum(), [x, *network.parameters()])]


@pytest.mark.parametrize("points", [0, 1, 7, BLOCK - 1, BLOCK, BLOCK + 1, TASK + 5, 3 * TASK])
@pytest.mark.parametrize(
    ("widths", "num_layers"),
    [((20, 32, 16), 2), ((15, 32, 1), 2), ((10, 16, 1), 2), ((31, 64, 3), 3), ((1, 1, 1), 2), ((5, 7, 6), 4),
     ((6, 9, 2), 1)],
)  # fmt: skip
def test_values_and_gradients_are_pytorch_s(widths: tuple[int, int, int], num_layers: int, points: int):
    torch.manual_seed(points)
    network = Network(widths[0], num_layers, widths[1], widths[2])
    exact = copy.deepcopy(network).double()  # kernels take only float32
    x, weight = torch.randn(points, widths[0]), torch.randn(points, widths[2])
    found = results(network, x.requires_grad_(), weight)
    expected = results(exact, x.detach().double().requires_grad_(), weight.double())
    assert is_compiled(found[0]) and not is_compiled(expected[0])
    for value, true in zip(found, expected, strict=True):
        assert value.shape == true.shape and value.dtype == torch.float32
        largest = true.abs().max().item() if true.numel() else 1.0
        assert torch.allclose(value.double(), true, rtol=1e-4, atol=2e-6 * max(largest, 1.0))


def test_it_is_nerfstudio_s_network_with_its_parameters():
    torch.manual_seed(0)
    ours = Network(20, 3, 32, 16)
    torch.manual_seed(0)
    theirs = MLP(20, 3, 32, 16, implementation="torch")
    assert ours.state_dict().keys() == theirs.state_dict().keys()
    assert all(map(torch.equal, ours.state_dict().values(), theirs.state_dict().values()))
    x = torch.randn(3, 50, 20)
    assert torch.allclose(ours(x), theirs(x), atol=1e-6)
    assert ours(x).shape == (3, 50, 16)
    assert torch.equal(Network.forward(_with_backend(ours, "torch"), x), theirs(x))


def _with_backend(network: Network, backend: str) -> Network:
    other = copy.deepcopy(network)
    other.backend = backend
    return other


@pytest.mark.parametrize("transposed", [False, True])
def test_memory_in_any_order_does(transposed: bool):
    network = Network(8, 2, 16, 4)
    x = torch.randn(8, 300).t() if transposed else torch.randn(300, 8)
    weight = torch.randn(4, 300).t() if transposed else torch.randn(300, 4)
    found = results(network, x.requires_grad_(), weight)
    expected = results(_with_backend(network, "torch"), x, weight)
    assert all(torch.allclose(*pair, rtol=1e-4, atol=1e-4) for pair in zip(found, expected, strict=True))


def test_one_output_may_be_used_alone():
    """Gradients are right if only a part of the output is used, such as densities without features."""
    network = Network(8, 2, 16, 4)
    x = torch.randn(300, 8, requires_grad=True)
    found = torch.autograd.grad(network(x)[:, 2].square().sum(), [x, *network.parameters()])
    expected = torch.autograd.grad(
        _with_backend(network, "torch")(x)[:, 2].square().sum(), x
    )  # parameters are copies, inputs are the same
    assert torch.allclose(found[0], expected[0], rtol=1e-4, atol=1e-5)


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def test_results_are_the_same_whatever_the_number_of_threads(threads):
    network, x = Network(20, 2, 32, 16), torch.randn(5 * TASK + 3, 20, requires_grad=True)
    weight = torch.randn(len(x), 16)
    found = []
    for number in (1, 2, 5):
        torch.set_num_threads(number)
        found.append(results(network, x, weight))
    assert all(torch.equal(*pair) for other in found[1:] for pair in zip(found[0], other, strict=True))


def test_no_number_stays_no_number_where_it_is():
    network = Network(4, 2, 8, 2)
    x = torch.randn(200, 4)
    x[17, 2] = torch.nan
    output = network(x)
    assert output[17].isnan().all() and output.isnan().sum() == 2
    x[17, 2] = torch.inf
    assert not network(x)[17].isfinite().all()


def test_without_gradients_nothing_is_kept():
    network = Network(4, 2, 8, 2)
    with torch.no_grad():
        assert network(torch.randn(9, 4)).grad_fn is None


def test_where_the_kernels_do_not_fit_pytorch_computes(monkeypatch: pytest.MonkeyPatch):
    network = Network(4, 2, 8, 2)
    meant = torch.zeros(5, 4, device="meta")
    assert network.to("meta")(meant).shape == (5, 2)
    monkeypatch.setattr(type(BACKENDS["numba"]), "misfit", lambda *_: "Numba")
    assert not is_compiled(Network(4, 2, 8, 2)(torch.randn(5, 4)))


def test_half_precision_is_pytorch_s():
    network, x = Network(4, 2, 8, 2), torch.randn(5, 4)
    with torch.autocast("cpu", torch.bfloat16):
        assert network(x).dtype == torch.bfloat16
    assert network(x).dtype == torch.float32 and is_compiled(network(x))
