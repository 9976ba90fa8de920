"""Wrong inputs and wrong flags, each given to the real command: refused with one sentence that names the file or the
flag, and nothing is changed or left.

What is wrong within the files of a layout is in the tables of the layout's own tests; here, all of it is put into whole
recordings, with whatever else may become of a file, and the command is run in a process of its own.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import test_bad_input
import test_dsec
import test_eds
import test_esim_npz
import test_event_files
import test_event_recording
import test_eventnerf
import test_evimo2
import test_files
import test_fuzz
import test_llff_events
import test_m3ed
import test_mvsec
import test_tum_vie
import test_vector
from recordings import write_davis, write_esim
from test_bad_input import is_one_sentence
from warm_commands import WarmCommands

from enerf_ns.dataparsers.recording.errors import printable

Fault = Callable[[Path], object]


def write_small_npz(folder: Path) -> None:
    test_esim_npz.write_views(test_esim_npz.write_npz(folder) / "views")


HAS_AEDAT = find_spec("aedat") is not None
"""Whether the optional extra is there that reads the recordings of E2NeRF."""


def write_e2nerf(folder: Path) -> None:
    import test_e2nerf  # here, since it skips where aedat is not installed

    test_e2nerf.write_scene(folder)


WHOLE: dict[str, Callable[[Path], object]] = {
    **{name: layout.write for name, layout in test_fuzz.LAYOUTS.items()},
    "small davis": write_davis,
    "small esim": lambda folder: write_esim(folder, ("images", "images_corrupted"), depth=True),
    "small own": lambda folder: test_event_recording.write_recording(folder, ("frames",), depth=True),
    "small npz": write_small_npz,
    "e2nerf": write_e2nerf,
    "m3ed": test_m3ed.write_m3ed,
    "file": lambda folder: (folder.mkdir(), write_event_file(folder / "recording.raw")),
}
"""How to write each recording that a fault is put into."""


def write_event_file(path: Path) -> None:
    path.write_bytes(test_event_files.header("2.0") + test_event_files.evt2(test_event_files.ROWS))


@dataclass(frozen=True)
class Wrong:
    """A fault to put into a whole recording, and what its sentence must say."""

    whole: str
    fault: Fault
    said: tuple[str, ...]
    command: str = "inspect"


# --------------------------------------------------------------------------------------- what may become of any file


def becomes(content: bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(content)


def replaced(make: Callable[[Path], object]) -> Callable[[Path], object]:
    return lambda path: (path.unlink(), make(path))


ANYTHING: dict[str, Callable[[Path], object]] = {
    "is missing": Path.unlink,
    "is a link to itself": replaced(lambda path: path.symlink_to(path.name)),
    "is empty": becomes(b""),
    "is cut off": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3]),
    "is binary": becomes(bytes(range(256)) * 8),
    "is the page of an error": becomes(b"<!DOCTYPE html>\n<html><body>404 Not Found</body></html>\n"),
    "is a pointer of Git LFS": becomes(b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 123456\n"),
    "is UTF-16": lambda path: path.write_bytes(path.read_text(errors="replace").encode("utf-16")),
    "is a folder": replaced(Path.mkdir),
}

FILES: dict[str, tuple[str, ...]] = {
    "eds_raw": ("events.h5", "stamped_groundtruth.txt", "images_timestamps.txt", "images/frame_0000000001.png"),
    "eds_prepared": ("calib_undist_calib0.json", "stamped_groundtruth_us.txt"),
    "tum_vie_raw": (
        "camera-calibrationA.json",
        "mocap-desk2-events_left.h5",
        "mocap-desk2-vi_gt_data/left_images/image_timestamps_left.txt",
        "mocap-imu-calibrationA.json",
    ),
    "tum_vie_prepared": ("calib_undist.json", "mocap-imu-calib.json"),
    "esim": ("poses_bounds.npy", "images/image_stamps_ns.txt", "images/00001.png", "depth/00001.npy"),
    "davis": ("events.txt", "groundtruth.txt", "calib.txt", "images/frame_00000001.png"),
    "esim_npz": ("camera_calibration.npz", "camera_poses.npz", "raw_events.npz"),
    "esim_bag": ("esim.bag",),
    "eventnerf": (
        "train/events/test.npz",
        "train/pose/r_00000.txt",
        "train/intrinsics/r_00003.txt",
        "train/rgb/r_00002.png",
    ),
    "llff_events": (
        "events.h5",
        "poses_bounds.npy",
        "all_poses_bounds.npy",
        "all_timestamps.npy",
        "images_1/timestamps.npz",
        "images_1/01.png",
    ),
    "mvsec": ("indoor_flying1_data.hdf5", "indoor_flying1_gt.hdf5"),
    "evimo2_left_camera": ("dataset_events_t.npy", "dataset_events_xy.npy", "dataset_info.npz"),
    "vector": ("desk_normal1.synced.gt.txt", "desk_normal1.synced.left_camera/timestamp.txt", test_vector.BODY),
    "ros_bag_2": ("bag.db3",),
    "dsec": (
        "events/left/events.h5",
        "calibration/cam_to_cam.yaml",
        "poses.txt",
    ),
    "m3ed": ("seq_data.h5", "seq_pose_gt.h5"),
    **({"e2nerf": ("poses_bounds.npy", "images/005.jpg")} if HAS_AEDAT else {}),
    "event_recording": ("events/t.npy", "events/x.npy", "poses.txt", "recording.json", "frames/stamps_ns.txt"),
    "file": ("recording.raw",),
}
"""Files without which a recording is not whole."""

OPTIONAL: dict[str, tuple[str, ...]] = {
    "eds_raw": ("camchain.yaml",),
    "eds_prepared": ("rectify_map_calib0.h5",),
    "tum_vie_prepared": ("calibration.json", "rectify_map_left.h5"),
    "esim": ("simulation.json", "0_poses_all.txt"),
    "ros_bag_1": ("recording.bag",),  # without which nothing is in the folder
    "dsec": ("events/left/rectify_map.h5", "images/left/exposure_timestamps.txt"),
    "esim_npz": ("views/transforms_test.json",),
    **({"e2nerf": ("lego.aedat4",)} if HAS_AEDAT else {}),
}
"""Files that may be missing, or whose lack a table of the layout has, but that must be sound where they are there."""


FOUND_BY_THEIR_END = ("mvsec", "m3ed")
"""Layouts whose files begin with the name of the sequence, which a missing one does not tell."""


def cases_of_files() -> dict[str, Wrong]:
    cases = {}
    for files, kinds in ((FILES, list(ANYTHING)), (OPTIONAL, list(ANYTHING)[2:])):
        for whole, names in files.items():
            for name in map(Path, names):
                said = name.parent.name or name.name.rpartition("_" if whole in FOUND_BY_THEIR_END else "-")[2]
                for kind in kinds:
                    cases[f"{whole}: {name} {kind}"] = Wrong(whole, _at(name, ANYTHING[kind]), (said,), "convert")
    return cases


def _at(name: Path, change: Callable[[Path], object]) -> Fault:
    return lambda folder: change(folder / name)


# ------------------------------------------------------------------------------- what the tables of the layouts hold

SEEN_WHEN_COPIED = ("frame no image", "frame empty", "frame truncated", "blurred frame truncated", "depth truncated")
"""Faults of pictures, all of which `convert` looks at, and `inspect` at some."""


def cases_of_tables() -> dict[str, Wrong]:
    cases = {}
    for whole, faults in {"small davis": test_bad_input.DAVIS, "small esim": test_bad_input.ESIM}.items():
        for bad in faults:
            command = "convert" if bad.name in SEEN_WHEN_COPIED else "inspect"
            cases[f"{whole}: {bad.name}"] = Wrong(whole, bad.break_it, bad.message, command)
    for name, (whole, fault, said) in test_fuzz.FOUND.items():
        cases[f"{whole}: {name}"] = Wrong(whole, fault, (said,), "convert" if name.startswith("PNG") else "inspect")
    tables: dict[str, dict] = {
        "eds_raw": test_eds.RAW_FAULTS,
        "eds_prepared": test_eds.PREPARED_FAULTS,
        "tum_vie_raw": test_tum_vie.BAD_RAW,
        "tum_vie_prepared": test_tum_vie.BAD_PREPARED,
        "small own": test_event_recording.BAD_FILES,
        "small npz": test_esim_npz.BAD_INPUT,
        "eventnerf": test_eventnerf.BAD_INPUT,
        "llff_events": test_llff_events.BAD_INPUT,
        "mvsec": test_mvsec.BAD,
        "vector": test_vector.BAD,
        "evimo2_left_camera": test_evimo2.BAD,
        "dsec": test_dsec.BAD,
        "m3ed": test_m3ed.BAD,
    }
    if HAS_AEDAT:
        import test_e2nerf

        written_so, of_no_format = (name for name, (options, *_) in test_e2nerf.BAD.items() if options), "poses alone"
        kept = test_e2nerf.BAD.keys() - {*written_so, of_no_format}
        tables["e2nerf"] = {name: test_e2nerf.BAD[name][1:] for name in sorted(kept)}
    for whole, table in tables.items():
        for name, (fault, *said) in table.items():
            cases[f"{whole}: table: {name}"] = Wrong(whole, fault, tuple(said))
    for name, (about, message) in test_event_recording.BAD_ABOUT.items():
        cases[f"small own: {name}"] = Wrong("small own", _stating(about), (message,))
    for name, (content, message) in test_event_files.BAD.items():
        fault = _at(Path("recording.raw"), becomes(content))
        cases[f"file: {name}"] = Wrong("file", fault, (message,), "convert")
    return cases


def _stating(about: dict) -> Fault:
    content = json.dumps({"camera": test_event_recording.CAMERA, **about})
    return lambda folder: (folder / "recording.json").write_text(content)


def cases_of_what_is_stated() -> dict[str, Wrong]:
    """Pictures whose stored pixels are not what a viewer shows, depth that is none, and cameras that none is."""
    frames = {
        "small own": "frames/1.png",
        "small esim": "images/00001.png",
        "small davis": "images/frame_00000001.png",
    }
    cases = {}
    for whole, place in frames.items():
        for name, (file, write, _) in test_files.NOT_PLAIN.items():
            if whole == "small own" or file.endswith(".png"):
                path = Path(place).with_suffix(Path(file).suffix)
                cases[f"{whole}: {name}"] = Wrong(whole, _instead_of(Path(place), path, write), (path.name, "expected"))
    for whole, depth in {"small own": Path("depth/1.npy"), "small esim": Path("depth/00001.npy")}.items():
        for value in (-1.0, np.nan, np.inf):
            fault = _at(depth, lambda path, value=value: np.save(path, np.load(path) * value))
            cases[f"{whole}: depth times {value}"] = Wrong(whole, fault, (depth.name, "holds a depth of"), "convert")
    for white in (1, 65535):
        stated = _stating({"white_level": white})
        cases[f"small own: white {white}"] = Wrong("small own", stated, (f"white_level = {white}", "has 8 bits"))
    for factor in (0.01, 100):
        camera = test_event_recording.CAMERA | {"fx": factor * test_event_recording.CAMERA["fy"]}
        stretched = _stating({"camera": camera})
        cases[f"small own: fx {factor} fy"] = Wrong("small own", stretched, ("recording.json", "fits no lens"))
    return cases


def _instead_of(old: Path, new: Path, write: Callable[[Path], object]) -> Fault:
    return lambda folder: ((folder / old).unlink(), write(folder / new))


CASES = {**cases_of_files(), **cases_of_tables(), **cases_of_what_is_stated()}


def tree(folder: Path) -> dict[str, object]:
    """What lies in a folder: hash or target, and time of change, of everything."""
    found: dict[str, object] = {}
    for path in sorted(folder.rglob("*")):
        state = path.lstat()
        content = os.readlink(path) if path.is_symlink() else state.st_mode
        if path.is_file():
            content = hashlib.sha256(path.read_bytes()).hexdigest()
        found[str(path.relative_to(folder))] = (content, state.st_mtime_ns)
    return found


def check_sentence(told: str) -> str:
    """One sentence of this package on one line, and no traceback; the sentence."""
    assert "Traceback" not in told, told
    (line,) = [line for line in told.splitlines() if line.startswith("enerf: ")]
    assert line.isprintable() and is_one_sentence(line), line
    return line


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    @cache
    def write(name: str) -> Path:
        folder = tmp_path_factory.mktemp("whole") / "recording"
        WHOLE[name](folder)
        return folder

    return write


@pytest.fixture
def refused(warm_commands: WarmCommands) -> Callable[..., str]:
    """Calls a command in a process of its own, in the folder of the test; the sentence that it ends with."""

    def call(*arguments: object) -> str:
        code, output = warm_commands.run(*arguments)
        assert code == 1, output
        return check_sentence(output)

    return call


def output_of(command: str) -> tuple[str, str]:
    return ("--output", "page.html") if command == "inspect" else ("--output-dir", "new")


@pytest.mark.sweep(100)
@pytest.mark.parametrize("name", CASES)
def test_a_wrong_input_is_refused_in_one_sentence(name, whole, refused, tmp_path, monkeypatch):
    wrong = CASES[name]
    recording = shutil.copytree(whole(wrong.whole), tmp_path / wrong.whole.replace(" ", "-") / "recording")
    wrong.fault(recording)
    monkeypatch.chdir(tmp_path)
    before = tree(tmp_path)
    source = recording / "recording.raw" if wrong.whole == "file" else recording
    sentence = refused("enerf", wrong.command, source, *output_of(wrong.command))
    for part in wrong.said:
        assert part in sentence
    assert str(recording) in sentence
    assert tree(tmp_path) == before


# ---------------------------------------------------------------------------------------------------- flags and places

PLACES = ("~nosuchuser/place", "loop", "loop/place", "x" * 300, "file/place", "not-utf8-\udcff")
"""Paths at which nothing can be, in a folder with a link to itself and a file."""

SMALL = ("--width", "16", "--height", "12", "--duration", "0.02")

CONVERT_POSES = ("convert", "recording", "--output-dir", "new", "--poses", "recording/groundtruth.txt")

PATH_FLAGS: dict[str, tuple[str, ...]] = {
    "inspect": ("inspect", "PLACE"),
    "inspect --output": ("inspect", "recording", "--output", "PLACE"),
    "convert": ("convert", "PLACE", "--output-dir", "new"),
    "convert --output-dir": ("convert", "recording", "--output-dir", "PLACE"),
    "convert --poses": ("convert", "recording.raw", "--output-dir", "new", "--poses", "PLACE"),
    "convert --camera": ("convert", "recording.raw", "--output-dir", "new", "--camera", "PLACE"),
    "convert --hand-eye": (*CONVERT_POSES, "--hand-eye", "PLACE"),
    "reconstruct": ("reconstruct", "PLACE", "--output-dir", "new"),
    "reconstruct --output-dir": ("reconstruct", "recording", "--output-dir", "PLACE"),
    "reconstruct --weights": ("reconstruct", "recording", "--output-dir", "new", "--weights", "PLACE"),
    "simulate": ("simulate", "PLACE", "--output-dir", "new"),
    "simulate --output-dir": ("simulate", "shapes", "--output-dir", "PLACE", *SMALL),
    "simulate --trajectory": ("simulate", "shapes", "--output-dir", "new", "--trajectory", "PLACE", *SMALL),
    "simulate --key-frames": ("simulate", "shapes", "--output-dir", "new", "--key-frames", "PLACE", *SMALL),
    "simulate --cameras": ("simulate", "shapes", "--output-dir", "new", "--cameras", "PLACE"),
    "simulate --from-run": ("simulate", "--output-dir", "new", "--from-run", "PLACE"),
    "simulate --stamps": ("simulate", "recording/images", "--output-dir", "new", "--stamps", "PLACE"),
    "report": ("report", "PLACE"),
    "score": ("score", "PLACE", "--recording", "recording"),
    "score --recording": ("score", "recording", "--recording", "PLACE"),
    "score --views": ("score", "--recording", "recording", "--views", "PLACE"),
    "score --output": ("score", "recording/images", "--recording", "recording", "--output", "PLACE"),
    "export": ("export", "mesh", "PLACE"),
    "demo --output-dir": ("demo", "--output-dir", "PLACE"),
    "bench --output-dir": ("bench", "parts", "--budget", "1", "--output-dir", "PLACE"),
    "ns-train --data": ("enerf", "--data", "PLACE", "--output-dir", "new"),
    "ns-train --output-dir": ("enerf", "--data", "recording", "--output-dir", "PLACE"),
    "ns-train --load-dir": ("enerf", "--data", "recording", "--output-dir", "new", "--load-dir", "PLACE"),
    "ns-train --load-checkpoint": ("enerf", "--data", "recording", "--output-dir", "new", "--load-checkpoint", "PLACE"),
}
"""Every flag that takes a path."""


def place_cases() -> list[tuple[str, str]]:
    return [(flag, place) for flag in PATH_FLAGS for place in PLACES]


@pytest.fixture
def home(whole: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory: a recording, an event file, a file and a link to itself."""
    shutil.copytree(whole("small davis"), tmp_path / "recording")
    write_event_file(tmp_path / "recording.raw")
    (tmp_path / "file").touch()
    (tmp_path / "loop").symlink_to("loop")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def program_of(arguments: tuple[str, ...]) -> str:
    return "ns-train" if arguments[0] == "enerf" else "enerf"


