"""Commands that are killed at random moments, or whose disk is full, in processes of their own; checks what they leave.

A program of its own, with one thread, since its processes are forked: each would take seconds to start otherwise. Says,
as JSON, how often each command was broken off in each way.
"""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from nerfstudio.scripts.train import main as ns_train
from PIL import Image
from small_runs import set_up, small_config
from test_interruption import same

from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index import index_cache
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.evaluation.history import read_history
from enerf_ns.method.checkpoints import newest_checkpoint, read_config
from enerf_ns.method.trainer import EnerfTrainer
from enerf_ns.report import film
from enerf_ns.scripts import cli

STEPS = 24

SAVES = 40

LONGEST = 120.0
"""Seconds after which a process is said to hang."""

SHARES = (0.0, 0.1, 0.5, 0.95)
"""Of the room that a command needs, those that a full disk leaves it."""


class Job:
    """Something that writes, and what must be true wherever it was broken off.

    Args:
        recording: That is read.
        folder: What is written goes into a folder in it, which is new.
    """

    reports_failure = True
    """Whether it ends with an error where it cannot write, and not with a line that says so."""

    def __init__(self, recording: Path, folder: Path):
        self.recording, self.reference, self.output = recording, folder / "whole" / self.name, folder / self.name

    @property
    def name(self) -> str:
        return type(self).__name__.lower()

    def prepare(self) -> None:
        """What comes before the first process, in the process that these are forked from."""

    def run(self, output: Path) -> None:
        """Writes; in a process of its own."""
        raise NotImplementedError

    def check(self, output: Path, done: bool) -> None:
        """Raises an AssertionError where something is half written or lost.

        Args:
            output: What `run` was given.
            done: Whether it came to its end.
        """
        raise NotImplementedError

    def begin_anew(self, done: bool) -> None:
        """Makes the place free for another start, where that needs be."""
        shutil.rmtree(self.output, ignore_errors=True)


def command(*arguments: object) -> None:
    """An `enerf` command."""
    sys.argv = ["enerf", *map(str, arguments)]
    cli.entrypoint()


class Index(Job):
    """A recording is sorted, and the index stored."""

    reports_failure = False

    def prepare(self) -> None:
        index_cache.CACHED_FROM = 10**9  # so that it is not stored
        self.fresh = index_events(read_recording(self.recording))
        index_cache.CACHED_FROM = 1

    def run(self, output: Path) -> None:
        os.environ["ENERF_CACHE"] = str(output)
        index_events.cache_clear()
        for note in index_events(read_recording(self.recording)).notes:
            print(note)

    def check(self, output: Path, done: bool) -> None:
        self.run(output)
        stored = index_events(read_recording(self.recording))
        for column in ("times", "positives", "offsets"):
            assert (getattr(stored, column) == getattr(self.fresh, column)).all(), column

    def begin_anew(self, done: bool) -> None:
        for entry in self.output.glob("[!.]*"):
            shutil.rmtree(entry)


