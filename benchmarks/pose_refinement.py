"""Effect of refining clock, mount, lens and trajectory, for wrong and for correct poses.

Simulates recordings of the validation set and the demo's, thins their poses out to 200 a second, makes each wrong in
one way or in all, and trains with the right poses, with the wrong ones as they are, and with the wrong ones refined;
nothing is told of what is wrong. Writes a line of JSON for each training to --output, where it goes on when it is
called again, and prints a table of means over the seeds.

    python benchmarks/pose_refinement.py --recordings shapes clutter --faults none clock-5 all --seeds 3 --steps 1000
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

POSES_EVERY_NS = 5_000_000
DRIFT_KNOTS = 5
EDGE_NS = 20_000_000
TRACK_INSTANTS, FEWEST_INSTANTS = 100, 10
"""Number of instants of a track of a point of the scene, and fewest of them at which it is in the picture."""
TRACK_VIEWS = 0, 24, 49, 74, 99
"""Instants at whose views points are placed."""

FAULTS: dict[str, dict[str, Any]] = {
    "none": {},
    **{f"clock-{delay}": {"clock": delay} for delay in (2, 5, 10, 20)},
    "noise": {"noise": (1.0, 0.1)},
    "drift-5": {"drift": (5.0, 0.3)},
    "drift-10": {"drift": (10.0, 0.5)},
    "drift-20": {"drift": (20.0, 1.0)},
    "mount": {"mount": (5.0, 1.0)},
    **{f"focal-{share}": {"focal": 1.0 + share / 100.0} for share in (1, 3, 10)},
    "all": {"clock": 10, "mount": (5.0, 1.0), "focal": 1.03, "drift": (10.0, 0.5), "noise": (1.0, 0.1)},
}
"""What is wrong: milliseconds of the poses' clock; millimetres and degrees of white noise, of a smooth drift at its
largest, and of the mount; the focal length as a multiple of the right one."""

OFF = {f"pipeline.poses.refine_{part}": False for part in ("clock", "mount", "lens", "drift")} | {
    "pipeline.datamanager.dataparser.smooth_poses": False
}
ROWS = {"fixed": OFF, "refined": {}, "contrast": OFF, "adam": {}}
"""Changes to the configuration. Beside poses as they are, and refined: what the sharpest events tell of clock and focal
length before training, and nothing later; and all numbers at once by Adam, at every look, without a test of what is
wrong, as other codes refine poses."""

COMPARED = "fixed", "refined"
PARTS_OF_MOUNT = "rotation", "translation"
REPROJECTION = "reprojection_before", "reprojection_after"

ADAM_RATE, ADAM_DECAYS = 0.02, (0.9, 0.99)
"""Learning rate, in the unit of each number, and decays of the moments."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", nargs="+", default=["shapes", "clutter", "floor", "relief-large"])
    parser.add_argument("--faults", nargs="+", default=list(FAULTS), choices=list(FAULTS))
    parser.add_argument("--rows", nargs="+", default=list(COMPARED), choices=list(ROWS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--jobs", type=int, default=2, help="trainings side by side, of one thread each")
    parser.add_argument("--work", type=Path, default=Path("outputs/pose-refinement"))
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/pose-refinement.jsonl"))
    parser.add_argument("--cell", help="one training, as JSON; for the program itself")
    arguments = parser.parse_args()
    if arguments.cell:
        print(json.dumps(trained(json.loads(arguments.cell), arguments.work)))
        return
    done = [json.loads(line) for line in arguments.output.read_text().splitlines()] if arguments.output.exists() else []
    keys = ("recording", "fault", "row", "seed", "steps")
    known = {tuple(result[key] for key in keys) for result in done}
    cells: list[dict[str, Any]] = [
        dict(zip(keys, cell, strict=True))
        for seed in range(arguments.seeds)
        for fault in arguments.faults
        for recording in arguments.recordings
        for row in arguments.rows
        if (cell := (recording, fault, row, seed, arguments.steps)) not in known
    ]
    for cell in cells:
        right = right_poses(cell["recording"], arguments.work)
        folder = arguments.work / cell["recording"] / f"{cell['fault']}-{cell['seed']}"
        if not (folder / "poses.txt").exists():
            made_wrong(right, folder, FAULTS[cell["fault"]], cell["seed"])

    def run(cell: dict[str, Any]) -> None:
        command = [sys.executable, __file__, "--work", str(arguments.work), "--cell", json.dumps(cell)]
        threads = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
        told = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **threads})
        if told.returncode:
            print(f"{cell} failed: {told.stderr.strip().splitlines()[-1:]}", flush=True)
            return
        result = json.loads(told.stdout.strip().splitlines()[-1])
        with arguments.output.open("a") as file:
            file.write(json.dumps(result) + "\n")
        done.append(result)
        print(f"{cell}: {result['psnr']:.2f} dB", flush=True)

    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(arguments.jobs) as pool:
        list(pool.map(run, cells))
    shown = [
        result
        for result in done
        if result["recording"] in arguments.recordings
        and result["fault"] in arguments.faults
        and result["steps"] == arguments.steps
    ]
    print(table(shown))


