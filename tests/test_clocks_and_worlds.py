"""One recording on other clocks, in other worlds, slower and faster, is the same recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from recordings import changed, seconds, write_event_recording
from small_runs import EVENTS, check_two_steps, set_up, small_config

from enerf_ns.dataparsers.event_dataparser import EventDataParserConfig
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.inspection.page import Inspection
from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.method.trainer import EnerfTrainerConfig

HOUR = 3600 * 10**9
EPOCH = 1_600_000_000_123_456_789
LATEST = 2**62 - 10**9
"""The last second that can be written."""

DEPTH_RANGE = 0.7, 1.9

ORIGINS = [0.0, 1e4, 1e5, 1e6, 5e6]


def write_davis(recording: EventRecording, folder: Path) -> Path:
    """In the text layout of the UZH data set, whose clock is in seconds."""
    (folder / "images").mkdir(parents=True)
    rows = [row for e in recording.stream_events() for row in zip(e.t.tolist(), e.x, e.y, e.p, strict=True)]
    (folder / "events.txt").write_text("".join(f"{seconds(t)} {x} {y} {int(p > 0)}\n" for t, x, y, p in rows))
    poses = np.concatenate([recording.trajectory.positions, recording.trajectory.quaternions], axis=1).tolist()
    stamped = zip(recording.trajectory.times.tolist(), poses, strict=True)
    (folder / "groundtruth.txt").write_text(
        "".join(f"{seconds(t)} {' '.join(map(repr, pose))}\n" for t, pose in stamped)
    )
    camera, frames = recording.camera, recording.frames
    (folder / "calib.txt").write_text(f"{camera.fx} {camera.fy} {camera.cx} {camera.cy} 0 0 0 0 0\n")
    assert frames is not None
    for i, file in enumerate(frames.filenames):
        (folder / f"images/{i:05d}.png").write_bytes(file.read_bytes())
    names = [f"{seconds(t)} images/{i:05d}.png\n" for i, t in enumerate(frames.times.tolist())]
    (folder / "images.txt").write_text("".join(names))
    return folder


def config_of(folder: Path, output_dir: Path, **changes: Any) -> EnerfTrainerConfig:
    """A small training whose depth range is that of the recording that all are made of."""
    config = small_config(folder, output_dir, **changes)
    config.pipeline.datamanager.dataparser = EventDataParserConfig(data=folder, depth_range=DEPTH_RANGE)
    return config


WRITERS = {"event_recording": write_event_recording, "davis": write_davis}


@pytest.fixture(scope="module", params=WRITERS)
def on_clocks(request: pytest.FixtureRequest, recording: Path, tmp_path_factory) -> tuple[str, dict[int, Path]]:
    """The same recording in one layout on four clocks."""
    folder, whole = tmp_path_factory.mktemp("clocks"), read_recording(recording)
    write = WRITERS[request.param]
    return request.param, {z: write(changed(whole, z), folder / str(z)) for z in (0, HOUR, EPOCH, LATEST)}


def test_the_clock_changes_nothing_but_stamps(on_clocks, tmp_path: Path) -> None:
    """Numbers, problems, cameras, pairs, rays and trained weights are on three clocks what they are on one from 0."""
    seen = {}
    layout, folders = on_clocks
    for zero, folder in folders.items():
        whole = read_recording(folder)
        assert whole.trajectory.start == (0 if layout == "davis" else zero)  # whose reader starts the clock again
        zero = whole.trajectory.start
        assert whole.frames is not None
        found = Inspection.of(whole)
        problems = [problem.what.replace(str(folder), "") for problem in found.problems]
        assert "<img" in found.page()
        config = config_of(folder, tmp_path / folder.name, data__silent_pairs=32)
        pipeline = check_two_steps(config, EVENTS | {"no_event_loss"}).pipeline
        manager = pipeline.datamanager
        batch = manager.next_batch(pipeline.model.sensor)
        rays = manager.rays(batch, pipeline.model.sensor)
        outputs = manager.train_dataparser_outputs
        seen[folder] = (
            [index_events(whole).times - zero, batch.events.start - zero, batch.events.end - zero, batch.events.pixels],
            [batch.events.on, rays.origins, rays.directions, outputs.cameras.camera_to_worlds, outputs.scene_box.aabb],
            [torch.from_numpy(found.statistics.edges) - zero, torch.from_numpy(found.statistics.rate)],
            [torch.from_numpy(whole.trajectory.times) - zero, torch.from_numpy(whole.frames.times) - zero],
            [*pipeline.model.parameters()],
            [found.numbers(), problems],
        )
    first, *others = seen.values()
    assert len(first[0][0]) > 1000 and len(others) == 3
    for other in others:
        assert all(torch.equal(a, b) for i in range(5) for a, b in zip(first[i], other[i], strict=True))
        assert first[5] == other[5]


@pytest.mark.parametrize(("slower", "faster"), [(36_000, 1), (1, 100)], ids=["an hour", "a millisecond"])
def test_an_hour_and_a_millisecond(recording: Path, tmp_path: Path, slower: int, faster: int) -> None:
    """A tenth of a second that passes slower, or faster: the same path, poses, box and number of events."""
    quick, whole = read_recording(recording), changed(read_recording(recording), EPOCH, slower=slower, faster=faster)
    folder = write_event_recording(whole, tmp_path / "recording")
    found, usual = Inspection.of(read_recording(folder)), Inspection.of(quick)
    length = whole.trajectory.end - whole.trajectory.start
    assert length == 10**8 * slower // faster and found.statistics.seconds == pytest.approx(length * 1e-9, rel=0.05)
    for name in ("per pixel", "polarity", "path", "near and far", "box", "pose coverage"):
        assert found.numbers()[name] == usual.numbers()[name]
    suspected = [problem.what for problem in found.problems if "look like microseconds" in problem.what]
    assert len(suspected) == (faster == 100)  # a thousand times as long would be usual
    assert {problem.what for problem in found.problems} - {*suspected} == {problem.what for problem in usual.problems}

    times = quick.instants(1000)
    expected = quick.trajectory.poses(torch.from_numpy(times))
    poses = whole.trajectory.poses(torch.from_numpy(times * slower // faster + EPOCH))
    fastest = float(expected.diff(dim=0).abs().max()) / (times[1] - times[0])
    rounded = 2 * (faster - 1)  # ns of the quick recording: the stamps of its poses, and the instants
    torch.testing.assert_close(poses, expected, rtol=0, atol=1e-12 + rounded * fastest)
    check_two_steps(config_of(folder, tmp_path / "outputs"), EVENTS)


def test_rays_of_events_and_of_frames_agree_in_any_world(recording: Path, tmp_path: Path) -> None:
    """Origins within the rounding to float32 of scene units, 2^-23 below 2, and of metres in float64 before the shift.

    Both against Nerfstudio's rays of the same cameras, and against the recording in a world that begins nearby.
    """
    near = None
    for origin in ORIGINS:
        folder = write_event_recording(changed(read_recording(recording), origin=origin), tmp_path / f"{origin:g}")
        pipeline = set_up(config_of(folder, tmp_path / "outputs" / folder.name)).pipeline
        manager = pipeline.datamanager
        outputs, frames = manager.train_dataparser_outputs, manager.train_dataset.frames
        camera = frames.camera
        pixels = torch.arange(0, camera.width * camera.height, 7)
        bound = 2**-23 + 8 * outputs.dataparser_scale * np.spacing(origin)
        for i, time in enumerate(frames.times.tolist()):
            event = manager.event_camera.rays(pixels, torch.full_like(pixels, time))
            places = torch.stack([pixels // camera.width, pixels % camera.width], dim=-1) + 0.5
            frame = outputs.cameras.generate_rays(camera_indices=torch.full((len(pixels), 1), i), coords=places)
            assert event.origins.abs().max() < 2
            torch.testing.assert_close(event.origins, frame.origins, rtol=0, atol=bound)
            torch.testing.assert_close(event.directions, frame.directions, rtol=0, atol=1e-6)
        batch = manager.next_batch(pipeline.model.sensor)
        rays = manager.rays(batch, pipeline.model.sensor)
        near = near or rays
        torch.testing.assert_close(rays.origins, near.origins, rtol=0, atol=bound)
        torch.testing.assert_close(rays.directions, near.directions, rtol=0, atol=1e-6)
