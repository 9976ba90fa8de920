"""The hash grid on the CPU: Numba kernels for float32 and two features per level.

One thread computes one level at a time, so that the rows of the level stay in its cache. Gradients need no atomic
additions, and their sums have the same order with any number of threads. Positions are processed in blocks: vector
instructions find the corners of all cells of a block before the first row is read. The kernels release the GIL and run
on Python threads (`enerf_ns.kernels.threads`): so no threads of Numba have to work beside OpenMP, forks and the viewer.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from enerf_ns.dataparsers.compiled import compiled
from enerf_ns.kernels.threads import on_threads

DEVICE = "cpu"
"""Type of the device whose tensors the kernels take."""

BLOCK = 128
"""Number of positions in a block: few enough for the fastest cache."""


@compiled
def new_cells():
    """Returns empty arrays for the cells of a block.

    The first holds the hash of y and z for the 4 edges of a cell along x, the second the hash of x for both ends of
    these edges, the third the position within the cell along the three axes, from 0 to 1.
    """
    return np.empty((4, BLOCK), np.uint32), np.empty((2, BLOCK), np.uint32), np.empty((3, BLOCK), np.float32)


@compiled
def find_cells(x, first, number, scaling, cells):
    """Writes the cells of positions to cells.

    Args:
        x: Positions in [0, 1], shape (3, positions).
        first, number: The positions from `first` to `first + number - 1`, at most `BLOCK`, are processed.
        scaling: Lattice cells per unit length.
        cells: Arrays of `new_cells`.
    """
    edges, ends, fractions = cells
    # only the low bits of a hash select the row, so 32-bit arithmetic that wraps around is enough
    prime1, prime2 = np.uint32(2654435761), np.uint32(805459861)
    # rows are cut: Numba checks an index that might be negative, and such a loop is not vectorised
    along0, along1, along2 = x[0][first : first + number], x[1][first : first + number], x[2][first : first + number]
    for p in range(number):
        x0, x1, x2 = along0[p] * scaling, along1[p] * scaling, along2[p] * scaling
        floor0, floor1, floor2 = np.floor(x0), np.floor(x1), np.floor(x2)
        w0, w1, w2 = x0 - floor0, x1 - floor1, x2 - floor2
        low0, low1, low2 = np.int32(floor0), np.int32(floor1), np.int32(floor2)
        high1, high2 = np.int32(low1 + np.int32(w1 > 0)), np.int32(low2 + np.int32(w2 > 0))
        ends[0, p], ends[1, p] = np.uint32(low0), np.uint32(low0 + np.int32(w0 > 0))
        y_low, y_high = np.uint32(np.uint32(low1) * prime1), np.uint32(np.uint32(high1) * prime1)
        z_low, z_high = np.uint32(np.uint32(low2) * prime2), np.uint32(np.uint32(high2) * prime2)
        edges[0, p], edges[1, p] = y_low ^ z_low, y_low ^ z_high
        edges[2, p], edges[3, p] = y_high ^ z_low, y_high ^ z_high
        fractions[0, p], fractions[1, p], fractions[2, p] = w0, w1, w2


@compiled
def _corners(cells, p):
    """Returns for position p of a block: hash and weight of the 4 edges along x of its cell, the hashes of the two ends
    of these edges, and the weights of the lower and the upper side along each axis."""
    edges, ends, fractions = cells
    w0, w1, w2 = fractions[0, p], fractions[1, p], fractions[2, p]
    v0, v1, v2 = np.float32(1) - w0, np.float32(1) - w1, np.float32(1) - w2
    weighted = (
        (edges[0, p], v1 * v2),
        (edges[1, p], v1 * w2),
        (edges[2, p], w1 * v2),
        (edges[3, p], w1 * w2),
    )
    return weighted, (ends[0, p], ends[1, p]), (v0, w0), (v1, w1), (v2, w2)


@compiled
def interpolate(cells, number, table, encoding, first):
    """Writes the two interpolated features of the positions of a block to encoding.

    Args:
        cells: The cells of the positions, from `find_cells`.
        number: Number of positions.
        table: Rows of one level, shape (T, 2); T is a power of two.
        encoding: Shape (2, positions).
        first: First column of encoding that is written.
    """
    mask = np.uint32(len(table) - 1)
    encoding0, encoding1 = encoding[0][first : first + number], encoding[1][first : first + number]
    for p in range(number):
        edges, (low, high), (v0, w0), _, _ = _corners(cells, p)
        sum0 = sum1 = np.float32(0)
        for edge, weight in edges:
            a, b = (low ^ edge) & mask, (high ^ edge) & mask
            weight_a, weight_b = weight * v0, weight * w0
            sum0 += weight_a * table[a, 0] + weight_b * table[b, 0]
            sum1 += weight_a * table[a, 1] + weight_b * table[b, 1]
        encoding0[p], encoding1[p] = sum0, sum1


@compiled
def _forward(x, table, scaling, encoding):
    cells = new_cells()
    for first in range(0, x.shape[1], BLOCK):
        number = min(BLOCK, x.shape[1] - first)
        find_cells(x, first, number, scaling, cells)
        interpolate(cells, number, table, encoding, first)


@compiled
def _backward_table(x, grad_encoding, scaling, grad_table):
    mask = np.uint32(len(grad_table) - 1)
    cells = new_cells()
    grad_table[:] = 0
    for first in range(0, x.shape[1], BLOCK):
        number = min(BLOCK, x.shape[1] - first)
        find_cells(x, first, number, scaling, cells)
        grads0, grads1 = grad_encoding[0][first : first + number], grad_encoding[1][first : first + number]
        for p in range(number):
            edges, (low, high), (v0, w0), _, _ = _corners(cells, p)
            grad0, grad1 = grads0[p], grads1[p]
            for edge, weight in edges:
                a, b = (low ^ edge) & mask, (high ^ edge) & mask
                weight_a, weight_b = weight * v0, weight * w0
                grad_table[a, 0] += weight_a * grad0
                grad_table[a, 1] += weight_a * grad1
                grad_table[b, 0] += weight_b * grad0
                grad_table[b, 1] += weight_b * grad1


@compiled
def _backward_x(x, grad_encoding, scaling, table, grad_x):
    mask = np.uint32(len(table) - 1)
    cells = new_cells()
    for first in range(0, x.shape[1], BLOCK):
        number = min(BLOCK, x.shape[1] - first)
        find_cells(x, first, number, scaling, cells)
        grads0, grads1 = grad_encoding[0][first : first + number], grad_encoding[1][first : first + number]
        for p in range(number):
            edges, (low, high), (v0, w0), (v1, w1), (v2, w2) = _corners(cells, p)
            grad0, grad1 = grads0[p], grads1[p]
            along0 = np.float32(0)
            values = (np.float32(0), np.float32(0), np.float32(0), np.float32(0))  # at the last 4 edges
            for edge, weight in edges:
                a, b = (low ^ edge) & mask, (high ^ edge) & mask
                value_a = grad0 * table[a, 0] + grad1 * table[a, 1]
                value_b = grad0 * table[b, 0] + grad1 * table[b, 1]
                along0 += weight * (value_b - value_a)
                values = (values[1], values[2], values[3], v0 * value_a + w0 * value_b)
            grad_x[0, first + p] = scaling * along0
            grad_x[1, first + p] = scaling * (v2 * (values[2] - values[0]) + w2 * (values[3] - values[1]))
            grad_x[2, first + p] = scaling * (v1 * (values[1] - values[0]) + w1 * (values[3] - values[2]))


def _read_into_cache(table: np.ndarray, num_positions: int) -> None:
    # reading a level in the order of memory is several times faster than reading the same rows in random order
    if 8 * num_positions >= len(table):
        table.max()


class _HashGrid(torch.autograd.Function):
    """Maps positions of shape (3, positions) to the encoding of shape (2 * levels, positions)."""

    @staticmethod
    def forward(ctx, x: Tensor, table: Tensor, scalings: Tensor) -> Tensor:
        ctx.save_for_backward(x, table, scalings)
        num_levels, num_positions = len(scalings), x.shape[1]
        positions, scales = x.numpy(), scalings.numpy()
        rows = table.numpy().reshape(num_levels, -1, 2)
        encoding = torch.empty(2 * num_levels, num_positions)
        by_level = encoding.numpy().reshape(num_levels, 2, num_positions)

        def task(level: int) -> None:
            _read_into_cache(rows[level], num_positions)
            _forward(positions, rows[level], scales[level], by_level[level])

        on_threads(task, num_levels)
        return encoding

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_encoding: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        x, table, scalings = ctx.saved_tensors
        num_levels, num_positions = len(scalings), x.shape[1]
        positions, scales = x.numpy(), scalings.numpy()
        by_level = grad_encoding.contiguous().numpy().reshape(num_levels, 2, num_positions)
        grad_x = grad_table = None
        if ctx.needs_input_grad[0]:
            rows = table.numpy().reshape(num_levels, -1, 2)
            grad_x_by_level = torch.empty(num_levels, 3, num_positions)
            grad_positions = grad_x_by_level.numpy()

            def task_x(level: int) -> None:
                _read_into_cache(rows[level], num_positions)
                _backward_x(positions, by_level[level], scales[level], rows[level], grad_positions[level])

            on_threads(task_x, num_levels)
            grad_x = grad_x_by_level.sum(dim=0)
        if ctx.needs_input_grad[1]:
            # NumPy requests huge pages from Linux. PyTorch does not, and page faults would take as long as the kernels.
            grad_rows = np.empty((num_levels, len(table) // num_levels, 2), np.float32)

            def task_table(level: int) -> None:
                _backward_table(positions, by_level[level], scales[level], grad_rows[level])

            on_threads(task_table, num_levels)
            grad_table = torch.from_numpy(grad_rows.reshape(-1, 2))
        return grad_x, grad_table, None


def hash_grid(x: Tensor, table: Tensor, scalings: Tensor) -> Tensor:
    """Returns the function `enerf_ns.kernels.hash_grid.hash_grid` of float32 tensors on the CPU.

    The table has two features per level. The result is differentiable once in `x` and `table`.
    """
    encoding = _HashGrid.apply(x.reshape(-1, 3).t().contiguous(), table.contiguous(), scalings)
    return encoding.t().reshape(*x.shape[:-1], len(encoding))