def right_poses(name: str, work: Path) -> Path:
    """The recording in the layout event_recording, simulated once."""
    from enerf_ns.bench.runner import made_whole
    from enerf_ns.bench.validation import CHOSEN_ON, ONLY_SCORED
    from enerf_ns.simulator.engine import simulate
    from enerf_ns.simulator.event_sensor import SensorSettings
    from enerf_ns.simulator.settings import SimulationSettings

    folder = work / name / "right"
    sequence = (CHOSEN_ON | ONLY_SCORED).get(name)
    if sequence is None:
        settings = SimulationSettings(name, layout="event_recording")
    else:
        settings = sequence.simulation_settings(work / name, layout="event_recording", sensor=SensorSettings())
    with made_whole(folder) as new:
        if new is not None:
            simulate(settings, new)
    return folder


def made_wrong(right: Path, folder: Path, fault: dict[str, Any], seed: int) -> None:
    """A folder whose events and frames are links to the right ones, and whose poses or calibration are wrong."""
    random = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    for file in right.iterdir():
        link = folder / file.name
        if file.name not in ("poses.txt", "recording.json") and not link.exists():
            link.symlink_to(file.resolve())
    rows = np.loadtxt(right / "poses.txt")
    thin = max(1, round(POSES_EVERY_NS / np.median(np.diff(rows[:, 0]))))
    rows = np.unique(np.concatenate([rows[::thin], rows[-1:]]), axis=0)
    times, positions, turns = rows[:, 0].astype(np.int64), rows[:, 1:4], Rotation.from_quat(rows[:, 4:])

    def direction() -> np.ndarray:
        vector = random.normal(size=3)
        return vector / np.linalg.norm(vector)

    def moved(shifts: np.ndarray, vectors: np.ndarray) -> None:
        nonlocal positions, turns
        positions = positions + turns.apply(1e-3 * shifts)
        turns = turns * Rotation.from_rotvec(np.radians(vectors))

    if "mount" in fault:
        millimetres, degrees = fault["mount"]
        moved(millimetres * direction(), degrees * direction())
    if "drift" in fault:
        knots = np.linspace(times[0], times[-1], DRIFT_KNOTS)
        values = CubicSpline(knots, random.normal(size=(DRIFT_KNOTS, 6)))(times)
        values -= values.mean(axis=0)
        parts = [values[:, :3], values[:, 3:]]
        moved(
            *(
                size * part / np.linalg.norm(part, axis=1).max()
                for size, part in zip(fault["drift"], parts, strict=True)
            )
        )
    if "noise" in fault:
        millimetres, degrees = fault["noise"]
        moved(millimetres * random.normal(size=positions.shape), degrees * random.normal(size=positions.shape))
    times = times + round(1e6 * fault.get("clock", 0.0))
    about = json.loads((right / "recording.json").read_text())
    for key in ("fx", "fy"):
        about["camera"][key] *= fault.get("focal", 1.0)
    (folder / "recording.json").write_text(json.dumps(about))
    lines = (
        f"{time} {' '.join(map(repr, [*position, *turn]))}"
        for time, position, turn in zip(times, positions.tolist(), turns.as_quat().tolist(), strict=True)
    )
    (folder / "poses.txt").write_text("\n".join(["# t_ns px py pz qx qy qz qw", *lines]) + "\n")


