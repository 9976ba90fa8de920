"""Compiled kernels for small networks on the CPU.

A block of points goes through all layers while its values stay in the fastest cache. PyTorch computes layer by layer,
writes and reads every value in memory, and its threads spin while other threads wait. For the backward pass the kernels
keep only the inputs, and compute the values of the layers again.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from enerf_ns.dataparsers.compiled import compiled
from enerf_ns.kernels.hash_grid_numba import BLOCK
from enerf_ns.kernels.threads import on_threads

TASK = 16 * BLOCK
"""Number of points that a thread takes at a time. Gradients are summed within a task, and then over the tasks in order.
So they do not depend on the number of threads."""

ZERO = np.float32(0)

vectorised = partial(compiled, any_order=True)


class Layers(NamedTuple):
    """The layers of a network with ReLU between them: weights of shape (out, in), and biases of shape (out)."""

    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]


def layers_of(parameters: Iterable[Tensor]) -> Layers:
    """Returns the layers of a network, without gradients; arrays share the memory of contiguous parameters.

    Args:
        parameters: Weight and bias of the first layer, of the second layer, and so on.
    """
    arrays = tuple(parameter.detach().contiguous().numpy() for parameter in parameters)
    return Layers(arrays[::2], arrays[1::2])


@vectorised
def _add_product(weight, inputs, number, outputs):
    """Adds weight @ inputs to outputs, for the first columns. Blocks of four by four make reads from memory rare."""
    rows, width = weight.shape
    by_four, rows_by_four = width // 4 * 4, rows // 4 * 4
    for j in range(0, rows_by_four, 4):
        for k in range(0, by_four, 4):
            a0, a1, a2, a3 = weight[j, k], weight[j, k + 1], weight[j, k + 2], weight[j, k + 3]
            b0, b1, b2, b3 = weight[j + 1, k], weight[j + 1, k + 1], weight[j + 1, k + 2], weight[j + 1, k + 3]
            c0, c1, c2, c3 = weight[j + 2, k], weight[j + 2, k + 1], weight[j + 2, k + 2], weight[j + 2, k + 3]
            d0, d1, d2, d3 = weight[j + 3, k], weight[j + 3, k + 1], weight[j + 3, k + 2], weight[j + 3, k + 3]
            for p in range(number):
                x0, x1, x2, x3 = inputs[k, p], inputs[k + 1, p], inputs[k + 2, p], inputs[k + 3, p]
                outputs[j, p] += a0 * x0 + a1 * x1 + a2 * x2 + a3 * x3
                outputs[j + 1, p] += b0 * x0 + b1 * x1 + b2 * x2 + b3 * x3
                outputs[j + 2, p] += c0 * x0 + c1 * x1 + c2 * x2 + c3 * x3
                outputs[j + 3, p] += d0 * x0 + d1 * x1 + d2 * x2 + d3 * x3
        for k in range(by_four, width):
            a0, b0, c0, d0 = weight[j, k], weight[j + 1, k], weight[j + 2, k], weight[j + 3, k]
            for p in range(number):
                x0 = inputs[k, p]
                outputs[j, p] += a0 * x0
                outputs[j + 1, p] += b0 * x0
                outputs[j + 2, p] += c0 * x0
                outputs[j + 3, p] += d0 * x0
    for j in range(rows_by_four, rows):
        for k in range(0, by_four, 4):
            a0, a1, a2, a3 = weight[j, k], weight[j, k + 1], weight[j, k + 2], weight[j, k + 3]
            for p in range(number):
                outputs[j, p] += (
                    a0 * inputs[k, p] + a1 * inputs[k + 1, p] + a2 * inputs[k + 2, p] + a3 * inputs[k + 3, p]
                )
        for k in range(by_four, width):
            a0 = weight[j, k]
            for p in range(number):
                outputs[j, p] += a0 * inputs[k, p]


@vectorised
def _add_outer(grads, inputs, number, grad_weight):
    """Adds grads @ inputs.T, over the first columns, to grad_weight; in blocks of two by four."""
    rows, width = grad_weight.shape
    by_four, rows_by_two = width // 4 * 4, rows // 2 * 2
    for j in range(0, rows_by_two, 2):
        for k in range(0, by_four, 4):
            a0 = a1 = a2 = a3 = b0 = b1 = b2 = b3 = ZERO
            for p in range(number):
                a, b = grads[j, p], grads[j + 1, p]
                x0, x1, x2, x3 = inputs[k, p], inputs[k + 1, p], inputs[k + 2, p], inputs[k + 3, p]
                a0 += a * x0
                a1 += a * x1
                a2 += a * x2
                a3 += a * x3
                b0 += b * x0
                b1 += b * x1
                b2 += b * x2
                b3 += b * x3
            grad_weight[j, k] += a0
            grad_weight[j, k + 1] += a1
            grad_weight[j, k + 2] += a2
            grad_weight[j, k + 3] += a3
            grad_weight[j + 1, k] += b0
            grad_weight[j + 1, k + 1] += b1
            grad_weight[j + 1, k + 2] += b2
            grad_weight[j + 1, k + 3] += b3
    for j in range(rows):
        for k in range(by_four if j < rows_by_two else 0, width):
            a0 = ZERO
            for p in range(number):
                a0 += grads[j, p] * inputs[k, p]
            grad_weight[j, k] += a0


@vectorised
def new_values(layers):
    """Returns an empty array for the inputs and the outputs of all layers of a block: (layers + 1, widest, BLOCK)."""
    widest = layers.weights[0].shape[1]
    for i in range(len(layers.weights)):
        widest = max(widest, layers.weights[i].shape[0])
    return np.empty((len(layers.weights) + 1, widest, BLOCK), np.float32)


@vectorised
def pass_through(layers, number, values, num_layers):
    """Computes the first layers of a network for the points in values[0], and returns the output of the last of them.

    The output of layer i, counted from 0, is written to values[i + 1]. ReLU follows every layer but the network's last.

    Args:
        layers: The network.
        number: Number of points, at most `BLOCK`.
        values: An array of `new_values`.
        num_layers: Number of layers that are computed.
    """
    last = len(layers.weights) - 1
    for i in range(num_layers):
        outputs, bias = values[i + 1], layers.biases[i]
        for j in range(len(bias)):
            for p in range(number):
                outputs[j, p] = bias[j]
        _add_product(layers.weights[i], values[i], number, outputs)
        if i < last:
            for j in range(len(bias)):
                for p in range(number):
                    value = outputs[j, p]
                    outputs[j, p] = ZERO if value < 0 else value
    return values[num_layers]


@vectorised
def _read(array, start, number, values):
    # Rows are cut: Numba checks an index that might be negative, and such a loop is not vectorised.
    for j in range(len(array)):
        row = array[j][start : start + number]
        for p in range(number):
            values[j, p] = row[p]


@vectorised
def _write(values, array, start, number):
    for j in range(len(array)):
        row = array[j][start : start + number]
        for p in range(number):
            row[p] = values[j, p]


@vectorised
def _forward(layers, x, first, last, output):
    values = new_values(layers)
    for start in range(first, last, BLOCK):
        number = min(BLOCK, last - start)
        _read(x, start, number, values[0])
        outputs = pass_through(layers, number, values, len(layers.weights))
        _write(outputs, output, start, number)


@vectorised
def _backward(layers, x, grad_output, first, last, grad_x, grad_weights, grad_biases):
    values, grads = new_values(layers), new_values(layers)
    num_layers = len(layers.weights)
    for start in range(first, last, BLOCK):
        number = min(BLOCK, last - start)
        _read(x, start, number, values[0])
        pass_through(layers, number, values, num_layers - 1)
        _read(grad_output, start, number, grads[num_layers])
        for i in range(num_layers - 1, -1, -1):
            weight, bias, after, before = layers.weights[i], grad_biases[i], grads[i + 1], grads[i]
            for j in range(len(bias)):
                total = ZERO
                for p in range(number):
                    total += after[j, p]
                bias[j] += total
            _add_outer(after, values[i], number, grad_weights[i])
            for k in range(weight.shape[1]):
                for p in range(number):
                    before[k, p] = ZERO
            _add_product(weight.T, after, number, before)
            if i > 0:
                for k in range(weight.shape[1]):
                    for p in range(number):
                        before[k, p] = ZERO if values[i, k, p] <= 0 else before[k, p]
        _write(grads[0], grad_x, start, number)


class _Network(torch.autograd.Function):
    """Maps inputs, shape (in, points), and weight and bias of each layer in turn to outputs, shape (out, points)."""

    @staticmethod
    def forward(ctx, x: Tensor, *parameters: Tensor) -> Tensor:
        ctx.save_for_backward(x, *parameters)
        layers, num_points, inputs = layers_of(parameters), x.shape[1], x.numpy()
        output = torch.empty(len(layers.biases[-1]), num_points)
        outputs = output.numpy()

        def task(index: int) -> None:
            _forward(layers, inputs, TASK * index, min(TASK * (index + 1), num_points), outputs)

        on_threads(task, -(-num_points // TASK))
        return output

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_output: Tensor) -> tuple[Tensor, ...]:
        x, *parameters = ctx.saved_tensors
        layers, num_points, inputs = layers_of(parameters), x.shape[1], x.numpy()
        grad_outputs, grad_x = grad_output.contiguous().numpy(), torch.empty_like(x)
        num_tasks = -(-num_points // TASK)
        by_task = [torch.zeros(num_tasks, *parameter.shape) for parameter in parameters]
        grads, grad_inputs = [found.numpy() for found in by_task], grad_x.numpy()

        def task(index: int) -> None:
            mine = tuple(found[index] for found in grads)
            first, last = TASK * index, min(TASK * (index + 1), num_points)
            _backward(layers, inputs, grad_outputs, first, last, grad_inputs, mine[::2], mine[1::2])

        on_threads(task, num_tasks)
        return (grad_x, *(found.sum(dim=0) for found in by_task))


def network(x: Tensor, parameters: Iterable[Tensor]) -> Tensor:
    """The output of layers with ReLU between them, for float32 tensors on the CPU; differentiable once.

    Args:
        x: Inputs, shape (points, in). The transpose of a contiguous tensor, such as a hash grid returns, is fastest.
        parameters: Weight, shape (out, in), and bias, shape (out), of each layer in turn.

    Returns:
        Shape (points, out), the transpose of a contiguous tensor.
    """
    return _Network.apply(x.t().contiguous(), *parameters).t()
