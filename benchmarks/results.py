"""Every table of the pages, by one command from one commit: trained, written, and put on the pages.

The trainings of all tables with one seed come first, so that a whole picture is there early; then those with the
second and the third seed. What is finished is not run again, in the output folder or in the committed result files, as
long as the code and the settings that it depends on are the same. With --pages, the result files are copied to
benchmarks/results/, and their tables to the pages. With --keep, they are copied to benchmarks/results/next/, from where
another machine goes on. Without both, nothing but the output folder is written.

    python benchmarks/results.py --slider-depth path/to/slider_depth --reconstruction-weights path/to/firenet_1000.pth
    python benchmarks/results.py --only shake design --keep
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
from pose_refinement import found_by_fault, scores_by_fault

from enerf_ns.bench.diagram import diagram
from enerf_ns.bench.measures import VIEW
from enerf_ns.bench.published import PSNR_SSIM_LPIPS
from enerf_ns.bench.runner import Bench
from enerf_ns.bench.settings import BenchSettings
from enerf_ns.bench.tables import markdown, scores_table
from enerf_ns.dataparsers.recording.files import write_whole
from enerf_ns.method.origin import code_version
from enerf_ns.report.tables import Table

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
NEXT = RESULTS / "next"
"""Results of the version that all tables are to be of next, and its figures of views, until all are finished."""

FIGURES = ROOT / "docs" / "figures"
PAGES = (ROOT / "README.md", ROOT / "benchmarks" / "README.md", *sorted((ROOT / "docs").glob("*.md")))

SEEDS = 3
OF_THE_PAPER = ("nerf-sharp", "nerf-blurred", "deblur", "e2vid", "events", "events+blurred")

PLAN: dict[str, dict[str, Any]] = {
    "shake": {"budget": "2000", "rows": OF_THE_PAPER},
    "spiral": {"budget": "2000", "rows": OF_THE_PAPER},
    "levelling": {"budget": "2000"},
    "depth": {"budget": "2000", "rows": OF_THE_PAPER},
    "design": {"budget": "2000", "rows": ("nerf-blurred", "deblur", "events", "events+blurred")},
    "slider-depth": {"budget": "2000"},
    "run-time": {"budget": "100", "seeds": 1},
    "parts": {"budget": "600", "seeds": 1},
    "left-out": {"budget": "400"},
    "unbounded": {"budget": "400", "scale": 0.1875},
    "ablation": {"budget": "2000"},
    "encoding": {"budget": "2000"},
    "views": {"budget": "2000"},
    "no-event-weight": {"budget": "2000"},
    "frame-weight": {"budget": "2000"},
    "losses": {"budget": "2000"},
    "sensor": {"budget": "2000"},
    "full-size": {"budget": "8000", "scale": 1.0, "seeds": 1},
}
"""Experiments in the order in which they are run, with the settings that differ from the defaults of `enerf bench`."""

MARKED = re.compile(r"(<!-- enerf bench \S+: (\S+) -->\n).*?(<!-- end of \S+ -->)", re.DOTALL)
SCORES = re.compile(r"(<!-- scores of (.+?) on (.+?) -->\n).*?(<!-- scores end -->)", re.DOTALL)
"""The mark of a small table: rows, then experiment/sequence or experiment/sequence/protocol, with spaces between."""

REFINEMENT = re.compile(
    r"(<!-- pose refinement, (scores|found) on (.+?) of (.+?) after (\d+) steps -->\n).*?"
    r"(<!-- pose refinement ends -->)",
    re.DOTALL,
)
"""The mark of a table of wrong poses: what it shows, its recordings and its faults, with spaces between."""

KEYS = "recording", "fault", "steps"
OF_REFINEMENT = {"scores": scores_by_fault, "found": found_by_fault}

FIGURE_WIDTH = 1250
"""Most pixels across a figure of held-out views."""

LABEL_WIDTH = 112
"""Width in pixels of the names of the sequences beside the views."""


def benches(arguments: argparse.Namespace, seeds: int) -> dict[str, Bench]:
    """The experiments with this number of seeds, by name. Those without their recording are left out."""
    found = {}
    for name in arguments.only:
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


def scores(rows: list[str], places: list[str]) -> str:
    """A table of PSNR, SSIM and LPIPS from the committed result files, as the mark `SCORES` names its rows."""
    lines, about = [], set()
    for place in places:
        name, sequence, *protocol = place.split("/")
        results = json.loads((RESULTS / f"{name}.json").read_text())
        runs = [run for run in results["runs"] if run["sequence"] == sequence and run["row"] in rows]
        columns, protocols = PSNR_SSIM_LPIPS, protocol or results["protocols"][:1]
        shown = {**results, "runs": runs, "columns": columns, "protocols": protocols, "published": {}}
        lines += scores_table(shown, bold=True).rows
        about |= {(results["budget"], run["version"]) for run in runs}
    table = Table("", ["sequence", "learned from", "PSNR, dB", "SSIM", "LPIPS"], [line[:5] for line in lines])
    budgets, versions = ({one[place] for one in about} for place in (0, 1))
    steps, version = " or ".join(sorted(budgets)), " and ".join(sorted(versions))
    return f"{table.markdown()}\n\nEach training took {steps} steps on one CPU core, with version {version}."


def refinement(shown: str, recordings: list[str], faults: list[str], steps: int) -> str:
    """A table of wrong poses from the committed trainings of benchmarks/pose_refinement.py."""
    trained = map(json.loads, (RESULTS / "pose-refinement.jsonl").read_text().splitlines())
    kinds = recordings, faults, [steps]
    runs = [run for run in trained if all(run[key] in kind for key, kind in zip(KEYS, kinds, strict=True))]
    versions = " and ".join(sorted({run["version"] for run in runs}))
    return f"{OF_REFINEMENT[shown](runs, recordings, faults, steps)}\n\nThe trainings are of version {versions}."


def pictures(bench: Bench) -> dict[str, dict[str, Path]]:
    """By sequence and row, the picture (`VIEW`) of a held-out frame beside its render that the run of the first seed
    left on this machine."""
    found: dict[str, dict[str, Path]] = {}
    for cell in bench.cells:
        file = bench.folder(cell) / VIEW / "eval_img_0000.png"
        if cell.seed == 0 and file.exists():
            found.setdefault(cell.sequence, {})[cell.row] = file
    return found


def views(bench: Bench) -> Image.Image:
    """One held-out frame of each sequence beside the renders of all rows whose `pictures` are there."""
    header, gap, label = 14, 2, LABEL_WIDTH
    sequences: dict[str, dict[str, Image.Image]] = {}
    for sequence, files in pictures(bench).items():
        for row, file in files.items():
            with Image.open(file) as both:
                half = both.width // 2
                frame, render = (both.crop((start, 0, start + half, both.height)) for start in (0, half))
            sequences.setdefault(sequence, {"frame": frame})[row] = render
    columns = list(dict.fromkeys(name for shown in sequences.values() for name in shown))
    width = (FIGURE_WIDTH - label) // max(1, len(columns)) - gap
    heights = [round(shown["frame"].height * width / shown["frame"].width) for shown in sequences.values()]
    size = (label + len(columns) * (width + gap), header + sum(heights) + gap * len(heights))
    figure = Image.new("RGB", size, "white")
    draw, top = ImageDraw.Draw(figure), header
    for number, name in enumerate(columns):
        draw.text((label + number * (width + gap), 1), name, fill="black")
    for (sequence, shown), height in zip(sequences.items(), heights, strict=True):
        draw.text((1, top + height // 2), sequence, fill="black")
        for number, name in enumerate(columns):
            if name in shown:
                figure.paste(shown[name].resize((width, height)), (label + number * (width + gap), top))
        top += height + gap
    return figure


def shown_figure(name: str, kind: str = "") -> str | None:
    """File name of the figure of an experiment; None if no page shows it."""
    file = f"results-{name}{kind}.png"
    return file if any(file in page.read_text(encoding="utf-8") for page in PAGES) else None


def write_views(name: str, bench: Bench, folder: Path) -> None:
    """Writes results-NAME-views.png, if a page shows it and the runs of all rows are on this machine."""
    file = shown_figure(name, "-views")
    there = sum(map(len, pictures(bench).values()))
    if file and there == sum(cell.seed == 0 for cell in bench.cells):
        views(bench).quantize(256).save(folder / file, optimize=True)
    elif file:
        print(f"{file} is not written: not all of its runs are on this machine", flush=True)


def merged(*files: Path) -> dict[str, Any]:
    """The contents of the last of some result files that are there, with the trainings of all."""
    found = [json.loads(file.read_text()) for file in files if file.exists()]
    runs: dict[str, dict[str, Any]] = {}
    for run in (run for results in found for run in results["runs"]):
        if "failure" not in run or run["inputs"] not in runs:
            runs[run["inputs"]] = run
    return {**found[-1], "runs": list(runs.values())}


def keep(name: str, bench: Bench) -> None:
    """Keeps the results of an experiment in `NEXT`, from where another machine goes on."""
    NEXT.mkdir(parents=True, exist_ok=True)
    results = merged(NEXT / f"{name}.json", bench.output_dir / f"{name}.json")
    runs = [run for run in results["runs"] if run["version"] == code_version()]
    write_whole(NEXT / f"{name}.json", json.dumps({**results, "runs": runs}, indent=1) + "\n")
    write_views(name, bench, NEXT)


def publish(name: str, bench: Bench) -> None:
    """Puts the results of an experiment and its figures where the pages take them from."""
    shutil.copy(bench.output_dir / f"{name}.json", RESULTS)
    (NEXT / f"{name}.json").unlink(missing_ok=True)
    if file := shown_figure(name):
        picture = diagram(json.loads((RESULTS / f"{name}.json").read_text()))
        assert picture is not None
        (FIGURES / file).write_bytes(picture)
    kept = NEXT / f"results-{name}-views.png"
    if kept.exists():
        shutil.move(kept, FIGURES / kept.name)
    else:
        write_views(name, bench, FIGURES)


def written(page: str) -> str:
    """The text of a page with the tables of the committed result files between their marks."""

    def table(found: re.Match[str]) -> str:
        made = markdown(json.loads((ROOT / found[2]).read_text())).strip("\n")
        return f"{found[1]}\n{made}\n\n{found[3]}"

    def small(found: re.Match[str]) -> str:
        return f"{found[1]}\n{scores(found[2].split(), found[3].split())}\n\n{found[4]}"

    def wrong_poses(found: re.Match[str]) -> str:
        made = refinement(found[2], found[3].split(), found[4].split(), int(found[5]))
        return f"{found[1]}\n{made}\n\n{found[6]}"

    return REFINEMENT.sub(wrong_poses, SCORES.sub(small, MARKED.sub(table, page)))


def main() -> None:
    parser = argparse.ArgumentParser(description="Trains and scores every table of the pages.")
    parser.add_argument(
        "--only", nargs="*", choices=PLAN, default=list(PLAN), help="experiments to run, or none; default: all"
    )
    parser.add_argument("--slider-depth", type=Path, help="recording slider_depth of UZH's data set")
    parser.add_argument("--reconstruction-weights", type=Path, help="weights of E2VID or FireNet")
    parser.add_argument("--output-dir", type=Path, default=ROOT / "outputs" / "results")
    parser.add_argument("--keep", action="store_true", help="keep what is finished for a run on another machine")
    parser.add_argument("--pages", action="store_true", help="copy the results of all seeds to the pages")
    arguments = parser.parse_args()
    arguments.output_dir.mkdir(parents=True, exist_ok=True)
    for name in {file.name for folder in (RESULTS, NEXT) for file in folder.glob("*.json")}:
        results = merged(*(folder / name for folder in (RESULTS, NEXT, arguments.output_dir)))
        write_whole(arguments.output_dir / name, json.dumps(results))
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
            if arguments.keep:
                keep(name, bench)
    if arguments.pages:
        for name, bench in passes[-1].items():
            publish(name, bench)
        for page in PAGES:
            write_whole(page, written(page.read_text(encoding="utf-8")))


if __name__ == "__main__":
    main()
