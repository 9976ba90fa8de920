"""The presets against the table of the published configs, closed forms, and counts by hand."""

from __future__ import annotations

import copy
import re
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from recordings import HEIGHT, WIDTH, write_esim

from enerf_ns.choices.presets import PRESETS, Preset, event_time_range, preset_named
from enerf_ns.choices.resolver import resolve
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.recording import Events, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.method.config import enerf, enerf_paper
from enerf_ns.supervision.losses import no_event_loss, squared_event_loss

PAPER: Any = enerf_paper.config
TUNED: Any = enerf.config
PUBLISHED = {
    "mocap-1d-trans": "mocap1dtrans",
    "mocap-desk2": "mocapDesk2",
    "mocap-desk2-6views": "mocapDesk2_6Views",
    "shake-carpet1": "shakeCarpet1",
    "shake-moon1": "shakeMoon1",
    "shake-moon2": "shakeMoon2",
    "spiral1-sparse": "spiral1_sparse",
    "spiral1-more-sparse": "spiral1_more_sparse",
}
"""Names of the reference's configs, where they are spelt otherwise."""
PUBLISHED |= {name: name for name in PRESETS if name not in PUBLISHED}
CONFIGS = {name: f"{PUBLISHED[name]}/{PUBLISHED[name]}_enerf" for name in PRESETS}
CONFIGS["mocap-1d-trans"] = "mocap1dtrans/mocap1dtrans_noEv10"
FOLDERS = {"eds00": "00_peanuts_dark", "eds11": "11_all_characters", "shake-carpet1": "ShakeCarpet1"}
OVERLAP = {"mocap-1d-trans": 36, "mocap-desk2-6views": 3, "spiral1-more-sparse": 4}
"""Train frames among the held-out ones of the table."""


@pytest.fixture(scope="module")
def reference(shared_data: Path) -> str:
    """Notes on the published code and its configs."""
    file = shared_data.parent / "reference" / "enerf-reference.md"
    if not file.is_file():
        pytest.skip(f"no notes on the published configs at {file}")
    return file.read_text()


@pytest.fixture(scope="module")
def table(reference: str) -> dict[str, dict[str, str]]:
    """Rows of the table of configs by name, each a dictionary of its columns."""
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in reference.splitlines() if line[:1] == "|"]
    header = next(row for row in rows if row[0] == "config")
    return {row[0]: dict(zip(header, row, strict=True)) for row in rows if "/" in row[0] and len(row) == len(header)}


def numbers(cell: str) -> list[int]:
    """The frames that a cell such as `0..4/2,8,9 (5) overlap 2` of the table stands for."""
    ranges, count = re.fullmatch(r"(\S+) \((\d+)\)(?: overlap \d+)?", cell).groups()  # type: ignore[union-attr]
    frames = []
    for part in ranges.split(","):
        first, last, step = re.fullmatch(r"(\d+)(?:\.\.(\d+)/(\d+))?", part).groups()  # type: ignore[union-attr]
        frames += range(int(first), int(last or first) + 1, int(step or 1))
    assert len(frames) == int(count)
    return frames


@pytest.mark.parametrize("name", PRESETS)
def test_frames_are_those_of_the_published_config_but_for_what_is_mended(name: str, table: dict):
    row, preset = table[CONFIGS[name]], PRESETS[name]
    train, held_out = numbers(row["train_idxs"]), numbers(row["val_idxs"])
    overlap = set(train) & set(held_out)
    assert len(overlap) == OVERLAP.get(name, 0) if name != "shake-moon2" else train == [0, 2, 4]
    if name == "shake-moon2":
        train = numbers(table["shakeMoon2/shakeMoon2_enerfBoth"]["train_idxs"])
    mended = {62, 65} if name == "spiral1-sparse" else overlap
    assert list(preset.train_frames) == train
    assert list(preset.held_out_frames) == [frame for frame in held_out if frame not in mended]
    if mended or name == "shake-moon2":
        assert preset.mended