@pytest.mark.sweep(36)
@pytest.mark.parametrize(("flag", "place"), place_cases())
def test_a_place_where_nothing_can_be_is_refused(flag: str, place: str, home: Path, refused):
    before = tree(home)
    arguments = tuple(place if argument == "PLACE" else argument for argument in PATH_FLAGS[flag])
    sentence = refused(program_of(arguments), *arguments)
    assert printable(place.split("/")[0]) in sentence
    assert tree(home) == before


FLAGS: dict[str, tuple[tuple[str, ...], str]] = {
    name: (arguments, name.split(" = ")[0].split(" ")[1])
    for name, arguments in {
        **{
            f"simulate {flag} = {value}": ("simulate", "shapes", "--output-dir", "new", flag, *value.split())
            for flag, values in {
                "--duration": ("0", "-1", "nan", "inf", "1e9"),
                "--num-frames": ("0", "-3", "10000000000"),
                "--exposure-ms": ("-1", "nan", "1e9"),
                "--width": ("0", "-5", "100000"),
                "--height": ("0", "-5", "100000"),
                "--field-of-view": ("0", "180", "-10", "nan"),
                "--max-displacement": ("0", "-1", "nan", "inf"),
                "--max-change": ("0", "-1", "nan", "inf"),
                "--bayer-pattern": ("RGB", "RGGX", "rggb"),
                "--contrast-thresholds": ("0 0.2", "0.2 -0.2", "nan 0.2", "1e6 0.2", "inf inf"),
                "--threshold-spread": ("-1", "nan"),
                "--refractory-period": ("-1",),
                "--leak-rate": ("-1", "nan", "inf"),
                "--shot-noise-rate": ("-1", "nan"),
                "--hot-pixels": ("-0.1", "1.5", "nan"),
                "--hot-pixel-rate": ("-1", "nan"),
                "--cutoff-frequency": ("-1", "nan"),
                "--timestamp-jitter": ("-1", "nan"),
                "--readout-rate": ("-1", "nan"),
                "--response": ("linear", "logarithm:0", "logarithm:nan", "logarithm:"),
                "--seed": ("-1",),
                "--stamps": ("recording/images.txt",),
                "--frames-per-second": ("10",),
                "--trajectory-unit": ("us",),
            }.items()
            for value in values
        },
        **{
            f"reconstruct {flag} = {value}": ("reconstruct", "recording", "--output-dir", "new", flag, value)
            for flag, values in {
                "--cutoff-frequency": ("-1", "nan", "1e30"),
                "--frames-per-second": ("30", "nan"),
            }.items()
            for value in values
        },
        **{
            f"ns-train {flag} = {value}": ("enerf", "--data", "recording", "--output-dir", "new", flag, value)
            for flag, values in {
                "--max-num-iterations": ("0", "-1", "100000000000"),
                "--evaluation-share": ("-0.1", "1.1", "nan"),
                "--steps-per-save": ("0", "-1"),
                "--machine.seed": ("-1", "4294967296"),
                "--pipeline.datamanager.event-pairs": ("0", "-1", "100000000"),
                "--pipeline.model.log2-table-size": ("0", "99"),
                "--optimizers.fields.optimizer.lr": ("0", "-1", "nan"),
                "--preset": ("spiral9",),
            }.items()
            for value in values
        },
        "convert --poses-scale = 2": ("convert", "recording", "--output-dir", "new", "--poses-scale", "2"),
        "convert --poses-topic = /pose": (*CONVERT_POSES, "--poses-topic", "/pose"),
        "convert --poses-scale = nan": (*CONVERT_POSES, "--poses-scale", "nan"),
        "convert --poses-delay-ms = inf": (*CONVERT_POSES, "--poses-delay-ms", "inf"),
        "convert --camera = camera": ("convert", "recording", "--output-dir", "new", "--camera", "file"),
        "inspect --event-camera = left": ("inspect", "recording", "--event-camera", "left"),
        "inspect --output = a folder": ("inspect", "recording", "--output", "."),
        "export --voxel = 0": ("export", "mesh", "recording", "--voxel", "0"),
        "export --voxel = nan": ("export", "mesh", "recording", "--voxel", "nan"),
        "bench --budget = 2m": ("bench", "parts", "--budget", "2m", "--output-dir", "new"),
        "bench --budget = 0s": ("bench", "parts", "--budget", "0s", "--output-dir", "new"),
        "bench --scale = 0": ("bench", "parts", "--scale", "0", "--output-dir", "new"),
        "bench --scale = nan": ("bench", "parts", "--scale", "nan", "--output-dir", "new"),
        "bench --seeds = 0": ("bench", "parts", "--seeds", "0", "--output-dir", "new"),
        "bench --threads = 0": ("bench", "parts", "--threads", "0", "--output-dir", "new"),
        "demo --max-num-iterations = 0": ("demo", "--max-num-iterations", "0", "--output-dir", "new"),
    }.items()
}
"""Values out of the range of a flag, or of no use there, and the flag."""


