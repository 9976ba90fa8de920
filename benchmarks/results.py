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

from PIL import Image, ImageDraw

from enerf_ns.bench.measures import VIEW
from enerf_ns.bench.published import PSNR_SSIM_LPIPS
from enerf_ns.bench.runner import Bench
from enerf_ns.bench.settings import BenchSettings
from enerf_ns.bench.tables import markdown, scores_table
from enerf_ns.dataparsers.recording.files import write_whole
from enerf_ns.report.tables import Table

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
FIGURES = ROOT / "docs" / "figures"
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

MARKED = re.compile(r"(<!-- enerf bench \S+: (\S+) -->\n).*?(<!-- end of \S+ -->)", re.DOTALL)
SUMMARY = re.compile(r"(<!-- summary -->\n).*?(<!-- summary ends -->)", re.DOTALL)

SUMMARISED = {"shake": ("shake-moon2", "shake-carpet1"), "design": ("shapes",)}
"""Sequences in the summary, by experiment."""

ROWS_OF_SUMMARY = ("nerf-blurred", "events", "events+blurred")

VIEW_WIDTH = 160
"""Width in pixels of a held-out view in a figure."""


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


def summary() -> str:
    """Scores of the main rows, from the committed result files."""
    rows, about = [], set()
    for name, sequences in SUMMARISED.items():
        results = json.loads((RESULTS / f"{name}.json").read_text())
        chosen = [run for run in results["runs"] if run["sequence"] in sequences and run["row"] in ROWS_OF_SUMMARY]
        shown = {**results, "runs": chosen, "columns": PSNR_SSIM_LPIPS, "published": {}}
        rows += scores_table(shown, bold=True).rows
        about |= {(results["budget"], run["version"]) for run in chosen}
    table = Table("", ["sequence", "learned from", "PSNR, dB", "SSIM", "LPIPS"], [row[:5] for row in rows])
    budgets, versions = ({one[place] for one in about} for place in (0, 1))
    steps, version = " or ".join(sorted(budgets)), " and ".join(sorted(versions))
    return f"{table.markdown()}\n\nEach training took {steps} steps on one CPU core, with version {version}."


def views(bench: Bench) -> Image.Image:
    """One held-out frame of each sequence beside the renders of all rows, of the first seed.

    A run leaves a picture of both (`VIEW`), so that a row without runs on this machine has no picture.
    """
    header, label = 14, 90
    sequences = {}
    for cell in bench.cells:
        file = bench.folder(cell) / VIEW / "eval_img_0000.png"
        if cell.seed == 0 and file.exists():
            with Image.open(file) as both:
                half = both.width // 2
                height = round(both.height * VIEW_WIDTH / half)
                frame, render = (
                    both.crop((start, 0, start + half, both.height)).resize((VIEW_WIDTH, height)) for start in (0, half)
                )
            sequences.setdefault(cell.sequence, {"frame": frame})[cell.row] = render
    columns = list(dict.fromkeys(name for pictures in sequences.values() for name in pictures))
    heights = [max(picture.height for picture in pictures.values()) for pictures in sequences.values()]
    figure = Image.new(
        "RGB", (label + len(columns) * (VIEW_WIDTH + 2), header + sum(heights) + 2 * len(heights)), "white"
    )
    draw, top = ImageDraw.Draw(figure), header
    for number, name in enumerate(columns):
        draw.text((label + number * (VIEW_WIDTH + 2), 1), name, fill="black")
    for (sequence, pictures), height in zip(sequences.items(), heights, strict=True):
        draw.text((1, top + height // 2), sequence, fill="black")
        for number, name in enumerate(columns):
            if name in pictures:
                figure.paste(pictures[name], (label + number * (VIEW_WIDTH + 2), top))
        top += height + 2
    return figure


def write_figures(name: str, bench: Bench) -> None:
    """Writes docs/figures/results-NAME.png, error against time, and results-NAME-views.png, where there are some."""
    curve = bench.output_dir / f"{name}.png"
    if curve.exists():
        shutil.copy(curve, FIGURES / f"results-{name}.png")
    figure = views(bench)
    if figure.height > figure.width // 100:
        figure.save(FIGURES / f"results-{name}-views.png", optimize=True)


def write_pages() -> None:
    """Puts the tables of the committed result files between their marks on the pages."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")

        def table(found: re.Match[str]) -> str:
            made = markdown(json.loads((ROOT / found[2]).read_text())).strip("\n")
            return f"{found[1]}\n{made}\n\n{found[3]}"

        text = MARKED.sub(table, text)
        write_whole(page, SUMMARY.sub(lambda found: f"{found[1]}{summary()}\n\n{found[2]}", text))


def main() -> None:
    parser = argparse.ArgumentParser(description="Trains and scores every table of the pages.")
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
    passes = [benches(arguments, seeds) for seeds in range(1, SEEDS + 1)]  # all, before any writes a result file
    for seeds, experiments in enumerate(passes, 1):
        for name, bench in experiments.items():
            begin = time.monotonic()
            for cell, result in bench.run():
                training = f"{name}: {cell.sequence}, {cell.row}, seed {cell.seed}"
                if result is None:
                    print(f"{training} …", flush=True)
                elif "failure" in result:
                    print(f"{training} failed: {result['failure']}", flush=True)
            print(f"{name}, seeds: {seeds}, after {time.monotonic() - begin:.0f} s", flush=True)
    if arguments.pages:
        for name, bench in passes[-1].items():
            shutil.copy(arguments.output_dir / f"{name}.json", RESULTS)
            write_figures(name, bench)
        write_pages()


if __name__ == "__main__":
    main()