def trained(cell: dict[str, Any], work: Path) -> dict[str, Any]:
    """Scores of one training, and by how much its poses are off the right ones."""
    from contextlib import redirect_stdout

    from enerf_ns.dataparsers.formats.registry import read_recording
    from enerf_ns.evaluation.scores import mean_scores
    from enerf_ns.method.held_out_views import held_out_views
    from enerf_ns.method.origin import code_version
    from enerf_ns.method.runs import method_config, train

    name, seed = cell["recording"], cell["seed"]
    right = right_poses(name, work)
    folder = work / name / f"{cell['fault']}-{seed}"
    changes = {
        "machine.seed": seed,
        "max_num_iterations": cell["steps"],
        "evaluation_share": 0.0,
        **ROWS[cell["row"]],
    }
    if cell["row"] == "contrast":
        changes |= sharpest(folder)
    elif cell["row"] == "adam":
        refine_by_adam()
    config = method_config("enerf", folder, work / "runs", changes)
    config.timestamp = "-".join(str(value) for value in cell.values())
    shutil.rmtree(config.get_base_dir(), ignore_errors=True)  # of a training that was broken off
    with redirect_stdout(sys.stderr):
        run = train(config)
        views, _ = held_out_views(run.pipeline, evidence=False)
        scores, _ = mean_scores(views, False, "log-affine-set", ())
        events = run.pipeline.event_scores()
    manager = run.pipeline.datamanager
    true = read_recording(right).trajectory
    before, after = manager.recording.as_read or manager.recording, manager.recording
    given = read_recording(folder)
    return {
        **cell,
        "version": code_version(),
        **{key: float(scores[key]) for key in ("psnr", "ssim", "depth_rmse") if isinstance(scores.get(key), float)},
        "event_correlation": events["event_correlation"],
        "seconds": run.train_seconds,
        "corrected": run.pipeline.poses.corrected,
        "clock": manager.corrections.delay,
        "focal": after.camera.fx / before.camera.fx,
        "ate_before": errors(true, given.trajectory),
        "ate_after": errors(true, after.trajectory),
        **{
            key: reprojection_error(read_recording(right), one)
            for key, one in zip(REPROJECTION, (given, after), strict=True)
        },
    }


def sharpest(folder: Path) -> dict[str, Any]:
    """Clock and focal length with which events are sharpest, as flags."""
    from enerf_ns.dataparsers.formats.registry import read_recording
    from enerf_ns.dataparsers.inspection.agreement import clock_and_lens
    from enerf_ns.dataparsers.scene.depth_range import scene_depth_range

    recording = read_recording(folder)
    found = clock_and_lens(recording, float(np.sqrt(np.prod(scene_depth_range(recording)))))
    if found is None:
        return {}
    delay, scale = found
    return {
        "pipeline.poses.clock_ms": delay.value if delay.is_identifiable else 0.0,
        "pipeline.poses.focal_scale": scale.value if scale.is_identifiable else 1.0,
    }


def refine_by_adam() -> None:
    """Has the refiner go down the slope of the squared error of each look by Adam (Kingma and Ba, ICLR 2015)."""
    import torch

    from enerf_ns.method import pipeline as enerf_pipeline
    from enerf_ns.poses.refiner import PoseRefiner

    def solve(self: Any, step: int, may_begin: bool = True) -> bool:
        self.is_corrected[:] = True
        slope = self.right[: self.number].clone()
        first, second, count = self.__dict__.setdefault("moments", [0.0, 0.0, 0])
        first = ADAM_DECAYS[0] * first + (1.0 - ADAM_DECAYS[0]) * slope
        second = ADAM_DECAYS[1] * second + (1.0 - ADAM_DECAYS[1]) * slope**2
        count += 1
        self.__dict__["moments"] = [first, second, count]
        first, second = (
            moment / (1.0 - decay**count) for moment, decay in zip((first, second), ADAM_DECAYS, strict=True)
        )
        self.value += ADAM_RATE * first / (second.sqrt() + 1e-12)
        self.right.zero_()
        self.normal.zero_()
        return bool(torch.isfinite(self.value).all())

    PoseRefiner.solve = solve  # type: ignore
    enerf_pipeline.LOOKS_A_SOLUTION = 1


def errors(true: Any, other: Any) -> tuple[float, float]:
    """Root mean square errors of positions (mm), after the best rigid alignment, and of rotations (degrees), after the
    best constant one in the axes of the camera."""
    import torch

    first, last = max(true.start, other.start) + EDGE_NS, min(true.end, other.end) - EDGE_NS
    times = torch.from_numpy(np.linspace(first, last, 400).astype(np.int64))
    right, found = (one.poses(times).numpy() for one in (true, other))
    centred = [poses[:, :, 3] - poses[:, :, 3].mean(axis=0) for poses in (right, found)]
    turn = Rotation.align_vectors(centred[0], centred[1])[0]
    off = centred[0] - turn.apply(centred[1])
    turns = Rotation.from_matrix(right[:, :, :3].transpose(0, 2, 1) @ found[:, :, :3])
    left = (turns.mean().inv() * turns).as_rotvec()
    return 1e3 * float(np.sqrt((off**2).sum(axis=1).mean())), float(np.degrees(np.sqrt((left**2).sum(axis=1).mean())))