@pytest.mark.sweep(36)
@pytest.mark.parametrize("name", FLAGS)
def test_a_wrong_flag_is_refused_in_one_sentence(name: str, home: Path, refused):
    arguments, flag = FLAGS[name]
    before = tree(home)
    sentence = refused(program_of(arguments), *arguments)
    assert flag.split(".")[-1].removeprefix("--") in sentence
    assert tree(home) == before


INTO: dict[str, tuple[str, ...]] = {
    "inspect": ("inspect", "recording", "--output", "PLACE/page.html"),
    "convert": ("convert", "recording", "--output-dir", "PLACE"),
    "reconstruct": ("reconstruct", "recording", "--output-dir", "PLACE"),
    "simulate along it": ("simulate", "shapes", "--trajectory", "recording", "--output-dir", "PLACE", *SMALL),
    "simulate along its poses": (
        *("simulate", "shapes", "--trajectory", "recording/groundtruth.txt", "--trajectory-unit", "s"),
        *("--output-dir", "PLACE", *SMALL),
    ),
    "simulate its pictures": ("simulate", "recording/images", "--frames-per-second", "9", "--output-dir", "PLACE"),
    "simulate": ("simulate", "shapes", "--output-dir", "PLACE", *SMALL),
    "demo": ("demo", "--output-dir", "PLACE"),
    "bench": ("bench", "parts", "--budget", "1", "--output-dir", "PLACE"),
    "check-numerics": ("check-numerics", "--output-dir", "PLACE"),
    "ns-train": ("enerf", "--data", "recording", "--output-dir", "PLACE"),
    "ns-train by name": ("enerf", "--data", "recording", "--output-dir", ".", "--experiment-name", "PLACE"),
}
"""Every command that writes."""


