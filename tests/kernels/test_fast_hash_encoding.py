"""The fast hash grid gives the same numbers inside Nerfstudio's modules."""

from __future__ import annotations

import copy
import re
from pathlib import Path

import torch
from nerfstudio.field_components.encodings import HashEncoding
from nerfstudio.fields.nerfacto_field import NerfactoField
from torch import nn

from enerf_ns.kernels.fast_hash_encoding import FastHashEncoding, speed_up_hash_grids

PAGE = Path(__file__).parents[2] / "docs" / "hash-grid.md"


def test_a_field_of_nerfacto_keeps_values_gradients_and_checkpoint():
    torch.manual_seed(0)
    box = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    field = NerfactoField(box, num_images=1, log2_hashmap_size=8, num_levels=4, implementation="torch")
    fast = copy.deepcopy(field)
    assert speed_up_hash_grids(fast) == 1 and speed_up_hash_grids(fast) == 0
    assert any(type(part) is FastHashEncoding for part in fast.modules())
    assert not any(type(part) is HashEncoding for part in fast.modules())
    assert fast.state_dict().keys() == field.state_dict().keys()
    positions = torch.rand(200, 3) * 2 - 1
    gradients = []
    for each in (field, fast):
        density = each.density_fn(positions)
        table = next(parameter for name, parameter in each.named_parameters() if name.endswith("hash_table"))
        gradients.append((density, *torch.autograd.grad(density.sum(), table)))
    for expected, found in zip(*gradients, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)


def test_what_has_no_hash_grid_is_left_alone():
    assert speed_up_hash_grids(nn.Linear(3, 3)) == 0


def test_examples_of_the_page_run():
    examples = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert len(examples) == 2
    for example in examples:
        exec(example, {})