@pytest.mark.parametrize("name", PRESETS)
def test_batch_threshold_and_no_event_loss_are_those_of_the_published_config(name: str, table: dict):
    row, preset = table[CONFIGS[name]], PRESETS[name]
    assert preset.event_pairs == int(row["batch_evs"])
    assert preset.frame_rays == int(row["num_rays"])
    threshold = float(row["C_thres"])
    assert preset.contrast_thresholds == (None if threshold == -1 else (threshold, threshold))
    assert preset.silent_pairs == (int(row["batch_evs"]) // 2 if row["neg.ev"] == "1" else 0)
    assert preset.no_event_weight == float(row["w_no_ev"].replace("–", "1"))
    assert preset.silence_ms == 20.0
    if row["events"] == "0":
        assert any("no events" in sentence for sentence in preset.mended)


@pytest.mark.parametrize("name", PRESETS)
def test_box_and_window_are_those_of_the_published_code(name: str, table: dict, reference: str):
    row, preset = table[CONFIGS[name]], PRESETS[name]
    assert (preset.bound, preset.scale) == tuple(map(float, row["bound/scale"].split("/")))
    stated = re.findall(
        r"`(\w+)` \(([^)]*)\)", next(line for line in reference.splitlines() if "Offsets after" in line)
    )
    offsets = {folder: tuple(map(float, cell.replace("−", "-").split(","))) for folder, cell in stated}
    assert len(offsets) == len(FOLDERS)
    assert preset.offset == offsets.get(FOLDERS.get(name, ""), (0.0, 0.0, 0.0))
    assert preset.event_window == {"esim": "following"}.get(row["mode"], "around")
    if name in FOLDERS and FOLDERS[name] not in row["datadir"]:
        assert any("offset" in sentence for sentence in preset.mended)


def test_where_the_published_configs_of_a_sequence_differ_the_preset_says_so(table: dict):
    """All other configs of the sequence, those on reconstructed frames apart, and all columns that select."""
    columns = ["bound/scale", "C_thres", "num_rays", "batch_evs", "train_idxs", "val_idxs"]
    for name, preset in PRESETS.items():
        for kind in ("_enerfBoth", "_nerf"):
            row, other = table[CONFIGS[name]], table.get(f"{PUBLISHED[name]}/{PUBLISHED[name]}{kind}")
            unused = {"C_thres", "batch_evs"} if kind == "_nerf" else set()
            if other and any(row[column] != other[column] for column in columns if column not in unused):
                assert preset.mended or preset.notes, (name, kind)


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_a_held_out_frame_is_no_train_frame_and_both_are_in_order(preset: Preset):
    assert not set(preset.train_frames) & set(preset.held_out_frames)
    for frames in (preset.train_frames, preset.held_out_frames):
        assert list(frames) == sorted(set(frames))
        assert frames[0] >= 0


@pytest.mark.parametrize(
    ("name", "train", "held_out"),  # the counts of the paper where it agrees with its configs
    [("spiral1", 30, 32), ("spiral1-sparse", 17, 32), ("spiral1-more-sparse", 9, 32 - 4), ("spiral2", 20, 24)],
)
def test_as_many_frames_as_the_paper_counts(name: str, train: int, held_out: int):
    assert len(PRESETS[name].train_frames) == train
    assert len(PRESETS[name].held_out_frames) == held_out


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_the_corners_of_the_box_are_those_of_the_network_s_cube(preset: Preset):
    *centre, half = preset.box
    for sign in (-1.0, 1.0):
        corner = preset.scale * (np.array(centre) + sign * half) + np.array(preset.offset)
        np.testing.assert_allclose(corner, sign * preset.bound, rtol=1e-14)
    near, far = preset.depth_range
    assert preset.scale * near == pytest.approx(0.2, rel=1e-14)
    assert far == pytest.approx(np.linalg.norm([2.0 * half] * 3), rel=1e-14)


@pytest.mark.parametrize(
    ("name", "box", "near"),
    [
        ("eds00", (2.0, 1.0, 2.0, 4.0), 0.4),
        ("eds11", (3.0, 1.0, 1.5, 4.0), 0.4),
        ("mocap-desk2", (0.0, 0.0, 0.0, 4.0), 0.4),
        ("shake-carpet1", (0.0, 0.0, -1.0, 10.0), 2.0 / 3.0),
        ("spiral2", (0.0, 0.0, 0.0, 20.0), 1.0),
    ],
)
def test_boxes_in_metres(name: str, box: tuple[float, ...], near: float):
    assert PRESETS[name].box == pytest.approx(box)
    assert PRESETS[name].depth_range[0] == pytest.approx(near)
    assert "-0.0" not in repr(PRESETS[name].box)


def frames(times_ms: list[int], first_number: int = 0) -> Frames:
    """Frames at the given times, as they are left after the first `first_number` were dropped."""
    times = np.array(times_ms, np.int64) * 1_000_000
    still = Trajectory(np.array([0, 10**12]), np.zeros((2, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)))
    return Frames(
        filenames=tuple(Path(f"{i}.png") for i in range(len(times))),
        times=times,
        camera=Camera(4, 3, 2.0, 2.0, 1.5, 1.0),
        trajectory=still,
        numbers=first_number + np.arange(len(times)),
    )


@pytest.mark.parametrize(
    ("first_number", "selected", "window", "expected"),
    [
        # seven frames at 100, 150, 190, 250, 300, 370, 400 ms: a mean period of 50 ms
        (0, (1, 3, 5), "around", (0.100, 0.420)),
        (0, (0, 6), "around", (0.050, 0.450)),
        (0, (1, 3, 5), "following", (0.150, 0.400)),
        (0, (2, 4), "following", (0.190, 0.370)),
        (0, (0, 6), "following", (0.100, 0.450)),
        (0, (3,), "around", (0.200, 0.300)),
        (40, (41, 45), "around", (0.100, 0.420)),
        (40, (40, 44), "following", (0.100, 0.370)),
    ],
)
def test_time_range_of_a_selection(first_number: int, selected: tuple, window: Any, expected: tuple[float, float]):
    seven = frames([100, 150, 190, 250, 300, 370, 400], first_number)
    assert event_time_range(seven, selected, window) == pytest.approx(expected, abs=1e-12)


def test_time_range_of_windows_around_frames_is_that_of_the_windows_one_by_one():
    """As the published code builds them: borders half way between the stamps, two more stamps beyond either end."""
    stamps = np.cumsum(np.random.default_rng(0).integers(30, 70, 500)).tolist()
    every = frames(stamps)
    for name in ("mocap-desk2", "mocap-desk2-6views", "mocap-1d-trans"):
        selected = PRESETS[name].train_frames
        chosen = np.array(stamps)[list(selected)] * 1e-3
        period = np.diff(stamps).mean() * 1e-3
        padded = np.array([chosen[0] - 2 * period, *chosen, chosen[-1] + 2 * period])
        borders = (padded[1:] + padded[:-1]) / 2
        expected = borders[0], borders[-1]
        assert event_time_range(every, selected, "around") == pytest.approx(expected, abs=1e-9)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A recording with 2000 frames, one every 10 ms from 1 s on, and thresholds that no preset states."""
    recording = read_recording(write_esim(tmp_path_factory.mktemp("recording") / "esim"))
    every = frames(list(range(1000, 21000, 10)))
    return replace_frames(replace(recording, contrast_thresholds=(0.7, 0.9)), every)


def replace_frames(recording: Any, frames: Frames | None) -> Any:
    """The recording with other frames, and four events a millisecond of their path, at one pixel after another."""
    trajectory = frames.trajectory if frames else recording.trajectory
    times = np.arange(trajectory.start, trajectory.end, 250_000)
    x, y = np.divmod(np.arange(len(times)) % (WIDTH * HEIGHT), HEIGHT)
    events = Events(x, y, times, np.ones(len(times), np.int8))
    return replace(
        recording, frames=frames, blurred_frames=None, trajectory=trajectory, stream_events=lambda: iter([events])
    )


def pipeline_config(method: Any = PAPER, **changes: Any) -> Any:
    """A method's config of the pipeline, with changes such as `datamanager__event_pairs=64`."""
    config = copy.deepcopy(method.pipeline)
    for name, value in changes.items():
        section, _, attribute = name.rpartition("__")
        setattr(attrgetter(section.replace("__", "."))(config), attribute, value)
    return config


def used(config: Any, recording: Any, preset: str | None) -> tuple[dict[str, Any], tuple[str, ...]]:
    """All that a preset may fill in as it is used, and what is said of it."""
    resolution = resolve(config, recording, preset)
    filled = resolution.applied_to(config)
    manager, model = filled.datamanager, filled.model
    settings = {**vars(manager.dataparser), **vars(manager), **vars(model), **vars(model.sensor)}
    return {
        name: value for name, value in settings.items() if name not in ("dataparser", "sensor")
    }, resolution.selection


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_fills_in_what_is_left_open(name: str, recording: Any):
    preset = PRESETS[name]
    filled, lines = used(pipeline_config(), recording, name)
    assert filled["train_frame_indices"] == preset.train_frames
    assert filled["held_out_frame_indices"] == preset.held_out_frames
    assert filled["box"] == preset.box
    assert filled["depth_range"] == preset.depth_range
    assert filled["event_pairs"] == preset.event_pairs
    assert filled["silent_pairs"] == preset.silent_pairs
    assert filled["train_num_rays_per_batch"] == preset.frame_rays
    assert filled["silence_ms"] == 20.0
    assert filled["contrast_thresholds"] == (preset.contrast_thresholds or (0.7, 0.9))
    assert filled["event_loss"] == ("squared" if preset.contrast_thresholds else "normalised")
    first, last = preset.train_frames[0], preset.train_frames[-1]
    start, end = (first - 1, last + 1) if preset.event_window == "around" else (first, last + 1)
    assert filled["time_range"] == pytest.approx((1.0 + 0.01 * start, 1.0 + 0.01 * end), abs=1e-9)
    assert set(preset.mended) | set(preset.notes) <= set(lines)
    untouched = {"pair_mode", "supervision", "num_samples", "frame_loss_weight", "held_out_every", "train_frames"}
    defaults, _ = used(pipeline_config(), recording, None)
    assert {key: filled[key] for key in untouched} == {key: defaults[key] for key in untouched}


@pytest.mark.parametrize(("name", "paper_weight"), [("eds11", 1.0), ("mocap-1d-trans", 10.0)])
def test_the_two_event_losses_stand_to_each_other_as_in_the_paper(name: str, paper_weight: float, recording: Any):
    """Paper: mean (dL - p C)^2 + weight * mean relu(|dL| - C), here up to one common factor."""
    model, _ = used(pipeline_config(), recording, name)
    thresholds = model["contrast_thresholds"]
    predicted, measured, silent = torch.randn(3, 1000, generator=torch.Generator().manual_seed(0)).double()
    of_events = squared_event_loss(predicted, measured, thresholds[0])
    of_silence = model["no_event_loss_weight"] * no_event_loss(silent, thresholds, model["no_event_margin"])
    paper = paper_weight * torch.relu(silent.abs() - thresholds[0]).mean() / ((predicted - measured) ** 2).mean()
    torch.testing.assert_close(of_silence / of_events, paper)


def test_the_batch_and_the_box_of_the_paper_are_left_to_its_own_method(recording: Any):
    default, _ = used(pipeline_config(TUNED), recording, None)
    filled, lines = used(pipeline_config(TUNED), recording, "eds11")
    for name in ("event_pairs", "silent_pairs", "train_num_rays_per_batch", "box", "depth_range"):
        assert filled[name] == default[name] != used(pipeline_config(), recording, "eds11")[0][name]
    assert filled["train_frame_indices"] == PRESETS["eds11"].train_frames
    assert filled["contrast_thresholds"] == (0.2, 0.2)
    assert any("30096" in line for line in lines)


def test_where_a_preset_has_no_loss_on_silent_pixels_the_method_keeps_its_own(recording: Any):
    default, _ = used(pipeline_config(TUNED), recording, None)
    filled, _ = used(pipeline_config(TUNED), recording, "eds00")
    for name in ("silent_pairs", "no_event_loss_weight", "no_event_margin"):
        assert filled[name] == default[name]


PARSER = "datamanager__dataparser__"


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        (f"{PARSER}train_frame_indices", (1506, 1530)),
        (f"{PARSER}held_out_frame_indices", (1501, 1503)),
        (f"{PARSER}box", (0.0, 1.0, 2.0, 3.0)),
        (f"{PARSER}depth_range", (1.0, 3.0)),
        (f"{PARSER}time_range", (17.0, 18.0)),
        (f"{PARSER}held_out_every", 7),
        ("datamanager__event_pairs", 64),
        ("datamanager__silent_pairs", 32),
        ("datamanager__silence_ms", 30.0),
        ("datamanager__train_num_rays_per_batch", 16),
        ("model__sensor__contrast_thresholds", (0.3, 0.4)),
        ("model__event_loss", "huber"),
        ("model__no_event_loss_weight", 0.5),
        ("model__no_event_margin", 0.5),
    ],
)
def test_what_the_user_set_stands_and_is_named(setting: str, value: Any, recording: Any):
    name = setting.rpartition("__")[2]
    preset = "eds00" if name == "event_loss" else "eds11"
    plain, _ = used(pipeline_config(), recording, preset)
    assert plain[name] != value
    filled, lines = used(pipeline_config(**{setting: value}), recording, preset)
    assert filled[name] == value
    assert [line for line in lines if line.startswith("Set by flag")] == [
        f"Set by flag, not by the preset: --{name.replace('_', '-')}."
    ]
    depends = {
        "train_frame_indices": {"time_range"},
        "held_out_frame_indices": {"train_frame_indices"},
        "held_out_every": {"train_frame_indices", "held_out_frame_indices"},
        "box": {"near_plane", "max_res"},
        "depth_range": {"near_plane", "max_res"},
    }
    others = {key: item for key, item in plain.items() if key not in {name, *depends.get(name, ())}}
    assert {key: filled[key] for key in others} == others