@pytest.mark.sweep(12)
@pytest.mark.parametrize("place", ["recording/new", "recording/images", "link/images/deep/new"])
@pytest.mark.parametrize("command", INTO)
def test_nothing_is_written_into_a_recording(command: str, place: str, home: Path, refused):
    (home / "link").symlink_to("recording")
    before = tree(home)
    arguments = tuple(argument.replace("PLACE", place) for argument in INTO[command])
    sentence = refused(program_of(arguments), *arguments)
    assert f"lies within the recording {home / 'recording'}" in sentence
    assert tree(home) == before


# ------------------------------------------------------------------------------------------------ in child processes

CHILDREN = [
    *(("enerf", name) for name in list(CASES)[:: len(CASES) // 16]),
    *(("ns-train", name) for name in list(CASES)[5 :: len(CASES) // 7] if CASES[name].command == "inspect"),
]


def child(*command: str, **options: Any) -> subprocess.CompletedProcess[str]:
    program = Path(sys.executable).with_name(command[0])
    return subprocess.run([program, *command[1:]], capture_output=True, text=True, timeout=200, **options)


@pytest.mark.sweep(2)
@pytest.mark.slow
@pytest.mark.parametrize(("program", "name"), CHILDREN)
def test_a_wrong_input_is_refused_by_the_command_itself(program, name, whole, tmp_path):
    wrong = CASES[name]
    recording = shutil.copytree(whole(wrong.whole), tmp_path / wrong.whole.replace(" ", "-") / "recording")
    wrong.fault(recording)
    source = recording / "recording.raw" if wrong.whole == "file" else recording
    before = tree(tmp_path)
    arguments = ("enerf", "--data", str(source))
    if program == "enerf":
        arguments = (wrong.command, str(source), *output_of(wrong.command))
    ended = child(program, *arguments, cwd=tmp_path)
    assert ended.returncode == 1
    sentence = check_sentence(ended.stderr)
    assert all(part in sentence for part in wrong.said)
    assert tree(tmp_path) == before


ROOT_OVERRIDES = hasattr(os, "geteuid") and os.geteuid() == 0
"""Whether permissions do not bind the process of these tests."""


FORBIDDEN: dict[str, tuple[tuple[str, ...], str]] = {
    "folder": (("enerf", "inspect", "closed"), "closed"),
    "folder of ns-train": (("ns-train", "enerf", "--data", "closed"), "closed"),
    "file": (("enerf", "convert", "secret", "--output-dir", "new"), "secret/groundtruth.txt"),
    "output": (("enerf", "convert", "recording", "--output-dir", "closed/new"), "closed"),
    "output of ns-train": (("ns-train", "enerf", "--data", "recording", "--output-dir", "closed/new"), "closed"),
}


@pytest.mark.skipif(ROOT_OVERRIDES and sys.platform != "linux", reason="permissions do not bind root")
@pytest.mark.parametrize("name", FORBIDDEN)
def test_what_the_user_may_not_touch_is_told_in_one_sentence(name: str, home: Path, warm_commands: WarmCommands):
    command, said = FORBIDDEN[name]
    shutil.copytree("recording", "secret")
    Path("secret/groundtruth.txt").chmod(0)
    Path("closed").mkdir(mode=0)
    try:
        code, printed = warm_commands.run(*command, bound=ROOT_OVERRIDES)
    finally:
        Path("closed").chmod(0o700)
    assert code == 1
    assert said in check_sentence(printed) and "Permission denied" in printed
    assert not (home / "new").exists()


INDEX_IN_THE_CACHE = """
import pwd
pwd.getpwuid = lambda number: {}[number]  # a user whom the system has no entry of
from enerf_ns.dataparsers.index import index_cache
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.indexing import index_events
index_cache.CACHED_FROM = 1
print(*index_events(read_recording("recording")).notes)
"""


@pytest.mark.skipif(ROOT_OVERRIDES and sys.platform != "linux", reason="permissions do not bind root")
@pytest.mark.parametrize("where", [None, "closed", "closed/none"])
def test_without_a_home_folder_the_cache_is_done_without(where: str | None, home: Path, warm_commands: WarmCommands):
    environment = {name: value for name, value in os.environ.items() if name not in ("ENERF_CACHE", "XDG_CACHE_HOME")}
    environment.pop("HOME", None)
    environment |= {"HOME": str(home / where)} if where else {}
    Path("closed").mkdir(mode=0)
    code, printed = warm_commands.run("python", "-c", INDEX_IN_THE_CACHE, environment=environment, bound=ROOT_OVERRIDES)
    Path("closed").chmod(0o700)
    assert code == 0, printed
    assert "could not be stored in the cache" in printed and printed.count("\n") == 1
    assert {path.name for path in home.rglob("*")}.isdisjoint({"~", "indices", ".cache"})


def test_nor_is_the_cache(home: Path, refused, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ENERF_CACHE", "recording/cache")
    before = tree(home)
    assert "ENERF_CACHE" in refused("enerf", "inspect", "recording")
    assert tree(home) == before


def test_the_corpus_is_large():
    assert len(CASES) + len(place_cases()) + len(FLAGS) + 3 * len(INTO) >= 300
    assert {wrong.whole for wrong in CASES.values()} == set(WHOLE) - (set() if HAS_AEDAT else {"e2nerf"})