def reprojection_error(right: Any, other: Any) -> float:
    """Root mean square distance (pixels) of points of a scene from where they are seen, after triangulation.

    Points are placed in the depth range of the recording with the right poses, and seen along the path. Each is then
    triangulated with the poses, the clock and the lens of the other recording, as a direction and an inverse depth
    (Civera et al., "Inverse Depth Parametrization for Monocular SLAM", IEEE Transactions on Robotics 2008). What is
    left is the part of their errors that no scene explains.

    Args:
        right: Recording with a depth range and a pinhole camera.
        other: The same recording with other poses, or another camera of the same size.
    """
    import torch
    from scipy.ndimage import map_coordinates

    first = max(right.trajectory.start, other.trajectory.start) + EDGE_NS
    last = min(right.trajectory.end, other.trajectory.end) - EDGE_NS
    times = torch.from_numpy(np.linspace(first, last, TRACK_INSTANTS).astype(np.int64))
    true, found = (recording.trajectory.poses(times).numpy() for recording in (right, other))
    camera, (near, far) = right.camera, right.depth_range
    last_pixel = np.array([camera.width, camera.height]) - 1.0
    focal, middle = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    directions = other.camera.pixel_directions()
    rays = directions[..., :2] / directions[..., 2:]
    shares = product((0.1, 0.5, 0.9), repeat=2)
    squares: list[np.ndarray] = []
    for view, depth, share in product(TRACK_VIEWS, (near, np.sqrt(near * far), far), [*shares]):
        ray = np.array([*((share * last_pixel - middle) / focal), 1.0 / depth])
        seen = _seen_by(true, view, ray)
        pixels = seen[:, :2] / seen[:, 2:] * focal + middle
        is_seen = (seen[:, 2] > 0.0) & ((pixels >= 0.0) & (pixels <= last_pixel)).all(axis=1)
        if is_seen.sum() < FEWEST_INSTANTS:
            continue
        where = pixels[is_seen, ::-1].T
        wanted = np.stack([map_coordinates(rays[..., axis], where, order=1) for axis in (0, 1)], axis=1)
        squares.append((focal * _off_after_triangulation(found, view, ray, is_seen, wanted)) ** 2)
    return float(np.sqrt(np.concatenate(squares).sum(axis=1).mean()))


def _seen_by(poses: np.ndarray, view: int, ray: np.ndarray) -> np.ndarray:
    """Directions (poses, 3), of any length, in which cameras see the point on a ray of one view, given by x / z, y / z
    and 1 / z."""
    place = poses[view, :, :3] @ [*ray[:2], 1.0] + ray[2] * (poses[view, :, 3] - poses[:, :, 3])
    return np.einsum("nji,nj->ni", poses[:, :, :3], place)


def _off_after_triangulation(
    poses: np.ndarray, view: int, start: np.ndarray, is_seen: np.ndarray, wanted: np.ndarray
) -> np.ndarray:
    """Distances (instants, 2) in x / z and y / z of the point that fits best from where it is seen."""
    from scipy.optimize import least_squares

    def off(ray: np.ndarray) -> np.ndarray:
        seen = _seen_by(poses, view, ray)[is_seen]
        return (wanted - seen[:, :2] / seen[:, 2:]).ravel()

    return least_squares(off, start, method="lm", xtol=1e-12, ftol=1e-12).fun.reshape(-1, 2)


def chosen(results: list[dict[str, Any]], recording: str, fault: str, row: str, steps: int) -> list[dict[str, Any]]:
    """The trainings of one row, by seed."""
    wanted = recording, fault, row, steps
    found = [one for one in results if (one["recording"], one["fault"], one["row"], one["steps"]) == wanted]
    return sorted(found, key=lambda one: one["seed"])


def scores_by_fault(results: list[dict[str, Any]], recordings: list[str], faults: list[str], steps: int) -> str:
    """PSNR and correlation of each fault on each recording after as many steps, fixed and refined, as Markdown.

    A recording has no column of fixed poses, or of refined ones, where no training of them went on for as many steps.
    """

    def cell(recording: str, fault: str, row: str) -> str:
        runs = chosen(results, recording, fault, row, steps)
        psnr, correlation = ([one[key] for one in runs] for key in ("psnr", "event_correlation"))
        spread = f" ± {np.std(psnr, ddof=1):.2f}" if len(runs) > 1 else ""
        return f"{np.mean(psnr):.2f}{spread}, {np.mean(correlation):.2f}" if runs else "-"

    columns = [
        (name, [row for row in COMPARED if any(chosen(results, name, fault, row, steps) for fault in faults)])
        for name in recordings
    ]
    head = ["wrong", *(f"`{name}` {row}" if row == rows[0] else row for name, rows in columns for row in rows)]
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    for fault in faults:
        cells = [cell(name, fault, row) for name, rows in columns for row in rows]
        lines.append(f"| {' | '.join([fault, *cells])} |")
    return "\n".join(lines)