@pytest.mark.parametrize(
    ("setting", "default"),
    [
        ("datamanager__silent_pairs", 0),
        ("datamanager__event_pairs", 30096),
        ("model__event_loss", "squared"),
        ("model__no_event_margin", 1.0),
        ("model__no_event_loss_weight", 5.0),
    ],
)
def test_what_the_user_set_stands_although_it_is_the_default_of_the_method(setting, default, recording: Any):
    """As the note of mocap-1d-trans advises with --silent-pairs 0, which is what enerf-paper has anyway."""
    name = setting.rpartition("__")[2]
    assert used(pipeline_config(), recording, None)[0][name] == default
    assert used(pipeline_config(**{setting: default}), recording, "mocap-1d-trans")[0][name] == default
    preset_has = used(pipeline_config(), recording, "mocap-1d-trans")[0][name]
    assert preset_has != default or name in ("event_loss", "no_event_margin")


def test_frames_of_the_user_and_of_the_preset_do_not_overlap(recording: Any):
    config = pipeline_config(**{f"{PARSER}train_frame_indices": (1500, 1503, 1509, 1600)})
    parser, _ = used(config, recording, "eds11")
    assert parser["held_out_frame_indices"] == tuple(range(1515, 1852, 6))
    assert parser["time_range"] == pytest.approx((1.0 + 14.99, 1.0 + 16.01))

    config = pipeline_config(**{f"{PARSER}held_out_frame_indices": (1500, 1854)})
    parser, _ = used(config, recording, "eds11")
    assert parser["train_frame_indices"] == tuple(range(1506, 1849, 6))
    assert parser["time_range"] == pytest.approx((1.0 + 15.05, 1.0 + 18.49))


