"""Trains, indexes and scores a recording in processes that are killed at random moments; checks what they left.

A program of its own, with one thread, since its processes are forked: each would take seconds to start otherwise.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import yaml
from small_runs import set_up, small_config

from enerf_ns.checkpoints import newest_checkpoint
from enerf_ns.dataparsers import index_cache
from enerf_ns.dataparsers.indexing import index_events
from enerf_ns.enerf_config import enerf  # noqa: F401 - so that it is loaded before the fork
from enerf_ns.evaluation import runs
from enerf_ns.report.writing import write_report

STEPS = 30


def main(recording: Path, folder: Path, kills: int) -> None:
    """Kills until there were so many, then lets the run end.

    Raises:
        AssertionError: Something of what a killed process left could not be read, or was lost.
    """
    index_cache.CACHED_FROM = 1  # so that there is something to store
    draw = random.Random(0)
    run = folder / "recording/enerf/run"
    log = folder / "log"  # steps whose checkpoints are stored
    longest = {"train": 6.0, "index": 1.0, "report": 4.0}
    killed = dict.fromkeys(longest, 0)
    while sum(killed.values()) < kills or not finished(run):
        if sum(killed.values()) < kills and finished(run) and (run / "scores.json").exists():
            shutil.rmtree(run)
            log.unlink()
        jobs: dict[str, Callable[[], None]] = {"train": lambda: train(recording, folder, log)}
        if sum(killed.values()) < kills:
            jobs["index"] = lambda: index(recording)
            if checkpoints(run):
                jobs["report"] = lambda: score(run)
        name = draw.choice(["train", *jobs])
        limit = draw.uniform(0.0, longest[name]) if sum(killed.values()) < kills else None
        code, seconds = child(jobs[name], limit)
        assert code in (0, -signal.SIGKILL), f"{name} ended with {code} after {sum(killed.values())} kills"
        if code == 0 and name != "train":
            longest[name] = seconds
        killed[name] += code != 0
        assert child(lambda: check(recording, run, log), None)[0] == 0, f"after {name} was killed"
    print(json.dumps(killed))


def child(job: Callable[[], None], limit: float | None) -> tuple[int, float]:
    """Exit code and seconds of a process that does a job, and is killed after a time."""
    start = time.monotonic()
    number = os.fork()
    if not number:
        try:
            job()
            code = 0
        except BaseException as error:
            print(repr(error), file=sys.stderr, flush=True)
            code = 1
        os._exit(code)
    done = 0
    while not done:
        if limit is not None and time.monotonic() - start > limit:
            os.kill(number, signal.SIGKILL)
            limit = None
        done, status = os.waitpid(number, os.WNOHANG)
        time.sleep(0.002)
    return os.waitstatus_to_exitcode(status), time.monotonic() - start


def train(recording: Path, folder: Path, log: Path) -> None:
    """The next start: of config.yml where there is one, else of the flags."""
    stored = folder / "recording/enerf/run/config.yml"
    if stored.exists():
        config = yaml.load(stored.read_text(), Loader=yaml.Loader)
    else:
        config = small_config(recording, folder)
        config.max_num_iterations, config.steps_per_save = STEPS, 2
    trainer = set_up(config)
    save = trainer.save_checkpoint

    def noted(step: int) -> None:
        save(step)
        with open(log, "a") as file:
            file.write(f"{step}\n")

    trainer.save_checkpoint = noted
    trainer.train()


def index(recording: Path) -> None:
    """Sorted anew and stored."""
    for entry in index_cache.cache_folder().glob("[!.]*"):
        if draw_index.random() < 0.5:
            for file in entry.iterdir():
                file.unlink()
            entry.rmdir()
    index_events(small_config(recording, recording).resolved().recording())


draw_index = random.Random(1)


def score(run: Path) -> None:
    """Without the video, whose tool writes it."""
    write_report([run], run, video=False)


def check(recording: Path, run: Path, log: Path) -> None:
    """All that is there is whole; the newest checkpoint is no older than the last that was stored."""
    if (run / "config.yml").exists():
        config = yaml.load((run / "config.yml").read_text(), Loader=yaml.Loader)
        assert config.max_num_iterations == STEPS
    for name in ("choices.json", "scores.json", "camera_path.json"):
        if (run / name).exists():
            json.loads((run / name).read_text())
    last = int(log.read_text().split()[-1]) if log.exists() else None
    assert (last is None) or checkpoints(run)
    if checkpoints(run):
        path = newest_checkpoint(run / "nerfstudio_models")
        assert path is not None and path.name == checkpoints(run)[-1], "the newest is whole"
        assert last is None or int(path.stem[5:]) >= last, "nothing is lost"
        config, pipeline = runs.load_any_method(run / "config.yml", "test")
        assert config.load_step == int(path.stem[5:])
        assert all(parameter.isfinite().all() for parameter in pipeline.parameters())
    stored = index_events(small_config(recording, recording).resolved().recording())
    index_cache.CACHED_FROM = 10**9
    os.environ["ENERF_CACHE"] = os.devnull
    index_events.cache_clear()
    fresh = index_events(small_config(recording, recording).resolved().recording())
    for column in ("times", "positives", "offsets"):
        assert (getattr(stored, column) == getattr(fresh, column)).all(), column


def checkpoints(run: Path) -> list[str]:
    return sorted(file.name for file in run.glob("nerfstudio_models/*"))


def finished(run: Path) -> bool:
    return checkpoints(run) == [f"step-{STEPS - 1:09d}.ckpt"]


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))