def found_by_fault(results: list[dict[str, Any]], recordings: list[str], faults: list[str], steps: int) -> str:
    """What refinement found of each fault on each recording, one value for each seed, as Markdown.

    Errors of trajectories are means over the seeds; in pixels, over those whose reprojection error was measured.
    """

    def values(runs: list[dict[str, Any]], key: str) -> list[Any]:
        return [one[key] for one in runs]

    def errors(runs: list[dict[str, Any]], key: str) -> str:
        positions, turns = np.mean(values(runs, key), axis=0)
        return f"{positions:.1f} mm and {turns:.2f}°"

    def cell(recording: str, fault: str) -> str:
        runs, wrong = chosen(results, recording, fault, "refined", steps), FAULTS[fault]
        if not runs:
            return "-"
        told = []
        if "clock" in wrong:
            told.append(f"clock {', '.join(f'{clock:.2f}' for clock in values(runs, 'clock'))} ms")
        if "focal" in wrong:
            told.append(f"focal length {', '.join(f'{focal:.3f}' for focal in values(runs, 'focal'))}")
        if "mount" in wrong:
            parts = ([part for part in PARTS_OF_MOUNT if part in found] for found in values(runs, "corrected"))
            told.append(", ".join(" and ".join(found) or "no part" for found in parts))
        if {"noise", "drift"} & set(wrong):
            told.append(f"{errors(runs, 'ate_before')} → {errors(runs, 'ate_after')}")
        before, after = ([one[key] for one in runs if key in one] for key in REPROJECTION)
        if before:
            told.append(f"{np.mean(before):.2f} → {np.mean(after):.2f} px")
        return "; ".join(told)

    lines = [f"| wrong | {' | '.join(f'`{name}`' for name in recordings)} |", f"|{' --- |' * (len(recordings) + 1)}"]
    lines += [f"| {' | '.join([fault, *(cell(name, fault) for name in recordings)])} |" for fault in faults]
    return "\n".join(lines)


def table(results: list[dict[str, Any]]) -> str:
    """Means over the seeds, a line for each recording and fault."""
    cells: dict[tuple[str, str], dict[str, list[dict[str, Any]]]] = defaultdict(lambda: defaultdict(list))
    for result in results:
        cells[result["recording"], result["fault"]][result["row"]].append(result)

    def mean(rows: list[dict[str, Any]], key: str, number: int | None = None) -> float:
        values = [row[key] if number is None else row[key][number] for row in rows if key in row]
        return float(np.mean(values)) if values else float("nan")

    others = [row for row in ROWS if row not in COMPARED and any(row in found for found in cells.values())]
    head = (
        "recording", "wrong", "seeds", "PSNR fixed", "refined", "right", "correlation fixed", "refined",
        "trajectory, mm", "refined", "degrees", "refined", "clock, ms", "focal length", "time refined / fixed",
        *(f"PSNR {row}" for row in others),
    )  # fmt: skip
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    for (recording, fault), rows in sorted(cells.items(), key=lambda cell: (cell[0][0], [*FAULTS].index(cell[0][1]))):
        fixed, refined = rows.get("fixed", []), rows.get("refined", [])
        right = cells.get((recording, "none"), {}).get("fixed", [])
        numbers = [
            recording,
            fault,
            str(max(len(fixed), len(refined))),
            *(f"{mean(some, 'psnr'):.2f}" for some in (fixed, refined, right)),
            *(f"{mean(some, 'event_correlation'):.3f}" for some in (fixed, refined)),
            f"{mean(refined, 'ate_before', 0):.2f}",
            f"{mean(refined, 'ate_after', 0):.2f}",
            f"{mean(refined, 'ate_before', 1):.3f}",
            f"{mean(refined, 'ate_after', 1):.3f}",
            ", ".join(f"{row['clock']:.2f}" for row in refined),
            ", ".join(f"{row['focal']:.4f}" for row in refined),
            f"{mean(refined, 'seconds') / mean(fixed, 'seconds'):.2f}",
            *(f"{mean(rows.get(row, []), 'psnr'):.2f}" for row in others),
        ]
        lines.append(f"| {' | '.join(numbers)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
