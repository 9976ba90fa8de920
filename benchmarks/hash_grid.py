"""Speed of the hash grid on the CPU beside Nerfstudio's PyTorch HashEncoding, and of Adam's step on its table.

Prints Markdown tables. The backends take turns, and every time is the minimum of the repetitions, so that other work on
the machine disturbs little. Positions are uniform in the unit cube, which is harder on the caches than samples along
rays; they need no gradients, as in training.

    python benchmarks/hash_grid.py
"""

from __future__ import annotations

import time
from collections.abc import Callable

import torch
from nerfstudio.field_components.encodings import HashEncoding

from enerf_ns.encodings.hash_grid import HashGrid

REPETITIONS = 10
SETTINGS = [  # positions, levels, log2 of rows per level
    (65_536, 16, 19),
    (100_000, 10, 17),
]


def minimum_times(functions: dict[str, Callable[[], object]]) -> dict[str, float]:
    """The least time in milliseconds of each function, called in turn, after one call that does not count."""
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(REPETITIONS + 1):
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            times[name].append(1e3 * (time.perf_counter() - start))
    return {name: min(values[1:]) for name, values in times.items()}


def encodings(num_positions: int, num_levels: int, log2_table_size: int) -> None:
    x = torch.rand(num_positions, 3)
    grad = torch.rand(num_positions, 2 * num_levels)
    grids: dict[str, torch.nn.Module] = {
        "Nerfstudio, PyTorch": HashEncoding(num_levels, log2_hashmap_size=log2_table_size, implementation="torch"),
        "HashGrid, torch": HashGrid(num_levels, log2_table_size=log2_table_size, backend="torch"),
        "HashGrid, numba": HashGrid(num_levels, log2_table_size=log2_table_size, backend="numba"),
    }

    @torch.no_grad()
    def forward(grid: torch.nn.Module) -> None:
        grid(x)

    def forward_and_backward(grid: torch.nn.Module) -> None:
        grid.zero_grad()
        grid(x).backward(grad)

    only_forward = minimum_times({name: lambda grid=grid: forward(grid) for name, grid in grids.items()})
    both = minimum_times({name: lambda grid=grid: forward_and_backward(grid) for name, grid in grids.items()})
    print(f"\n{num_positions} positions, {num_levels} levels of 2^{log2_table_size} rows of 2 features\n")
    print("| | forward, ms | ratio | forward and backward, ms | ratio |\n|---|---:|---:|---:|---:|")
    for name in grids:
        ratios = [times["Nerfstudio, PyTorch"] / times[name] for times in (only_forward, both)]
        print(f"| {name} | {only_forward[name]:.1f} | {ratios[0]:.1f} | {both[name]:.1f} | {ratios[1]:.1f} |")


def adam(num_levels: int, log2_table_size: int) -> None:
    steps = {}
    for name, options in {"default": {}, "fused": {"fused": True}}.items():
        table = HashGrid(num_levels, log2_table_size=log2_table_size).table
        table.grad = torch.rand_like(table)
        steps[name] = torch.optim.Adam([table], eps=1e-15, **options).step
    times = minimum_times(steps)
    print(f"\nAdam's step on {num_levels} levels of 2^{log2_table_size} rows of 2 features\n")
    print("| | step, ms | ratio |\n|---|---:|---:|")
    for name in times:
        print(f"| {name} | {times[name]:.1f} | {times['default'] / times[name]:.1f} |")


if __name__ == "__main__":
    print(f"PyTorch {torch.__version__}, {torch.get_num_threads()} threads, minimum of {REPETITIONS} repetitions")
    for num_positions, num_levels, log2_table_size in SETTINGS:
        encodings(num_positions, num_levels, log2_table_size)
    for _, num_levels, log2_table_size in SETTINGS:
        adam(num_levels, log2_table_size)
