"""What a step draws, against the raw events and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_runs import HEIGHT, WIDTH, set_up, small_config

from enerf_ns.dataparsers.recording.files import load_image
from enerf_ns.events.batch import EventBatch
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.scene.render import Renderer
from enerf_ns.simulator.scene.scenes import SCENES
from enerf_ns.simulator.settings import SimulationSettings


def test_a_step_holds_what_the_recording_saw(colour_recording: Path, tmp_path: Path):
    """Pairs against the raw events of the recording, frame rays against the picture files."""
    config = small_config(
        colour_recording,
        tmp_path,
        data__supervision="events+frames",
        data__silent_pairs=10,
        data__train_num_rays_per_batch=20,
        data__exposure_samples=1,
    )
    pipeline = set_up(config).pipeline
    manager = pipeline.datamanager
    batch = manager.next_batch(pipeline.model.sensor)
    rays = manager.rays(batch, pipeline.model.sensor)
    assert batch.num_pairs == rays.num_pairs == 64 + 10
    assert len(rays) == manager.get_train_rays_per_batch() == 2 * 74 + 20
    events, frames = batch.events, batch.frames
    counts = events.on + events.off
    assert len(counts[events.fired]) == 64 and counts[events.fired].all() and not counts[events.silent].any()
    assert len(frames.colours) == 20
    parts = batch.split(torch.arange(float(len(rays)))[:, None])
    assert [len(part) for part in parts] == [74, 74, 20] and torch.cat(parts).flatten().tolist() == [*range(168)]

    files = manager.train_dataset.frames.filenames
    assert all(file.parent.name == "images_corrupted" for file in files)
    for colour, (frame, row, column) in zip(frames.colours, frames.indices.tolist(), strict=True):
        np.testing.assert_allclose(colour, load_image(files[frame])[row, column] / 255.0, atol=1e-6)
    frame, row, column = frames.indices.T
    coordinates = torch.stack([row, column], dim=-1) + 0.5
    expected = manager.train_dataset.cameras.generate_rays(camera_indices=frame[:, None], coords=coordinates)
    torch.testing.assert_close(rays.origins[-20:], expected.origins, rtol=0, atol=1e-6)
    torch.testing.assert_close(rays.directions[-20:], expected.directions, rtol=0, atol=1e-6)


def test_the_rays_of_a_frame_are_those_of_one_instant_of_each_part_of_its_exposure(recording: Path, tmp_path: Path):
    """As many rays as without exposures, of fewer pixels; against rays of the camera at those instants."""
    config = small_config(
        recording,
        tmp_path,
        data__supervision="frames",
        data__train_num_rays_per_batch=400,
        data__exposure_samples=4,
    )
    pipeline = set_up(config).pipeline
    manager = pipeline.datamanager
    batch = manager.next_batch(pipeline.model.sensor)
    frames, rays = batch.frames, manager.rays(batch, pipeline.model.sensor)
    assert frames.times.shape == (100, 4) and len(rays) == manager.get_train_rays_per_batch() == 400
    begins = torch.from_numpy(manager.train_dataset.frames.times)[frames.indices[:, :1]] - 2_500_000
    parts = (frames.times - begins) / 1_250_000
    assert (parts.floor() == torch.arange(4)).all()
    assert 0.4 < (parts % 1).mean() < 0.6 and (parts % 1).min() < 0.05 and (parts % 1).max() > 0.95

    _, row, column = frames.indices.T
    for instant in range(4):
        expected = manager.frame_camera.rays(row * WIDTH + column, frames.times[:, instant])
        torch.testing.assert_close(rays.origins[instant::4], expected.origins, rtol=0, atol=0)
        torch.testing.assert_close(rays.directions[instant::4], expected.directions, rtol=0, atol=0)


def test_the_mean_over_the_instants_is_what_the_simulated_camera_recorded(tmp_path: Path):
    """Pixels of blurred frames against the scene itself, rendered sharply from where the camera is at each instant."""
    folder = tmp_path / "blurred"
    simulate(SimulationSettings("shapes", width=32, height=24, duration=0.5, num_frames=11, exposure_ms=40.0), folder)
    config = small_config(
        folder,
        tmp_path / "outputs",
        data__supervision="frames",
        data__train_num_rays_per_batch=12 * 32,
        data__exposure_samples=32,
    )
    pipeline = set_up(config).pipeline
    manager = pipeline.datamanager
    batch, camera = manager.next_batch(pipeline.model.sensor), manager.recording.camera
    scene_rng, _ = np.random.default_rng(0).spawn(2)
    renderer = Renderer(SCENES["shapes"](scene_rng), camera)
    poses = manager.recording.trajectory.poses(batch.frames.times).numpy()
    seen = torch.tensor(
        [
            [renderer.brightness(pose)[row, column] for pose in instants]
            for instants, (_, row, column) in zip(poses, batch.frames.indices.tolist(), strict=True)
        ]
    )
    rendered = batch.split(seen.flatten()[:, None].expand(-1, 3))[2]
    assert (rendered[:, 0] - seen[:, 16]).abs().max() > 0.1  # there is blur
    torch.testing.assert_close(rendered.float(), batch.frames.colours, rtol=0, atol=0.03)


def test_without_exposures_and_with_one_instant_training_is_as_it_was(recording: Path, tmp_path: Path):
    """To the bit: one ray a pixel at the time of the frame, and no other random numbers."""

    def losses(**changes: Any) -> list[float]:
        config = small_config(recording, tmp_path, data__supervision="frames", **changes)
        config.pipeline.datamanager.dataparser.exposure_ms = 0.0 if not changes else None
        trainer = set_up(config)
        frames = trainer.pipeline.datamanager.next_batch(trainer.pipeline.model.sensor).frames
        times = torch.from_numpy(trainer.pipeline.datamanager.train_dataset.frames.times)
        assert (frames.times == times[frames.indices[:, :1]]).all()
        return [trainer.train_iteration(step)[0].item() for step in range(3)]

    assert losses() == losses(data__exposure_samples=1)


def test_pairs_that_cannot_be_drawn_are_an_error_of_one_sentence(recording: Path, tmp_path: Path):
    with pytest.raises(SystemExit, match=r"enerf: .*recording") as error:
        set_up(small_config(recording, tmp_path, data__pair_mode="window", data__window_ms=1e-6))
    assert "\n" not in str(error.value)


def held_out(times: torch.Tensor, share: float) -> torch.Tensor:
    """Which times (ns) lie in one of eight spans, each in the middle of an eighth of the recording's 0.1 s."""
    return ((times * 8 / 1e8) % 1 - 0.5).abs() < share / 2 + 1e-6


