"""How well brightness of a wide range can be fitted, by what makes brightness of the colour network's output.

    python benchmarks/dynamic_range.py

Free numbers take the place of the network: Adam fits 1000 of them to log brightness spread evenly over a range, up to
an offset. Prints the root mean square errors as a Markdown table.
"""

from __future__ import annotations

from typing import get_args

import torch

from enerf_ns.rendering.field import Brightness, brightness_of
from enerf_ns.sensor.response import Response, response_named

STEPS, LEARNING_RATE = 4000, 1e-2


def fit_error(activation: Brightness, response: Response, spread: float) -> float:
    """Root mean square error of log brightness after the fit."""
    wanted = torch.linspace(0.0, spread, 1000)
    output = torch.zeros(1000, requires_grad=True)
    optimizer = torch.optim.Adam([output], lr=LEARNING_RATE)
    error = wanted
    for _ in range(STEPS):
        optimizer.zero_grad()
        found = response(brightness_of(output, activation))
        error = (found - found.mean()) - (wanted - wanted.mean())
        error.square().mean().backward()
        optimizer.step()
    return float(error.detach().square().mean().sqrt())


if __name__ == "__main__":
    spreads = (4, 5, 6, 8, 10, 14)
    print("| response | brightness | " + " | ".join(map(str, spreads)) + " |\n|" + "---|" * (2 + len(spreads)))
    for name in ("linlog", "logarithm:0.001"):
        for activation in get_args(Brightness):
            errors = [fit_error(activation, response_named(name), spread) for spread in spreads]
            print(f"| {name} | {activation} | " + " | ".join(f"{error:.3f}" for error in errors) + " |", flush=True)