class Train(Job):
    """`ns-train`, which goes on where it was broken off."""

    def run(self, output: Path) -> None:
        run = output / "recording/enerf/run"
        config = small_config(self.recording, output)
        if (run / "config.yml").exists():
            config.load_config = run / "config.yml"
        config.max_num_iterations, config.steps_per_save = STEPS, 2
        save, log = EnerfTrainer.save_checkpoint, output.with_suffix(".log")

        def noted(trainer: Any, step: int) -> None:
            save(trainer, step)
            if not trainer._unsaved:
                with suppress(OSError), log.open("a") as file:
                    file.write(f"{step}\n")

        EnerfTrainer.save_checkpoint = noted
        ns_train(config)

    def check(self, output: Path, done: bool) -> None:
        run, log = output / "recording/enerf/run", output.with_suffix(".log")
        if (run / "config.yml").exists():
            assert getattr(read_config(run / "config.yml"), "max_num_iterations") == STEPS  # noqa: B009
            json.loads((run / "choices.json").read_text())
        if (run / "dataparser_transforms.json").exists():
            json.loads((run / "dataparser_transforms.json").read_text())
        if (run / "history.jsonl").exists():
            assert len(read_history(run)) >= (run / "history.jsonl").read_bytes().count(b"\n"), (
                "all that is whole is read"
            )
        path = newest_checkpoint(run / "nerfstudio_models")
        last = int(log.read_text().split()[-1]) if log.exists() else -1
        if path is None:
            assert last == -1
            return
        assert path.name == max(os.listdir(path.parent)), "the newest is whole"
        assert int(path.stem[5:]) >= last, "nothing is lost"
        if done:
            assert int(path.stem[5:]) == STEPS - 1
            found, straight = (torch.load(file) for file in (path, self._last(self.reference)))
            assert all(state.pop("error_against_time")["seconds"] > 0 for state in (found, straight))
            same(found, straight)

    def begin_anew(self, done: bool) -> None:
        if done:
            super().begin_anew(done)
            self.output.with_suffix(".log").unlink(missing_ok=True)

    def _last(self, output: Path) -> Path:
        return output / f"recording/enerf/run/nerfstudio_models/step-{STEPS - 1:09d}.ckpt"


class Checkpoint(Job):
    """The moments in which a checkpoint is stored, one after the other."""

    reports_failure = False

    def prepare(self) -> None:
        self.trainer = set_up(small_config(self.recording, self.reference.with_name("trainer")))
        self.trainer.train_iteration(0)
        self.weights = self.trainer.pipeline.state_dict()

    def run(self, output: Path) -> None:
        self.trainer.checkpoint_dir = output / "nerfstudio_models"
        output.mkdir(parents=True, exist_ok=True)
        for step in range(SAVES):
            self.trainer.save_checkpoint(step)
            if not self.trainer._unsaved:
                os.pwrite(self.last, step.to_bytes(4, "little"), 0)

    def check(self, output: Path, done: bool) -> None:
        path = newest_checkpoint(output / "nerfstudio_models")
        saved = os.pread(self.last, 4, 0)
        assert (path is not None) or not saved
        if path is not None:
            assert path.name == max(os.listdir(path.parent)), "the newest is whole"
            assert int(path.stem[5:]) >= int.from_bytes(saved, "little"), "nothing is lost"
            same(dict(torch.load(path)["pipeline"]), dict(self.weights))

    def begin_anew(self, done: bool) -> None:
        shutil.rmtree(self.output / "nerfstudio_models", ignore_errors=True)
        os.ftruncate(self.last, 0)

    last = os.memfd_create("last")
    """The last step that was stored, as a process that was killed knew it."""


class Report(Job):
    def prepare(self) -> None:
        self.trained = self.reference.with_name("train")
        film.VIDEO_SIDE, film.MOVING_FRAMES = 48, 8  # which would take most of the time

    def run(self, output: Path) -> None:
        command("report", self.trained, "--output-dir", output)

    def check(self, output: Path, done: bool) -> None:
        files = {str(file.relative_to(output)) for file in output.rglob("[!.]*") if file.is_file()}
        whole = {str(file.relative_to(self.reference)) for file in self.reference.rglob("*") if file.is_file()}
        assert files == whole if done else files <= whole
        for name in files:
            file, suffix = output / name, Path(name).suffix
            if suffix == ".json":
                json.loads(file.read_text())
            elif suffix == ".html":
                assert file.read_text().rstrip().endswith("</html>")
            elif suffix in (".png", ".webp"):
                with Image.open(file) as picture, Image.open(self.reference / name) as reference:
                    assert getattr(picture, "n_frames", 1) == getattr(reference, "n_frames", 1)
                    picture.seek(getattr(picture, "n_frames", 1) - 1)
                    picture.load()
            elif suffix == ".mp4":
                assert frames_of(file) == frames_of(self.reference / name)
            else:
                assert file.read_text().count("\n") == (self.reference / name).read_text().count("\n")

    def begin_anew(self, done: bool) -> None:
        if done:
            super().begin_anew(done)


