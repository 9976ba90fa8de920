"""All backends of the hash grid against Nerfstudio's, against finite differences and against each other."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.field_components.encodings import HashEncoding

from enerf_ns.kernels import hash_grid_numba
from enerf_ns.kernels.hash_grid import BACKENDS, HashGrid, fitting, hash_grid

SETTINGS: dict[str, Any] = {"num_levels": 5, "min_res": 4, "max_res": 100, "log2_table_size": 8}


def device_of(backend: str) -> str:
    """Returns the device on which a backend is tested; skips the test if its package is missing."""
    if backend == "torch":
        return "cpu"
    return pytest.importorskip(BACKENDS[backend].package) and import_module(BACKENDS[backend].module).DEVICE


@pytest.fixture(params=["torch", *BACKENDS])
def grid(request) -> HashGrid:
    device = device_of(request.param)
    torch.manual_seed(0)
    return HashGrid(**SETTINGS, init_scale=1.0, backend=request.param).to(device)


@pytest.fixture
def nerfstudio(grid) -> HashEncoding:
    torch.manual_seed(0)
    return HashEncoding(
        num_levels=SETTINGS["num_levels"],
        min_res=SETTINGS["min_res"],
        max_res=SETTINGS["max_res"],
        log2_hashmap_size=SETTINGS["log2_table_size"],
        hash_init_scale=1.0,
        implementation="torch",
    ).to(grid.table.device)


def positions(kind: str, device: torch.device | str = "cpu") -> torch.Tensor:
    return positions_on_cpu(kind).to(device)


def positions_on_cpu(kind: str) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    if kind == "inside":
        return torch.rand(500, 3, generator=generator)
    if kind == "outside":
        return torch.rand(500, 3, generator=generator) * 1.4 - 0.2
    if kind == "on the lattice":  # along all axes on the coarsest level, along some axes on the others
        return torch.randint(0, 5, (300, 3), generator=generator) / 4
    return torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3)


def test_table_starts_as_nerfstudios(grid, nerfstudio):
    assert torch.equal(grid.table, nerfstudio.hash_table)


@pytest.mark.parametrize("kind", ["inside", "outside", "on the lattice", "corners"])
def test_values_and_gradients_are_nerfstudios(grid, nerfstudio, kind):
    device = grid.table.device
    x = positions(kind, device).requires_grad_()
    x_nerfstudio = positions(kind, device).requires_grad_()
    grad_encoding = torch.randn(len(x), grid.out_dim, generator=torch.Generator().manual_seed(2)).to(device)

    encoding, expected = grid(x), nerfstudio(x_nerfstudio)
    encoding.backward(grad_encoding)
    expected.backward(grad_encoding)

    torch.testing.assert_close(encoding, expected, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(grid.table.grad, nerfstudio.hash_table.grad, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(x.grad, x_nerfstudio.grad, rtol=1e-4, atol=1e-3)  # values reach 200 per level


@pytest.mark.parametrize("levels", [(1, 16, 1024), (10, 16, 1024), (16, 16, 8192), (7, 5, 99)])
def test_scalings_are_nerfstudios(levels):
    ours = HashGrid(*levels, log2_table_size=2)
    theirs = HashEncoding(*levels, log2_hashmap_size=2, implementation="torch")
    assert torch.equal(ours.scalings, theirs.scalings)


def test_gradients_are_finite_differences(grid):
    # Within a cell the encoding is linear along each axis, so rounding is the only error of central differences.
    step = 1e-3
    x = torch.rand(2000, 3, generator=torch.Generator().manual_seed(3)).to(grid.table.device)
    to_lattice = (x[:, None] * grid.scalings[:, None] - (x[:, None] * grid.scalings[:, None]).round()).abs()
    x = x[(to_lattice > 2 * step * grid.scalings[:, None]).all(dim=(1, 2))]
    assert len(x) > 100
    weights = torch.randn(grid.out_dim, generator=torch.Generator().manual_seed(4)).to(x.device)

    x.requires_grad_()
    (grid(x) @ weights).sum().backward()
    assert x.grad is not None and grid.table.grad is not None
    with torch.no_grad():
        for axis in range(3):
            shift = step * torch.eye(3, device=x.device)[axis]
            slope = (grid(x + shift) - grid(x - shift)) @ weights / (2 * step)
            torch.testing.assert_close(x.grad[:, axis], slope, rtol=1e-2, atol=5e-2)
        from_gradient = (grid.table.grad * grid.table).sum()  # as the encoding is linear in the table
        torch.testing.assert_close(from_gradient, (grid(x) @ weights).sum(), rtol=1e-4, atol=1e-3)


def test_torch_backend_gradcheck():
    x = torch.rand(4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5)).requires_grad_()
    table = torch.randn(2 * 16, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(6)).requires_grad_()
    scalings = torch.tensor([3.0, 7.0], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x, table: hash_grid(x, table, scalings), (x, table))


def test_gradient_only_where_needed(grid):
    x = positions("inside", grid.table.device).requires_grad_()
    grid.table.requires_grad_(False)
    grid(x).sum().backward()
    assert x.grad is not None and grid.table.grad is None
    with torch.no_grad():
        assert not grid(x).requires_grad


@pytest.mark.parametrize("number", range(6))
def test_fine_levels_as_constants(grid, number: int):
    x = positions("inside", grid.table.device).requires_grad_()
    whole, weights = grid(x), torch.randn(grid.out_dim, device=x.device)
    part = 2 * number
    expected = torch.autograd.grad((whole[:, :part] * weights[:part]).sum(), x, retain_graph=True)[0]
    grid.num_differentiated = number
    found = grid(x)
    assert torch.equal(found, whole)
    torch.testing.assert_close(torch.autograd.grad((found * weights).sum(), x)[0], expected)


def test_shapes_and_strides(grid):
    x = positions("inside", grid.table.device)[:60]
    expected = grid(x)
    assert torch.equal(grid(x.view(3, 4, 5, 3)), expected.view(3, 4, 5, -1))
    assert torch.equal(grid(x[0]), expected[0])
    assert torch.equal(grid(x.T.contiguous().T), expected)
    assert torch.equal(grid(x[::3]), expected[::3])

    expanded = torch.ones((), device=x.device).expand(60, grid.out_dim)
    (by_rows,) = torch.autograd.grad(grid(x), grid.table, expanded)
    (by_columns,) = torch.autograd.grad(grid(x.T.contiguous().T.view(5, 12, 3)).sum(), grid.table)
    torch.testing.assert_close(by_columns, by_rows)


@pytest.mark.parametrize("shape", [(0, 3), (4, 0, 3)])
def test_empty_batch(grid, shape):
    x = torch.empty(shape, device=grid.table.device, requires_grad=True)
    encoding = grid(x)
    assert encoding.shape == (*shape[:-1], grid.out_dim)
    encoding.sum().backward()
    assert x.grad is not None and x.grad.shape == shape
    assert grid.table.grad.shape == grid.table.shape and not grid.table.grad.any()


def test_gradients_accumulate(grid):
    x = positions("inside", grid.table.device)
    grid(x).sum().backward()
    assert grid.table.grad is not None
    once = grid.table.grad.clone()
    (grid(x).sum() + grid(x).sum()).backward()
    torch.testing.assert_close(grid.table.grad, 3 * once, rtol=1e-4, atol=1e-4)


def test_positions_that_are_no_numbers_stay_within_the_table(grid):
    numbers = [[float("nan"), 0.5, 0.5], [float("inf"), 0.5, 0.5], [0.5, -1e30, 0.5]]
    x = torch.tensor(numbers, device=grid.table.device, requires_grad=True)
    encoding = grid(x)
    encoding.nan_to_num().sum().backward()
    assert encoding[:2].isnan().all()


def test_number_of_threads_does_not_matter():
    threads = torch.get_num_threads()
    results = []
    try:
        for num_threads in (1, 2):
            torch.set_num_threads(num_threads)
            torch.manual_seed(0)
            grid = HashGrid(**SETTINGS, init_scale=1.0, backend="numba")
            x = positions("inside").requires_grad_()
            encoding = grid(x)
            encoding.square().sum().backward()
            results.append((encoding, x.grad, grid.table.grad))
    finally:
        torch.set_num_threads(threads)
    for one, two in zip(*results, strict=True):
        assert torch.equal(one, two)


def test_checkpoint_is_the_table_whatever_the_backend():
    x = positions("inside")
    trained = HashGrid(**SETTINGS, backend="numba")
    state = pickle.loads(pickle.dumps(trained.state_dict()))
    assert list(state) == ["table"]
    for backend in ("torch", "auto"):
        loaded = HashGrid(**SETTINGS, backend=backend)
        loaded.load_state_dict(state)
        torch.testing.assert_close(loaded(x), trained(x), rtol=1e-5, atol=1e-9)


def test_auto_takes_torch_where_nothing_else_fits():
    x = positions("inside")
    torch.manual_seed(0)
    four_features = HashGrid(**SETTINGS, features_per_level=4)
    assert torch.equal(four_features(x), hash_grid(x, four_features.table, four_features.scalings))
    double = HashGrid(**SETTINGS).double()
    assert double(x.double()).dtype == torch.float64


def test_auto_takes_what_is_compiled_for_the_device():
    x, table = positions("inside"), HashGrid(**SETTINGS).table
    assert fitting("auto", x, table) is hash_grid_numba.hash_grid
    assert fitting("torch", x, table) is hash_grid
    if torch.cuda.is_available():
        assert fitting("auto", x.cuda(), table.cuda()) is import_module(BACKENDS["triton"].module).hash_grid


@pytest.mark.sweep(8)
@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("backend", list(BACKENDS))
def test_backends_are_the_reference_whatever_the_size(backend, seed):
    draw = np.random.default_rng(seed)
    features = int(draw.choice(BACKENDS[backend].features))
    num_levels, log2_table_size = int(draw.integers(1, 17)), int(draw.integers(1, 13))
    torch.manual_seed(seed)
    grid = HashGrid(num_levels, 2, int(draw.integers(3, 3000)), log2_table_size, features, 1.0, backend)
    grid.to(device_of(backend))
    # positions in the box and around it, on planes of the coarsest lattice, and on the faces of the box
    inside = torch.rand(int(draw.integers(1, 3000)), 3) * 1.2 - 0.1
    x = torch.cat([inside, inside.mul(2).round() / 2, inside.round()]).to(grid.table.device)
    grad_encoding = torch.randn(len(x), grid.out_dim, device=x.device)
    found = []
    for function in (grid, lambda x: hash_grid(x, grid.table, grid.scalings)):
        at = x.clone().requires_grad_()
        encoding = function(at)
        found.append((encoding, *torch.autograd.grad(encoding, (at, grid.table), grad_encoding)))
    for name, ours, expected in zip(
        ("encoding", "gradient of positions", "gradient of the table"), *found, strict=True
    ):
        assert (ours - expected).abs().max() <= 2e-6 * expected.abs().max() + 1e-6, name


def test_a_thousand_equal_positions_add_up(grid):
    x = torch.full((1000, 3), 0.3, device=grid.table.device)
    (grad,) = torch.autograd.grad(grid(x).sum(), grid.table)
    (once,) = torch.autograd.grad(grid(x[:1]).sum(), grid.table)
    torch.testing.assert_close(grad, 1000 * once, rtol=1e-4, atol=0)


def test_the_forward_pass_keeps_positions_and_table_alone():
    grid = HashGrid(**SETTINGS, backend="triton").to(device_of("triton"))
    x = positions("inside", grid.table.device)
    kept = []
    with torch.autograd.graph.saved_tensors_hooks(lambda tensor: kept.append(tensor) or tensor, lambda tensor: tensor):
        grid(x)
    assert {tensor.data_ptr() for tensor in kept} == {x.data_ptr(), grid.table.data_ptr(), grid.scalings.data_ptr()}


@pytest.mark.parametrize("capability", [80, 90])
def test_kernels_of_triton_compile_for_gpus_that_are_not_here(capability):
    pytest.importorskip("triton")
    script = Path(__file__).with_name("compile_triton.py")
    environment = {**os.environ, "TRITON_INTERPRET": "0"}
    compiled = subprocess.run(
        [sys.executable, script, str(capability)], env=environment, capture_output=True, text=True
    )
    assert compiled.returncode == 0, compiled.stderr
    assert compiled.stdout.split() == ["_forward", "_backward_table", "_backward_x"]


def test_errors_say_what_is_wrong():
    with pytest.raises(ValueError, match=r"last axis must be 3"):
        HashGrid(**SETTINGS)(torch.rand(5, 2))
    with pytest.raises(ValueError, match=r'backend is "cuda"'):
        HashGrid(**SETTINGS, backend="cuda")(torch.rand(5, 3))
    with pytest.raises(ValueError, match=r"2 features per level, not 4"):
        HashGrid(**SETTINGS, features_per_level=4, backend="numba")(torch.rand(5, 3))
    with pytest.raises(ValueError, match=r"torch.float64 on cpu"):
        HashGrid(**SETTINGS, backend="numba")(torch.rand(5, 3, dtype=torch.float64))


def test_kernels_work_where_no_cache_can_be_written():
    # Numba finds no folder for the cache of a source file that does not exist, and raises when it decorates.
    uncached: dict[str, Any] = {"__name__": "uncached"}
    exec(compile(Path(hash_grid_numba.__file__).read_text(), "absent/hash_grid_numba.py", "exec"), uncached)
    grid = HashGrid(**SETTINGS, backend="numba")
    x = positions("inside")
    assert torch.equal(uncached["hash_grid"](x, grid.table, grid.scalings), grid(x))
