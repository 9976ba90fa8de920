"""Every table of the pages, by one command from one commit: trained, written, and put on the pages.

The trainings of all tables with one seed come first, so that a whole picture is there early; then those with the
second and the third seed. What is finished is not run again, in the output folder or in the committed result files, as
long as the code and the settings that it depends on are the same. With --pages, the result files are copied to
benchmarks/results/, and their tables to the pages. Without it, nothing but the output folder is written.

    python benchmarks/results.py --slider-depth path/to/slider_depth --reconstruction-weights path/to/firenet_1000.pth
    python benchmarks/results.py --only shake design --pages
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import time
from pathlib import Path
from typing import Any

from enerf_ns.bench.runner import Bench
from enerf_ns.bench.settings import BenchSettings
from enerf_ns.bench.tables import markdown
from enerf_ns.dataparsers.recording.files import write_whole

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PAGES = (ROOT / "README.md", ROOT / "benchmarks" / "README.md", ROOT / "docs" / "results.md")

SEEDS = 3
OF_THE_PAPER = ("nerf-sharp", "nerf-blurred", "deblur", "e2vid", "events", "events+blurred")

PLAN: dict[str, dict[str, Any]] = {
    "shake": {"budget": "1000", "rows": OF_THE_PAPER},
    "spiral": {"budget": "1000", "rows": OF_THE_PAPER},
    "design": {"budget": "1000", "rows": ("nerf-blurred", "deblur", "events", "events+blurred")},
    "slider-depth": {"budget": "1000"},
    "run-time": {"budget": "100", "seeds": 1},
    "parts": {"budget": "600", "seeds": 1},
    "left-out": {"budget": "400"},
    "unbounded": {"budget": "400", "scale": 0.1875},
    "ablation": {"budget": "1000"},
    "encoding": {"budget": "1000"},
    "views": {"budget": "1000"},
    "no-event-weight": {"budget": "1000"},
    "frame-weight": {"budget": "1000"},
    "losses": {"budget": "1000"},
    "sensor": {"budget": "1000"},
}
"""Experiments in the order in which they are run, with the settings that differ from the defaults of `enerf bench`."""

MARKED = re.compile(r"(<!-- enerf bench (\S+): \S+ -->\n).*?(<!-- end of \S+ -->)", re.DOTALL)


def benches(arguments: argparse.Namespace, seeds: int) -> dict[str, Bench]:
    """The experiments with this number of seeds, by name. Those without their recording are left out."""
    found = {}
    for name in arguments.only or PLAN:
        settings: dict[str, Any] = {
            "scale": 0.25,
            "threads": 1,
            "output_dir": arguments.output_dir,
            "reconstruction_weights": arguments.reconstruction_weights,
            **PLAN[name],
        }
        if name == "slider-depth":
            if arguments.slider_depth is None:
                print("slider-depth is left out; --slider-depth names no recording", flush=True)
                continue
            settings["data"] = arguments.slider_depth
        found[name] = Bench(name, BenchSettings(**{**settings, "seeds": min(seeds, settings.get("seeds", SEEDS))}))
    return found


def write_pages() -> None:
    """Puts the tables of the committed result files between their marks on the pages."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")

        def table(found: re.Match[str]) -> str:
            file = RESULTS / f"{found[2]}.json"
            if not file.exists():
                return found[0]
            return f"{found[1]}\n{markdown(json.loads(file.read_text())).strip()}\n\n{found[3]}"

        write_whole(page, MARKED.sub(table, text))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", nargs="*", choices=PLAN, default=[], help="experiments to run; default: all")
    parser.add_argument("--slider-depth", type=Path, help="recording slider_depth of UZH's data set")
    parser.add_argument("--reconstruction-weights", type=Path, help="weights of E2VID or FireNet")
    parser.add_argument("--output-dir", type=Path, default=ROOT / "outputs" / "results")
    parser.add_argument("--pages", action="store_true", help="copy the results of all seeds to the pages")
    arguments = parser.parse_args()
    arguments.output_dir.mkdir(parents=True, exist_ok=True)
    for file in RESULTS.glob("*.json"):
        if not (arguments.output_dir / file.name).exists():
            shutil.copy(file, arguments.output_dir)
    for seeds in range(1, SEEDS + 1):
        for name, bench in benches(arguments, seeds).items():
            begin, number = time.monotonic(), len(bench.cells)
            for cell, result in bench.run():
                if result is None:
                    print(f"{name}: {cell.sequence}, {cell.row}, seed {cell.seed} …", flush=True)
                elif "failure" in result:
                    print(
                        f"{name}: {cell.sequence}, {cell.row}, seed {cell.seed} failed: {result['failure']}", flush=True
                    )
            print(f"{name}, {seeds} seeds: {number} trainings, {time.monotonic() - begin:.0f} s", flush=True)
    if arguments.pages:
        for name in passes[-1]:
            shutil.copy(arguments.output_dir / f"{name}.json", RESULTS)
        write_pages()


if __name__ == "__main__":
    main()