class Convert(Job):
    def run(self, output: Path) -> None:
        command("convert", self.recording, "--output-dir", output)

    def check(self, output: Path, done: bool) -> None:
        assert output.exists() or not done
        if output.exists():
            assert contents(output) == contents(self.reference)


class Simulate(Job):
    """What was simulated before a kill can be read, or nothing can."""

    def run(self, output: Path) -> None:
        size = ("--width", 24, "--height", 16, "--duration", 0.03, "--exposure-ms", 1, "--num-frames", 11)
        command("simulate", "shapes", *size, "--preview", "--output-dir", output)

    def check(self, output: Path, done: bool) -> None:
        files, whole = contents(output), contents(self.reference)
        assert files.keys() <= whole.keys()
        summary = json.loads(files.get("simulation.json", b"{}"))
        assert done == summary.get("finished", False) or files == whole
        for name, content in files.items():
            if Path(name).suffix in (".png", ".mp4") or name.startswith("depth"):
                assert content == whole[name] or (name == "preview.mp4" and frames_of(output / name)), name
            elif name == "poses_bounds.npy":  # with the range of depth as it is known by then
                assert np.load(output / name).shape == np.load(self.reference / name).shape
            elif not name.startswith("events") and name != "simulation.json":
                assert whole[name].startswith(content), name
        if done:
            assert files == whole
        elif output.exists():
            with suppress(RecordingError):
                found, all_of_it = (joined_events(folder) for folder in (output, self.reference))
                assert (found == all_of_it[: len(found)]).all()


def joined_events(folder: Path) -> np.ndarray:
    stream = read_recording(folder).stream_events()
    return np.concatenate([np.zeros((0, 4)), *(np.stack([part.x, part.y, part.t, part.p], 1) for part in stream)])


def contents(folder: Path) -> dict[str, bytes]:
    """All files of a folder but partials, which nobody reads."""
    found = folder.rglob("*")
    return {
        str(file.relative_to(folder)): file.read_bytes() for file in found if file.is_file() and file.name[0] != "."
    }


def frames_of(video: Path) -> int:
    """Number of frames that can be decoded."""
    decoder, number = cv2.VideoCapture(str(video)), 0
    while decoder.read()[0]:
        number += 1
    return number


JOBS = (Index, Train, Checkpoint, Report, Convert, Simulate)


def child(job: Callable[[], None], limit: float | None = None) -> tuple[int, str, float]:
    """Exit code, output and seconds of a process that does a job, and is killed after a time.

    Raises:
        AssertionError: It hangs, or ends with a traceback.
    """
    start, printed, (reader, output) = time.monotonic(), b"", os.pipe()
    os.set_blocking(reader, False)
    number = os.fork()
    if not number:
        code = 1
        try:
            os.dup2(output, 1)
            os.dup2(output, 2)
            signal.signal(signal.SIGINT, signal.default_int_handler)
            job()
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
            if isinstance(end.code, str):
                print(end.code, file=sys.stderr)
        except BaseException:
            traceback.print_exc()
        finally:
            with suppress(Exception):
                sys.stdout.flush()
            os._exit(code)
    os.close(output)
    done = 0
    while not done:
        if time.monotonic() - start > (LONGEST if limit is None else limit):
            os.kill(number, signal.SIGKILL)
        done, status = os.waitpid(number, os.WNOHANG)
        with suppress(BlockingIOError):
            while part := os.read(reader, 65536):
                printed += part
        time.sleep(0.001)
    os.close(reader)
    code, text = os.waitstatus_to_exitcode(status), printed.decode(errors="replace")
    assert "Traceback" not in text, text
    assert limit is not None or code != -signal.SIGKILL, f"hangs: {text}"
    return code, text, time.monotonic() - start


def leftovers(folder: Path) -> list[Path]:
    return [path for path in (*folder.parent.glob(".*"), *folder.rglob(".*"))]


