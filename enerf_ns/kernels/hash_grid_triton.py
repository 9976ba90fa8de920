"""The hash grid on the GPU: Triton kernels for float32 and 1, 2, 4 or 8 features per level.

Triton comes with PyTorch, and compiles the kernels when they are first called. For the backward pass only positions,
table and scalings are kept. Atomic additions sum the gradients of the table. Their order changes from call to call, and
so do the last bits of the sums. If TRITON_INTERPRET=1 is in the environment before Triton is imported, NumPy executes
the kernels on CPU tensors. Tests do so.
"""

# Triton needs evaluated annotations such as tl.constexpr, so annotations are not postponed in this module. Callers pass
# tensors for pointers, and numbers for tl.constexpr:
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable
from triton import knobs

DEVICE = "cpu" if knobs.runtime.interpret else "cuda"
"""Type of the device whose tensors the kernels take."""

BLOCK = 1024 if knobs.runtime.interpret else 128
"""Number of positions of one program. The interpreter is slow per program, so its programs are large."""


@triton.jit
def _cell(x, positions, inside, scaling):
    """Returns for each axis the hashes of the lattice points below and above each position, and the distance from the
    lower one in cells."""
    x0 = tl.load(x + 3 * positions, mask=inside, other=0.0) * scaling
    x1 = tl.load(x + 3 * positions + 1, mask=inside, other=0.0) * scaling
    x2 = tl.load(x + 3 * positions + 2, mask=inside, other=0.0) * scaling
    floor0, floor1, floor2 = tl.floor(x0), tl.floor(x1), tl.floor(x2)
    w0, w1, w2 = x0 - floor0, x1 - floor1, x2 - floor2
    low0, low1, low2 = floor0.to(tl.int32), floor1.to(tl.int32), floor2.to(tl.int32)
    # only the low bits of a hash select the row, so 32-bit arithmetic that wraps around is enough; in it -1640531535 is
    # 2654435761
    high0 = low0 + (w0 > 0).to(tl.int32)
    high1 = (low1 + (w1 > 0).to(tl.int32)) * -1640531535
    high2 = (low2 + (w2 > 0).to(tl.int32)) * 805459861
    return low0, high0, w0, low1 * -1640531535, high1, w1, low2 * 805459861, high2, w2


@triton.jit
def _corner(corner: tl.constexpr, low0, high0, w0, low1, high1, w1, low2, high2, w2, table_size):
    """Returns the row within a level of one corner, from 0 to 7, of each cell, and its weights along the three axes."""
    hash0, weight0 = (high0, w0) if corner & 1 else (low0, 1.0 - w0)
    hash1, weight1 = (high1, w1) if corner & 2 else (low1, 1.0 - w1)
    hash2, weight2 = (high2, w2) if corner & 4 else (low2, 1.0 - w2)
    rows = ((hash0 ^ hash1 ^ hash2) & (table_size - 1)).to(tl.int64)
    return rows, weight0, weight1, weight2


@triton.jit
def _forward(
    x, table, scalings, encoding, num_positions, table_size, step, FEATURES: tl.constexpr, BLOCK: tl.constexpr
):
    level = tl.program_id(1)
    positions = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    inside = positions < num_positions
    features = tl.arange(0, FEATURES)[None, :]
    low0, high0, w0, low1, high1, w1, low2, high2, w2 = _cell(x, positions, inside, tl.load(scalings + level))
    total = tl.zeros((BLOCK, FEATURES), tl.float32)
    for corner in tl.static_range(8):
        rows, weight0, weight1, weight2 = _corner(corner, low0, high0, w0, low1, high1, w1, low2, high2, w2, table_size)
        rows += level.to(tl.int64) * table_size
        values = tl.load(table + rows[:, None] * FEATURES + features, mask=inside[:, None], other=0.0)
        total += (weight0 * weight1 * weight2)[:, None] * values
    tl.store(encoding + (level * FEATURES + features) * step + positions[:, None], total, mask=inside[:, None])


