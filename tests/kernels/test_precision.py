"""Losses, and functions with `full_precision`, compute in float32 from half precision and under autocast."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from enerf_ns.kernels.precision import full_precision
from enerf_ns.sensor.response import luma
from enerf_ns.supervision.losses import (
    frame_loss,
    huber_event_loss,
    no_event_loss,
    normalised_event_loss,
    squared_event_loss,
)

OF_CHANGES: list[Callable[[Tensor, Tensor], Tensor]] = [
    lambda predicted, measured: squared_event_loss(predicted, measured, 0.25),
    lambda predicted, measured: huber_event_loss(predicted, measured, 0.25),
    normalised_event_loss,
    lambda predicted, _: no_event_loss(predicted, (0.2, 0.3), 0.5),
    lambda rendered, recorded: frame_loss(rendered.view(-1, 4)[:, :3], recorded.view(-1, 4)[:, :3], grey=True),
    lambda rendered, _: luma(rendered.view(-1, 4)[:, :3]).sum(),
]


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("loss", OF_CHANGES)
def test_losses_never_see_half(loss: Callable[[Tensor, Tensor], Tensor], dtype: torch.dtype):
    torch.manual_seed(0)
    predicted, measured = torch.rand(2, 400).to(dtype)
    expected = loss(predicted.float(), measured.float())
    assert loss(predicted, measured).dtype == torch.float32
    torch.testing.assert_close(loss(predicted, measured), expected, rtol=0, atol=0)
    with torch.autocast("cpu", dtype=dtype):
        torch.testing.assert_close(loss(predicted.float(), measured.float()), expected, rtol=0, atol=0)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_a_matrix_product_in_full_precision_is_that_without_autocast(dtype: torch.dtype):
    torch.manual_seed(0)
    first, second = torch.rand(2, 20, 20)
    expected, wide = first @ second, (first.double() @ second.double())
    product = full_precision(torch.matmul)
    with torch.autocast("cpu", dtype=dtype):
        assert torch.matmul(first, second).dtype == dtype, "autocast is at work"
        assert torch.equal(product(first, second), expected)
        assert product(first.to(dtype), other=second.to(dtype)).dtype == torch.float32
        assert torch.equal(product(first.double(), second.double()), wide)