def killed(job: Job, kills: int, draw: random.Random) -> int:
    """Kills a job so many times at moments spread over all of its run time, and then lets it come to its end.

    Raises:
        AssertionError: A start after a kill failed, or something was half written, lost or left.
    """
    number, seconds, is_new = 0, LONGEST, True
    while True:
        limit = draw.uniform(0.0, seconds) if seconds < LONGEST and number < kills else None
        code, printed, took = child(lambda: job.run(job.output), limit)
        done = code == 0
        assert code in (0, -signal.SIGKILL), f"after {number} kills {job.name} ended with {code}: {printed}"
        job.check(job.output, done)
        if done:
            assert not leftovers(job.output), "what was left is gone at the next start"
            seconds = min(seconds, took) if is_new else seconds  # a machine that does other things, too, is slower
        if done and number >= kills:
            return number
        number, is_new = number + (not done), done
        job.begin_anew(done)


def full(job: Job, disk: Callable[[Job, float], Any]) -> int:
    """Runs a job on a disk that has not enough room; how often that made it fail.

    Raises:
        AssertionError: It did not end as it should, or something was half written, lost or left.
    """
    failed = 0
    for share in SHARES:
        with disk(job, share) as within:
            code, printed, _ = child(within)
            sentences = [line for line in printed.splitlines() if line.startswith("enerf: ")]
            assert (code, len(sentences)) in ((0, 0), (1, 1)), f"{job.name} with {share} of its room: {code}, {printed}"
            told = sentences or ([printed] if "could not be stored" in printed else [])
            failed += bool(told)
            assert code or not job.reports_failure or not told
            assert not leftovers(job.output), f"{job.name} with {share} of its room left {leftovers(job.output)}"
            job.check(job.output, not told)
        job.begin_anew(True)
    return failed


@contextmanager
def small_files(job: Job, share: float) -> Iterator[Callable[[], None]]:
    """A job whose files cannot become larger than a share of the largest that it writes, as where a disk is full."""
    largest = max(file.stat().st_size for file in job.reference.rglob("*") if file.is_file())

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(share * largest), resource.RLIM_INFINITY))
        job.run(job.output)

    yield limited


@contextmanager
def small_disk(job: Job, share: float) -> Iterator[Callable[[], None]]:
    """A job that writes to a disk of its own, with room for a share of what it writes."""
    needed = sum(file.stat().st_size for file in job.reference.rglob("*") if file.is_file())
    disk, before = job.output.with_name("disk"), job.output
    disk.mkdir(exist_ok=True)
    room = 4096 * (3 + int(share * needed / 4096))  # some for folders
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={room}", "tmpfs", disk], check=True)
    job.output = disk / job.name
    try:
        yield lambda: job.run(job.output)
    finally:
        job.output = before
        subprocess.run(["umount", "--lazy", disk], check=True)


def broken_off(job: Job, ways: list[str], kills: int) -> list[int]:
    """How often a job was broken off in each way; runs it once before, so that what is imported and compiled is there
    already in the processes that are forked."""
    job.prepare()
    if isinstance(job, Train | Checkpoint):  # whose gradients start threads, which no fork has
        assert child(lambda: job.run(job.reference))[0] == 0
    else:
        job.run(job.reference)
    numbers = []
    for way in ways:
        job.begin_anew(True)
        if way == "kill":
            numbers.append(killed(job, kills, random.Random(0)))
        else:
            numbers.append(full(job, small_files if way == "small-files" else small_disk))
    return numbers


def main(recording: Path, folder: Path, kills: int, ways: list[str]) -> None:
    numbers: dict[str, dict[str, int]] = {way: {} for way in ways}
    for kind in JOBS:
        job, (reader, number) = kind(recording, folder), os.pipe()
        process = os.fork()
        if not process:
            code = 1
            try:
                os.write(number, json.dumps(broken_off(job, ways, kills)).encode())
                code = 0
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(code)
        assert os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == 0, job.name
        for way, found in zip(ways, json.loads(os.read(reader, 100)), strict=True):
            numbers[way][job.name] = found
    print(json.dumps(numbers))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), sys.argv[4:])