@triton.jit
def _backward_table(
    x,
    grad_encoding,
    scalings,
    grad_table,
    num_positions,
    table_size,
    step_position,
    step_feature,
    FEATURES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    level = tl.program_id(1)
    positions = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    inside = positions < num_positions
    features = tl.arange(0, FEATURES)[None, :]
    low0, high0, w0, low1, high1, w1, low2, high2, w2 = _cell(x, positions, inside, tl.load(scalings + level))
    at = positions[:, None] * step_position + (level * FEATURES + features) * step_feature
    grad = tl.load(grad_encoding + at, mask=inside[:, None], other=0.0)
    for corner in tl.static_range(8):
        rows, weight0, weight1, weight2 = _corner(corner, low0, high0, w0, low1, high1, w1, low2, high2, w2, table_size)
        rows += level.to(tl.int64) * table_size
        values = (weight0 * weight1 * weight2)[:, None] * grad
        tl.atomic_add(grad_table + rows[:, None] * FEATURES + features, values, mask=inside[:, None], sem="relaxed")


@triton.jit
def _backward_x(
    x,
    grad_encoding,
    scalings,
    table,
    grad_x,
    num_positions,
    num_levels,
    table_size,
    step_position,
    step_feature,
    FEATURES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    positions = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    inside = positions < num_positions
    features = tl.arange(0, FEATURES)[None, :]
    along0 = tl.zeros((BLOCK,), tl.float32)
    along1 = tl.zeros((BLOCK,), tl.float32)
    along2 = tl.zeros((BLOCK,), tl.float32)
    for level in range(num_levels):
        scaling = tl.load(scalings + level)
        low0, high0, w0, low1, high1, w1, low2, high2, w2 = _cell(x, positions, inside, scaling)
        at = positions[:, None] * step_position + (level * FEATURES + features) * step_feature
        grad = tl.load(grad_encoding + at, mask=inside[:, None], other=0.0)
        for corner in tl.static_range(8):
            rows, weight0, weight1, weight2 = _corner(
                corner, low0, high0, w0, low1, high1, w1, low2, high2, w2, table_size
            )
            rows += level * table_size
            values = tl.load(table + rows[:, None] * FEATURES + features, mask=inside[:, None], other=0.0)
            value = scaling * tl.sum(grad * values, axis=1)
            along0 += (1.0 if corner & 1 else -1.0) * weight1 * weight2 * value
            along1 += (1.0 if corner & 2 else -1.0) * weight0 * weight2 * value
            along2 += (1.0 if corner & 4 else -1.0) * weight0 * weight1 * value
    tl.store(grad_x + 3 * positions, along0, mask=inside)
    tl.store(grad_x + 3 * positions + 1, along1, mask=inside)
    tl.store(grad_x + 3 * positions + 2, along2, mask=inside)


class _HashGrid(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x: Tensor, table: Tensor, scalings: Tensor) -> Tensor:
        ctx.save_for_backward(x, table, scalings)
        (num_positions, _), (num_rows, features), num_levels = x.shape, table.shape, len(scalings)
        encoding = x.new_empty(num_levels * features, num_positions)
        if num_positions:
            with torch.cuda.device_of(x):  # as autograd does for the backward pass
                _forward[triton.cdiv(num_positions, BLOCK), num_levels](
                    x, table, scalings, encoding, num_positions, num_rows // num_levels, num_positions, features, BLOCK
                )
        return encoding.t()

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_encoding: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        x, table, scalings = ctx.saved_tensors
        (num_positions, _), (num_rows, features), num_levels = x.shape, table.shape, len(scalings)
        blocks, table_size = triton.cdiv(num_positions, BLOCK), num_rows // num_levels
        grad_x = torch.zeros_like(x) if ctx.needs_input_grad[0] else None
        grad_table = torch.zeros_like(table) if ctx.needs_input_grad[1] else None
        if num_positions and grad_x is not None:
            _backward_x[blocks,](
                x,
                grad_encoding,
                scalings,
                table,
                grad_x,
                num_positions,
                num_levels,
                table_size,
                *grad_encoding.stride(),
                features,
                BLOCK,
            )
        if num_positions and grad_table is not None:
            _backward_table[blocks, num_levels](
                x,
                grad_encoding,
                scalings,
                grad_table,
                num_positions,
                table_size,
                *grad_encoding.stride(),
                features,
                BLOCK,
            )
        return grad_x, grad_table, None


def hash_grid(x: Tensor, table: Tensor, scalings: Tensor) -> Tensor:
    """Returns the function `enerf_ns.kernels.hash_grid.hash_grid` of float32 tensors on a GPU.

    The table has 1, 2, 4 or 8 features per level. The result is differentiable once in `x` and `table`.
    """
    encoding = _HashGrid.apply(x.reshape(-1, 3).contiguous(), table.contiguous(), scalings)
    return encoding.reshape(*x.shape[:-1], encoding.shape[-1])