def test_with_frames_held_out_by_their_period_the_preset_selects_no_frames(recording: Any):
    parser, _ = used(pipeline_config(**{f"{PARSER}held_out_every": 3}), recording, "eds11")
    assert parser["train_frame_indices"] is None
    assert parser["held_out_frame_indices"] is None
    assert parser["time_range"] == pytest.approx((1.0 + 14.99, 1.0 + 18.55))


@pytest.mark.parametrize("method", [TUNED, PAPER], ids=["enerf", "enerf-paper"])
@pytest.mark.parametrize("name", PRESETS)
def test_asked_again_it_answers_the_same_and_changes_no_config(name: str, method: Any, recording: Any):
    config = pipeline_config(method)
    before = copy.deepcopy(config)
    once = resolve(config, recording, name)
    start, end = (round(1e9 * time) for time in once.values["datamanager.dataparser.time_range"])
    inside = np.flatnonzero((recording.frames.times >= start) & (recording.frames.times <= end))
    part = replace(recording, frames=recording.frames.subset(inside))
    config.datamanager.dataparser.time_range = once.values["datamanager.dataparser.time_range"]
    again = resolve(config, part, name)
    config.datamanager.dataparser.time_range = None
    assert config == before
    assert resolve(config, recording, name) == once
    del once.values["datamanager.dataparser.time_range"]
    assert again.values == once.values