@pytest.mark.parametrize("mode", ["successor", "partner", "window"])
def test_nothing_is_learnt_from_events_that_are_held_out(recording: Path, tmp_path: Path, mode: str):
    changes: dict[str, Any] = dict(
        data__pair_mode=mode, data__window_ms=20.0, data__event_pairs=5000, data__silent_pairs=5000
    )
    pipeline = set_up(small_config(recording, tmp_path, data__held_out_events=0.2, **changes)).pipeline
    manager = pipeline.datamanager
    events = manager.next_batch(pipeline.model.sensor).events
    for kind in (events.silent, events.fired):
        ends = torch.cat([events.start[kind], events.end[kind]])
        assert len(ends) == 10_000 and not held_out(ends, 0.2 - 4e-6).any()
        assert len((ends * 8 // 10**8).unique()) == 8
    between = (events.start * 8 + 5 * 10**7) // 10**8 < (events.end * 8 + 5 * 10**7) // 10**8
    assert between[events.silent].any(), "silence goes on over what is held out"
    assert between[events.fired].any() == (mode != "window")
    times = manager.index.times
    chosen = manager.held_out_pair_sampler.sample(5000, torch.Generator().manual_seed(0))
    ends = torch.cat([chosen.start, chosen.end])
    assert held_out(ends, 0.2).all() and held_out(times, 0.2).sum() > len(ends.unique()) > 50


def test_no_instant_that_is_paired_lies_in_what_is_held_out(recording: Path, tmp_path: Path):
    changes: dict[str, Any] = {
        "data__instant_pairs": 5000,
        "data__instants_apart_ms": 100.0,
        "data__held_out_events": 0.2,
    }
    pipeline = set_up(small_config(recording, tmp_path, **changes)).pipeline
    manager = pipeline.datamanager
    events = manager.next_batch(pipeline.model.sensor).events
    assert len(events) == 64 + 5000 and events.num_silent == 0 and events.ahead is not None
    assert not events.ahead[:64].any() and events.ahead[64:].any(), "pairs of events are exact"
    ends = torch.cat([events.start, events.end])
    assert not held_out(ends, 0.2 - 4e-6).any() and len((ends * 8 // 10**8).unique()) == 8
    assert (events.on + events.off == 0)[64:].any() and (events.on + events.off > 0)[64:].any()
    index, chosen = manager.index, slice(64, None)
    until = [index.count_until(events.pixels[chosen], times[chosen]) for times in (events.start, events.end)]
    assert torch.equal(until[1] - until[0], (events.on + events.off)[chosen])


def test_pairs_are_in_chains_where_instants_are_paired_and_pixels_see_all(recording: Path, tmp_path: Path):
    """Links begin and end with rays of their pixel, outside of what is held out."""

    def drawn(**changes: Any) -> EventBatch:
        changes = {"data__held_out_events": 0.2, **changes}
        pipeline = set_up(small_config(recording, tmp_path, **changes)).pipeline
        batch = pipeline.datamanager.next_batch(pipeline.model.sensor)
        assert batch.events is not None
        assert pipeline.datamanager.rays(batch, pipeline.model.sensor).chains == batch.events.chains
        return batch.events

    events = drawn(data__instant_pairs=33)
    assert events.chains == ((0, 32), (64, 16)) and events.links is not None
    for kind, (first, number) in zip((events.links.of_events, events.links.of_any), events.chains, strict=True):
        before, after = slice(first, first + number), slice(first + number, first + 2 * number)
        for column in (events.pixels[before], events.pixels[after]):
            assert torch.equal(column, events.links.pixels[kind])
        assert torch.equal(events.end[before], events.links.start[kind])
        assert torch.equal(events.start[after], events.links.end[kind])
    ends = torch.cat([events.links.start, events.links.end])
    assert not held_out(ends, 0.2 - 4e-6).any()
    for changes, chains in {
        (("data__instant_pairs", 0),): (),
        (("data__instant_pairs", 10), ("sensor__refractory_period_ns", 1000)): ((0, 0), (64, 5)),
        (("data__instant_pairs", 10), ("data__pair_mode", "window"), ("data__window_ms", 50.0)): ((0, 0), (64, 5)),
    }.items():
        assert drawn(**dict(changes)).chains == chains


def test_without_held_out_events_the_correlation_is_that_of_training_pairs(recording: Path, tmp_path: Path):
    pipeline = set_up(small_config(recording, tmp_path, data__held_out_events=0.0)).pipeline
    manager = pipeline.datamanager
    drawn = []
    sample = manager.pair_sampler.sample
    manager.pair_sampler.sample = lambda *arguments: drawn.append(sample(*arguments)) or drawn[-1]
    assert isinstance(pipeline.event_scores(256)["event_correlation"], float) and len(drawn[0]) == 256
    fired = torch.cat([drawn[0].start, drawn[0].end])
    assert held_out(fired, 0.2).any()


def test_too_few_events_to_hold_out_are_a_reason_and_no_error(recording: Path, tmp_path: Path):
    pipeline = set_up(small_config(recording, tmp_path, data__held_out_events=1e-4)).pipeline
    assert pipeline.event_scores()["event_correlation"].startswith(
        "no pixel fired twice, 10 events apart or less, in the time"
    )


def test_tools_that_look_at_a_scene_get_pixels_of_the_train_cameras(recording: Path, tmp_path: Path):
    """As many as ns-export asks for, evenly over frames, rows and columns."""
    manager = set_up(small_config(recording, tmp_path)).pipeline.datamanager
    manager.train_pixel_sampler.num_rays_per_batch = 6000
    rays, batch = manager.next_train(0)
    assert len(rays) == 6000 and not hasattr(rays, "num_pairs")
    sizes = len(manager.train_dataset), HEIGHT, WIDTH
    for column, size in zip(batch["indices"].T, sizes, strict=True):
        counts = torch.bincount(column, minlength=size)
        assert len(counts) == size and counts.min() > 0.5 * counts.float().mean()
    expected = manager.train_dataset.cameras.generate_rays(
        camera_indices=batch["indices"][:, :1], coords=batch["indices"][:, 1:] + 0.5
    )
    torch.testing.assert_close(rays.origins, expected.origins, rtol=0, atol=1e-6)
    torch.testing.assert_close(rays.directions, expected.directions, rtol=0, atol=1e-6)


@pytest.mark.parametrize("by", ["downscale_factor", "camera_res_scale_factor"])
def test_frames_are_learnt_from_downscaled_on_the_rays_of_their_cameras(recording: Path, tmp_path: Path, by: str):
    config = small_config(recording, tmp_path, data__supervision="frames", data__exposure_samples=1)
    manager_config = config.pipeline.datamanager
    if by == "downscale_factor":
        manager_config.dataparser.downscale_factor = 2.0
    else:
        manager_config.camera_res_scale_factor = 0.5
    manager = set_up(config).pipeline.datamanager
    cameras = manager.train_dataset.cameras
    assert manager.frame_colours.shape[1:] == (HEIGHT // 2, WIDTH // 2, 3)
    assert (cameras.width[0].item(), cameras.height[0].item()) == (WIDTH // 2, HEIGHT // 2)
    rays, batch = manager.next_train(0)
    frame, row, column = batch["indices"].T
    assert row.max() < HEIGHT // 2 and column.max() < WIDTH // 2
    expected = cameras.generate_rays(frame[:, None], torch.stack([row, column], dim=-1) + 0.5)
    torch.testing.assert_close(rays.directions, expected.directions, rtol=0, atol=1e-6)
    torch.testing.assert_close(rays.origins, expected.origins, rtol=0, atol=1e-6)
    data = manager.eval_dataset[0]
    assert data["image"].shape[:2] == data["depth"].shape[:2] == (HEIGHT // 2, WIDTH // 2)
    sharp = load_image(manager.eval_dataset.frames.filenames[0])[..., 0] / 255.0
    assert abs(data["image"].mean().item() - sharp.mean()) < 0.01


def test_a_run_that_is_only_looked_at_indexes_no_events(recording: Path, tmp_path: Path, monkeypatch):
    config = small_config(recording, tmp_path).resolved()
    asked = []
    monkeypatch.setattr("enerf_ns.method.datamanager.index_events", asked.append)
    pipeline = config.pipeline.setup(device="cpu", test_mode="test")
    pipeline.datamanager.next_train(0)
    assert not asked


def test_evaluation_changes_nothing_of_training(recording: Path, tmp_path: Path):
    """Training goes on with the same draws, with and without an evaluation in between."""

    def losses(evaluate: bool) -> list[float]:
        trainer = set_up(small_config(recording, tmp_path, data__silent_pairs=16))
        found = []
        for step in range(3):
            if evaluate:
                state = torch.get_rng_state()
                trainer.pipeline.get_average_eval_image_metrics()
                trainer.pipeline.event_scores(256)
                torch.set_rng_state(state)
            found.append(trainer.train_iteration(step)[0].item())
        return found

    assert losses(evaluate=True) == losses(evaluate=False)


def test_the_delay_of_a_lag_learns_nothing_from_the_rates_of_links(recording: Path, tmp_path: Path):
    """Their noise favours short delays. Pairs have rendered slopes in their place."""
    changes: dict[str, Any] = {"sensor__cutoff_frequency": 100.0, "sensor__learn_cutoff_frequency": True}
    pipeline = set_up(small_config(recording, tmp_path, data__instant_pairs=8, **changes)).pipeline
    pipeline.get_train_loss_dict(0)
    links = pipeline.last_step.batch.events.links
    assert links.rates[:32].any() and links.slopes.shape == (32 + 4, 2) and not links.slopes.any()
    sensor = pipeline.model.sensor
    seen = torch.full((36, 1), 0.5)
    sensor.lag(seen, seen, links).sum().backward()
    assert sensor.lag(seen, seen, links).any() and not sensor.delay.grad.any()
