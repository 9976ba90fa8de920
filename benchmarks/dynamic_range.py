"""Error of a fit to brightness of a wide range, for each activation of the colour network's output.

    python benchmarks/dynamic_range.py

Free numbers take the place of the network: Adam fits 1000 of them to log brightness spread evenly over a range, up to
an offset. Prints the root mean square errors as a Markdown table.
"""

from __future__ import annotations

from typing import get_args

from enerf_ns.bench.numerics.rendering import fit_error
from enerf_ns.rendering.field import Brightness
from enerf_ns.sensor.response import response_named

if __name__ == "__main__":
    spreads = (4, 5, 6, 8, 10, 14)
    print("| response | brightness | " + " | ".join(map(str, spreads)) + " |\n|" + "---|" * (2 + len(spreads)))
    for name in ("linlog", "logarithm:0.001"):
        for activation in get_args(Brightness):
            errors = [fit_error(spread, response_named(name), activation, 4000, 1e-2) for spread in spreads]
            print(f"| {name} | {activation} | " + " | ".join(f"{error:.3f}" for error in errors) + " |", flush=True)