def test_first_frames_without_a_pose_are_passed_over(recording: Any):
    parser, _ = used(pipeline_config(), replace_frames(recording, frames(list(range(500, 5000, 50)), 1)), "spiral1")
    assert parser["time_range"] == pytest.approx((0.55, 3.7))


@pytest.mark.parametrize("left", [None, frames([10]), frames([10, 20, 30]), frames(list(range(10, 9700, 10)))])
def test_a_recording_with_too_few_frames_is_refused(left: Frames | None, recording: Any):
    with pytest.raises(RecordingError, match=r"--preset eds00 selects from the frames 425 to 970, but the recording"):
        resolve(pipeline_config(), replace_frames(recording, left), "eds00")


def test_as_many_frames_as_the_preset_needs_are_enough(recording: Any):
    parser, _ = used(pipeline_config(), replace_frames(recording, frames(list(range(971)))), "eds00")
    assert parser["train_frame_indices"] == PRESETS["eds00"].train_frames


@pytest.mark.parametrize(
    ("spelling", "name"),
    [
        *((name, name) for name in PRESETS),
        *((published, name) for name, published in PUBLISHED.items()),
    ],
)
def test_presets_have_one_spelling_and_those_of_the_reference_are_known(spelling: str, name: str):
    assert preset_named(spelling) == name


def test_a_preset_that_there_is_not_is_refused_with_those_that_there_are():
    with pytest.raises(FlagError, match=r"--preset eds99 is not known; give one of eds00, eds11, .*spiral2\."):
        preset_named("eds99")
