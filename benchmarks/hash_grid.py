"""Speed of the hash grid beside Nerfstudio's PyTorch HashEncoding, and of Adam's step on its table.

Runs on the GPU where there is one, unless --device says otherwise. Prints Markdown tables, and stores their numbers
under --json. The backends take turns, and every time is the minimum of the repetitions, so that other work on the
machine disturbs little. Positions are uniform in the unit cube, which is harder on the caches than samples along rays;
they need no gradients, as in training.

    python benchmarks/hash_grid.py
    python benchmarks/hash_grid.py --device cpu --json hash-grid.json
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from nerfstudio.field_components.encodings import HashEncoding

from enerf_ns.kernels.hash_grid import BACKENDS, HashGrid
from enerf_ns.method.stopwatch import seconds_of

REPETITIONS = 10
THEIRS = "Nerfstudio, PyTorch"
SETTINGS = [  # positions, levels, log2 of rows per level
    (65_536, 16, 19),
    (100_000, 10, 17),
]


def minimum_times(functions: dict[str, Callable[[], object]], device: torch.device) -> dict[str, float]:
    """The least time in milliseconds of each function, called in turn, after one call that does not count."""
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(REPETITIONS + 1):
        for name, function in functions.items():
            times[name].append(1e3 * seconds_of(function, device))
    return {name: min(values[1:]) for name, values in times.items()}


def encodings(num_positions: int, num_levels: int, log2_table_size: int, device: torch.device) -> dict[str, Any]:
    """Milliseconds of each backend that fits the device, and of Nerfstudio's."""
    x = torch.rand(num_positions, 3, device=device)
    grad = torch.rand(num_positions, 2 * num_levels, device=device)
    theirs = HashEncoding(num_levels, log2_hashmap_size=log2_table_size, implementation="torch").to(device)
    theirs.scalings = theirs.scalings.to(device)  # else it is moved at each call
    grids: dict[str, torch.nn.Module] = {THEIRS: theirs}
    for backend in ("torch", *(name for name, backend in BACKENDS.items() if backend.misfit(device.type) is None)):
        grid = HashGrid(num_levels, log2_table_size=log2_table_size, backend=backend).to(device)
        grids[f"HashGrid, {backend}"] = grid

    @torch.no_grad()
    def forward(grid: torch.nn.Module) -> None:
        grid(x)

    def forward_and_backward(grid: torch.nn.Module) -> None:
        grid.zero_grad()
        grid(x).backward(grad)

    only_forward = minimum_times({name: lambda grid=grid: forward(grid) for name, grid in grids.items()}, device)
    both = minimum_times({name: lambda grid=grid: forward_and_backward(grid) for name, grid in grids.items()}, device)
    print(f"\n{num_positions} positions, {num_levels} levels of 2^{log2_table_size} rows of 2 features\n")
    print("| | forward, ms | ratio | forward and backward, ms | ratio |\n|---|---:|---:|---:|---:|")
    for name in grids:
        ratios = [times[THEIRS] / times[name] for times in (only_forward, both)]
        print(f"| {name} | {only_forward[name]:.2f} | {ratios[0]:.1f} | {both[name]:.2f} | {ratios[1]:.1f} |")
    about = {"positions": num_positions, "levels": num_levels, "log2_table_size": log2_table_size}
    return about | {"forward_ms": only_forward, "forward_and_backward_ms": both}


def adam(num_levels: int, log2_table_size: int, device: torch.device) -> dict[str, Any]:
    """Milliseconds of a step of either implementation."""
    steps = {}
    for name, options in {"default": {}, "fused": {"fused": True}}.items():
        table = HashGrid(num_levels, log2_table_size=log2_table_size).to(device).table
        table.grad = torch.rand_like(table)
        steps[name] = torch.optim.Adam([table], eps=1e-15, **options).step
    times = minimum_times(steps, device)
    print(f"\nAdam's step on {num_levels} levels of 2^{log2_table_size} rows of 2 features\n")
    print("| | step, ms | ratio |\n|---|---:|---:|")
    for name in times:
        print(f"| {name} | {times[name]:.2f} | {times['default'] / times[name]:.1f} |")
    return {"levels": num_levels, "log2_table_size": log2_table_size, "adam_ms": times}


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu", type=torch.device)
    parser.add_argument("--json", type=Path)
    flags = parser.parse_args()
    name = torch.cuda.get_device_name() if flags.device.type == "cuda" else f"CPU, {torch.get_num_threads()} threads"
    print(f"PyTorch {torch.__version__}, {name}, minimum of {REPETITIONS} repetitions")
    results = [encodings(*sizes, flags.device) for sizes in SETTINGS]
    results += [adam(levels, log2_table_size, flags.device) for _, levels, log2_table_size in SETTINGS]
    if flags.json:
        flags.json.write_text(json.dumps({"device": name, "torch": torch.__version__, "results": results}, indent=1))
