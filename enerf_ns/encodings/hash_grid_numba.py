"""The hash grid on the CPU: Numba kernels for float32 and two features per level, one level a task.

A level is one thread's: while it works there, the level's rows stay in its cache, and gradients need no atomics and add
up in the same order whatever the number of threads. The kernels release the GIL and run on plain Python threads, as
many as PyTorch uses, so that no threading layer of Numba has to get along with OpenMP, forks and the viewer's threads.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from enerf_ns.compiled import compiled

DEVICE = "cpu"
"""Type of the device whose tensors the kernels take."""


@compiled
def _cell(x, i, scaling):
    """Corners of the cell of position i: for each of its 4 edges along x, the hash of y and z with the weight; then the
    hash and the weight of either end in x; then the weights of y and z."""
    x0, x1, x2 = x[i, 0] * scaling, x[i, 1] * scaling, x[i, 2] * scaling
    floor0, floor1, floor2 = np.floor(x0), np.floor(x1), np.floor(x2)
    w0, w1, w2 = x0 - floor0, x1 - floor1, x2 - floor2
    v0, v1, v2 = np.float32(1) - w0, np.float32(1) - w1, np.float32(1) - w2
    low0, low1, low2 = np.int64(floor0), np.int64(floor1), np.int64(floor2)
    high0, high1, high2 = low0 + (w0 > 0), low1 + (w1 > 0), low2 + (w2 > 0)
    low1, high1 = low1 * 2654435761, high1 * 2654435761
    low2, high2 = low2 * 805459861, high2 * 805459861
    edges = ((low1 ^ low2, v1 * v2), (low1 ^ high2, v1 * w2), (high1 ^ low2, w1 * v2), (high1 ^ high2, w1 * w2))
    return edges, (low0, high0), (v0, w0), (v1, w1), (v2, w2)


@compiled
def _forward(x, table, scaling, encoding):
    mask = len(table) - 1
    for i in range(len(x)):
        edges, (low, high), (v0, w0), _, _ = _cell(x, i, scaling)
        sum0 = sum1 = np.float32(0)
        for edge, weight in edges:
            a, b = (low ^ edge) & mask, (high ^ edge) & mask
            weight_a, weight_b = weight * v0, weight * w0
            sum0 += weight_a * table[a, 0] + weight_b * table[b, 0]
            sum1 += weight_a * table[a, 1] + weight_b * table[b, 1]
        encoding[i, 0], encoding[i, 1] = sum0, sum1


@compiled
def _backward_table(x, grad_encoding, scaling, grad_table):
    mask = len(grad_table) - 1
    grad_table[:] = 0
    for i in range(len(x)):
        edges, (low, high), (v0, w0), _, _ = _cell(x, i, scaling)
        grad0, grad1 = grad_encoding[i, 0], grad_encoding[i, 1]
        for edge, weight in edges:
            a, b = (low ^ edge) & mask, (high ^ edge) & mask
            weight_a, weight_b = weight * v0, weight * w0
            grad_table[a, 0] += weight_a * grad0
            grad_table[a, 1] += weight_a * grad1
            grad_table[b, 0] += weight_b * grad0
            grad_table[b, 1] += weight_b * grad1


@compiled
def _backward_x(x, grad_encoding, scaling, table, grad_x):
    mask = len(table) - 1
    for i in range(len(x)):
        edges, (low, high), (v0, w0), (v1, w1), (v2, w2) = _cell(x, i, scaling)
        grad0, grad1 = grad_encoding[i, 0], grad_encoding[i, 1]
        along0 = np.float32(0)
        values = (np.float32(0), np.float32(0), np.float32(0), np.float32(0))  # of the last 4 edges
        for edge, weight in edges:
            a, b = (low ^ edge) & mask, (high ^ edge) & mask
            value_a = grad0 * table[a, 0] + grad1 * table[a, 1]
            value_b = grad0 * table[b, 0] + grad1 * table[b, 1]
            along0 += weight * (value_b - value_a)
            values = (values[1], values[2], values[3], v0 * value_a + w0 * value_b)
        grad_x[i, 0] = scaling * along0
        grad_x[i, 1] = scaling * (v2 * (values[2] - values[0]) + w2 * (values[3] - values[1]))
        grad_x[i, 2] = scaling * (v1 * (values[1] - values[0]) + w1 * (values[3] - values[2]))


def _for_each_level(task: Callable[[int], Any], num_levels: int) -> None:
    num_threads = min(torch.get_num_threads(), num_levels)
    if num_threads == 1:
        for level in range(num_levels):
            task(level)
    else:
        with ThreadPoolExecutor(num_threads) as pool:
            list(pool.map(task, range(num_levels)))


def _read_into_cache(table: np.ndarray, num_positions: int) -> None:
    # Reading a level in the order of memory takes a fraction of fetching the same rows one by one at random.
    if 8 * num_positions >= len(table):
        table.max()


class _HashGrid(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x: Tensor, table: Tensor, scalings: Tensor) -> Tensor:
        ctx.save_for_backward(x, table, scalings)
        num_levels = len(scalings)
        positions, scales = x.numpy(), scalings.numpy()
        rows = table.numpy().reshape(num_levels, -1, 2)
        encoding = torch.empty(num_levels, len(x), 2)
        by_level = encoding.numpy()

        def task(level: int) -> None:
            _read_into_cache(rows[level], len(positions))
            _forward(positions, rows[level], scales[level], by_level[level])

        _for_each_level(task, num_levels)
        return encoding.transpose(0, 1).reshape(len(x), 2 * num_levels)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_encoding: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        x, table, scalings = ctx.saved_tensors
        num_levels = len(scalings)
        positions, scales = x.numpy(), scalings.numpy()
        by_level = grad_encoding.reshape(len(x), num_levels, 2).transpose(0, 1).contiguous().numpy()
        grad_x = grad_table = None
        if ctx.needs_input_grad[0]:
            rows = table.numpy().reshape(num_levels, -1, 2)
            grad_x_by_level = torch.empty(num_levels, len(x), 3)
            grad_positions = grad_x_by_level.numpy()

            def task_x(level: int) -> None:
                _read_into_cache(rows[level], len(positions))
                _backward_x(positions, by_level[level], scales[level], rows[level], grad_positions[level])

            _for_each_level(task_x, num_levels)
            grad_x = grad_x_by_level.sum(dim=0)
        if ctx.needs_input_grad[1]:
            # NumPy asks Linux for huge pages, PyTorch does not: page faults would take as long as the kernels.
            grad_rows = np.empty((num_levels, len(table) // num_levels, 2), np.float32)

            def task_table(level: int) -> None:
                _backward_table(positions, by_level[level], scales[level], grad_rows[level])

            _for_each_level(task_table, num_levels)
            grad_table = torch.from_numpy(grad_rows.reshape(-1, 2))
        return grad_x, grad_table, None


def hash_grid(x: Tensor, table: Tensor, scalings: Tensor) -> Tensor:
    """Trilinear interpolation of hashed features at every level, for float32 tensors on the CPU and two features per
    level; differentiable once in `x` and `table`. Else as `enerf_ns.encodings.hash_grid.hash_grid`."""
    encoding = _HashGrid.apply(x.reshape(-1, 3).contiguous(), table.contiguous(), scalings)
    return encoding.reshape(*x.shape[:-1], encoding.shape[-1])
