"""What the refiner finds, of numbers that are known: slopes against finite differences, solutions against what was put
in, and a training with a wrong clock against the right one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.cameras.rays import Frustums, RaySamples
from nerfstudio.field_components.field_heads import FieldHeadNames
from pose_refinement import errors, made_wrong, reprojection_error
from recordings import write_event_recording
from scipy.spatial.transform import Rotation
from torch import nn

from enerf_ns.bench.validation import FAR, _recording, _straight
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.method.runs import method_config, train
from enerf_ns.poses.corrections import Corrections
from enerf_ns.poses.findings import findings, picture_shift
from enerf_ns.poses.posed_camera import PosedCamera
from enerf_ns.poses.refiner import NUM_SHAPES, Part, PoseRefiner, RefinerConfig, Slopes, render_slopes
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.event_sensor import SensorSettings
from enerf_ns.simulator.settings import SimulationSettings

CAMERA = Camera(64, 48, 60.0, 60.0, 32.0, 24.0)
SPAN = 1_000_000_000
TURNS = 0.2


def trajectory(turns: float = TURNS) -> Trajectory:
    """Shakes, and turns about two axes, over a second."""
    times = np.arange(0, SPAN + 1, 5_000_000)
    phase = 2.0 * np.pi * times / SPAN
    positions = 0.1 * np.stack([np.sin(3 * phase), np.cos(2 * phase), np.sin(phase)], axis=1)
    vectors = turns * np.stack([np.cos(2 * phase), np.sin(3 * phase), 0.1 * np.sin(phase)], axis=1)
    return Trajectory(times, positions, Rotation.from_rotvec(vectors).as_quat())


def recording(turns: float = TURNS) -> EventRecording:
    return EventRecording(Path("made"), "made", CAMERA, trajectory(turns), lambda: iter(()), ())


class Smooth(nn.Module):
    """A field of waves, whose slopes are those of its formula."""

    def forward(self, samples: RaySamples) -> dict[Any, torch.Tensor]:
        places = samples.frustums.get_positions()
        density = 2.0 + torch.sin(3.0 * places[..., :1]) * torch.cos(2.0 * places[..., 1:2])
        colour = 0.5 + 0.3 * torch.sin(4.0 * places[..., :1] + 2.0 * places[..., 1:2] - places[..., 2:])
        return {FieldHeadNames.DENSITY: density, FieldHeadNames.RGB: colour}


def sampled(rays: Any) -> tuple[RaySamples, list, list]:
    edges = torch.linspace(0.5, 2.5, 41).expand(len(rays), -1)[..., None]
    starts, ends = edges[:, :-1], edges[:, 1:]
    frustums = Frustums(
        rays.origins[:, None].expand(-1, 40, -1),
        rays.directions[:, None].expand(-1, 40, -1),
        starts,
        ends,
        torch.ones_like(starts),
    )
    return RaySamples(frustums, deltas=ends - starts), [], []


def smooth_model() -> Any:
    return SimpleNamespace(field=Smooth(), collider=lambda rays: rays, _samples=sampled, gain=1.0)


@pytest.mark.parametrize("number", range(6))
def test_slopes_are_those_of_finite_differences(number: int):
    """Of brightness, with shifts (metres) and rotation vectors of the camera."""
    generator = torch.Generator().manual_seed(0)
    pixels = torch.randint(64 * 48, (40,), generator=generator)
    times = torch.randint(SPAN, (40,), generator=generator)
    transform = torch.from_numpy(np.column_stack([Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix(), [0.1, 0.2, 0.3]]))
    posed, model = PosedCamera(CAMERA, trajectory(), transform, 0.7), smooth_model()

    def brightness(step: float) -> torch.Tensor:
        corrections = torch.zeros(40, 6)
        corrections[:, number] = step
        rays = posed.rays(pixels, times, corrections=corrections)
        return render_slopes(model, rays, lambda rgb: rgb[:, 0], posed.axes(times), posed.scale)[0][:, 0].double()

    _, slopes = render_slopes(model, posed.rays(pixels, times), lambda rgb: rgb[:, 0], posed.axes(times), posed.scale)
    found = np.concatenate([slopes.shifts, slopes.turns], axis=1)[:, number]
    expected = ((brightness(3e-3) - brightness(-3e-3)) / 6e-3).numpy()
    np.testing.assert_allclose(found, expected, atol=0.02 * np.abs(expected).max())
    assert np.abs(expected).max() > 0.05


def looks(
    refiner: PoseRefiner, wrong: dict[Part, Any], noise: float, number: int = 60, seed: int = 0, span: int = SPAN
) -> None:
    """Has a refiner look at pairs whose brightness is a random linear function of the ray, as if poses were wrong."""
    random = np.random.default_rng(seed)
    for _ in range(number):
        times = random.integers(0, span, (2, 256))
        pixels = random.integers(0, CAMERA.width * CAMERA.height, 256)
        bends = random.normal(size=(512, 3 * NUM_SHAPES))
        slopes = Slopes(*200.0 * random.normal(size=(3, 512, 3)), bends=bends)
        others, lags = random.normal(size=(256, 3)), np.zeros((2, 256, 2))
        twists = np.concatenate([slopes.shifts, slopes.turns], axis=1)
        columns = refiner._columns(twists, slopes, times.reshape(-1), np.tile(pixels, 2))
        seen = sum(columns[part] @ np.atleast_1d(value) for part, value in wrong.items()) + np.zeros(512)
        residual = seen[256:] - seen[:256] + noise * random.normal(size=256)
        refiner.look(residual, slopes, times, pixels, others, lags)


def solved(refiner: PoseRefiner, wrong: dict[Part, Any], noise: float = 0.3, span: int = SPAN) -> None:
    """Looks and solves until nothing is left, as while a field is trained that knows the scene."""
    for number in range(25):
        left = {part: np.atleast_1d(value) - found(refiner, part) for part, value in wrong.items()}
        looks(refiner, left, noise, 6, number, span)
        refiner.solve(400)


def found(refiner: PoseRefiner, part: Part) -> np.ndarray:
    return (refiner.value.numpy() * refiner._units)[refiner.parts[part]]


@pytest.mark.parametrize(
    ("part", "value"),
    [
        ("clock", [4.0]),
        ("rotation", np.radians([0.8, -0.5, 0.3])),
        ("translation", [0.004, -0.006, 0.003]),
        ("lens", [0.03, -0.02]),
    ],
)
def test_the_part_that_is_wrong_is_found_and_no_other(part: Part, value: Any):
    refiner = PoseRefiner(RefinerConfig(), recording())
    solved(refiner, {part: value})
    assert refiner.corrected == [part]
    np.testing.assert_allclose(found(refiner, part), value, atol=0.1 * np.abs(value).max())
    assert refiner.value.count_nonzero() == len(value)


def test_a_clock_that_runs_fast_is_found_in_a_long_recording():
    times = np.arange(0, 100 * SPAN + 1, 5_000_000)
    short = trajectory()
    rows = np.arange(len(times)) % (len(short.times) - 1)
    long = Trajectory(times, short.positions[rows], short.quaternions[rows])
    refiner = PoseRefiner(RefinerConfig(), replace(recording(), trajectory=long))
    solved(refiner, {"rate": [0.1]}, span=100 * SPAN)
    assert refiner.corrected == ["rate"]
    assert refiner.corrections.delay_rate == pytest.approx(0.1, abs=0.005)


def test_two_parts_are_found_together():
    refiner = PoseRefiner(RefinerConfig(), recording())
    solved(refiner, {"clock": [3.0], "lens": [0.02, 0.0]})
    assert set(refiner.corrected) >= {"clock", "lens"}
    assert found(refiner, "clock")[0] == pytest.approx(3.0, abs=0.1)


def test_a_drift_is_found():
    refiner = PoseRefiner(RefinerConfig(), recording())
    wrong = np.random.default_rng(5).normal(size=(refiner.basis.size, 6)) * ([0.005] * 3 + [0.004] * 3)
    solved(refiner, {"drift": wrong.reshape(-1)})
    assert refiner.corrected == ["drift"]
    functions = refiner.basis.at(np.linspace(0, SPAN, 101).astype(np.int64))
    left, whole = functions @ (found(refiner, "drift").reshape(-1, 6) - wrong), functions @ wrong
    assert ((left**2).mean(axis=0) < 0.15 * (whole**2).mean(axis=0)).all()


def noisy() -> PoseRefiner:
    return PoseRefiner(RefinerConfig(), replace(recording(), pose_noise_taken_off=(0.002, 0.004)))


def test_what_smoothing_left_of_noise_is_found_beside_a_clock():
    """From the first solution on, with no test; it is not taken for a drift."""
    refiner = noisy()
    size = refiner.units["noise"].reshape(-1, 6)
    np.testing.assert_allclose(size, np.tile([0.0012] * 3 + [0.0024] * 3, (len(size), 1)))
    wrong = size * np.random.default_rng(5).normal(size=size.shape)
    solved(refiner, {"noise": wrong.reshape(-1), "clock": [3.0]})
    assert refiner.corrected == ["clock", "noise"]
    assert found(refiner, "clock")[0] == pytest.approx(3.0, abs=0.1)
    assert refiner.noise_basis is not None and refiner.corrections.noise is not None
    functions = refiner.noise_basis.at(np.linspace(0, SPAN, 1001).astype(np.int64))
    left, whole = functions @ (found(refiner, "noise").reshape(-1, 6) - wrong), functions @ wrong
    assert ((left**2).mean(axis=0) < 0.2 * (whole**2).mean(axis=0)).all()
    (row,) = [row for row in findings(refiner, 2.0) if row.what.startswith("noise")]
    assert row.is_corrected and row.pixels > 0.0


def test_noise_that_is_not_there_is_hardly_made_up():
    refiner = noisy()
    looks(refiner, {}, 1.0, 60)
    refiner.solve(400)
    assert refiner.corrected == ["noise"]
    size = refiner.units["noise"]
    assert np.sqrt(np.mean((found(refiner, "noise") / size) ** 2)) < 0.3


def test_long_noise_is_found_in_pieces_that_average_it():
    """Of white noise, four times as many poses have half of the standard deviation."""
    long = trajectory()
    long = Trajectory(
        np.arange(4 * 321) * 5_000_000, np.resize(long.positions, (1284, 3)), np.resize(long.quaternions, (1284, 4))
    )
    refiner = PoseRefiner(RefinerConfig(), replace(recording(), trajectory=long, pose_noise_taken_off=(0.002, 0.004)))
    assert refiner.noise_basis is not None and refiner.noise_basis.num_pieces == 160
    assert refiner.units["noise"][0] == pytest.approx(0.6 * 0.002 / 2.0, rel=0.01)


def test_no_drift_wanted_is_no_noise_either():
    refiner = PoseRefiner(RefinerConfig(refine_drift=False), replace(recording(), pose_noise_taken_off=(0.002, 0.004)))
    assert "noise" not in refiner.parts


@pytest.mark.parametrize("seed", range(5))
def test_nothing_wrong_is_left_alone(seed: int):
    refiner = PoseRefiner(RefinerConfig(), recording())
    looks(refiner, {}, 1.0, 60, seed)
    assert not refiner.solve(400)
    assert refiner.corrected == [] and refiner.value.count_nonzero() == 0
    assert not refiner.corrections.moves_poses


def test_finer_pixels_alone_make_no_correction_surer():
    """The same picture with four times as many pixels a side is rendered with the same error in radians."""
    fine = Camera(256, 192, 240.0, 240.0, 128.0, 96.0)
    errors = []
    for camera in (CAMERA, fine):
        refiner = PoseRefiner(RefinerConfig(), replace(recording(), camera=camera))
        looks(refiner, {}, 0.01, 600)
        errors.append([refiner.errors_of(part).max() for part in ("clock", "rotation", "translation")])
    np.testing.assert_allclose(*errors, rtol=0.02)


def test_what_the_scene_can_take_up_is_not_taken_for_a_wrong_pose():
    """A difference that a bent scene explains moves nothing."""
    refiner = PoseRefiner(RefinerConfig(), recording())
    random = np.random.default_rng(0)
    bend = 0.02 * random.normal(size=3 * NUM_SHAPES)
    for _ in range(60):
        bends = 50.0 * random.normal(size=(512, 3 * NUM_SHAPES))
        slopes = Slopes(*random.normal(size=(3, 512, 3)), bends=bends)
        bent = slopes.bends @ bend
        residual = bent[256:] - bent[:256] + 0.1 * random.normal(size=256)
        times, pixels = random.integers(0, SPAN, (2, 256)), random.integers(0, 3072, 256)
        refiner.look(residual, slopes, times, pixels, np.zeros((256, 3)), np.zeros((2, 256, 2)))
    assert not refiner.solve(400)


def test_what_turns_out_to_be_right_is_taken_back_at_once():
    """Though corrections grow a step at a time."""
    refiner = PoseRefiner(RefinerConfig(), recording())
    refiner.is_corrected[0], refiner.value[0] = True, 1.5
    assert refiner.corrected == ["clock"] and refiner.corrections.delay == 30.0
    looks(refiner, {"clock": [-30.0]}, 0.3)
    assert refiner.solve(400)
    assert refiner.corrected == [] and refiner.corrections.delay == 0.0


def test_corrections_that_events_fit_worse_are_taken_back():
    """As where a field has followed a correction to where it cannot render the scene."""
    refiner = PoseRefiner(RefinerConfig(), recording())
    solved(refiner, {"clock": [4.0]})
    assert not refiner.is_taken_back
    for number in range(10):
        looks(refiner, {"clock": [30.0], "rotation": np.radians([0.8, -0.5, 0.3])}, 0.3, 6, number)
        refiner.solve(400)
    assert refiner.is_taken_back and refiner.corrected == ["clock"]
    np.testing.assert_allclose(found(refiner, "clock"), [4.0], atol=0.4)


def test_flags_force_and_forbid():
    refiner = PoseRefiner(RefinerConfig(refine_clock=False, refine_lens=True), recording())
    assert refiner.corrected == ["lens"] and "clock" not in refiner.allowed
    looks(refiner, {"clock": [4.0]}, 0.3)
    refiner.solve(400)
    assert found(refiner, "clock")[0] == 0.0 and "lens" in refiner.corrected


def test_a_clock_that_is_stated_stays():
    refiner = PoseRefiner(RefinerConfig(clock_ms=3.0, refine_clock=False), recording())
    looks(refiner, {"rotation": np.radians([0.8, -0.5, 0.3])}, 0.3)
    assert refiner.solve(400)
    assert refiner.corrections.delay == 3.0


def test_a_camera_that_turns_about_one_axis_tells_neither_mount_nor_lens():
    refiner = PoseRefiner(RefinerConfig(), recording(turns=0.01))
    assert refiner.allowed == ["clock", "rate", "drift"]


def test_corrections_are_spread_over_the_part_of_a_recording_that_is_used():
    """Over which alone a camera has to turn, too."""
    moving, times = trajectory(), np.arange(0, 40 * SPAN + 1, 5_000_000)
    rows = np.arange(len(times)).clip(0, len(moving.times) - 1)  # after a second, the camera rests
    rests = Trajectory(times, moving.positions[rows], moving.quaternions[rows])
    whole = replace(recording(), trajectory=rests, pose_noise_taken_off=(0.002, 0.004))
    used = PoseRefiner(RefinerConfig(), replace(whole, time_range=(0, 2 * SPAN)))
    assert used.noise_basis is not None
    assert [(basis.start, basis.end) for basis in (used.basis, used.noise_basis)] == 2 * [(0, 2 * SPAN)]
    assert used.basis.num_pieces == 10 and used.noise_basis.num_pieces == 160
    assert used.units["noise"][0] == pytest.approx(0.6 * 0.002 * math.sqrt(160 / 200))
    assert "lens" in used.allowed
    resting = PoseRefiner(RefinerConfig(), replace(whole, time_range=(20 * SPAN, 40 * SPAN)))
    assert "lens" not in resting.allowed


@pytest.mark.parametrize("numbers", [9.0, 4.0])
def test_a_distortion_is_not_blamed_on_the_focal_length(numbers: float):
    """Neither one that is too large to be plausible nor one with which no direction is seen at the corners."""
    refiner = PoseRefiner(RefinerConfig(refine_lens=True), recording())
    unit = refiner.units["lens"][1]
    refiner.value[refiner.parts["lens"].stop - 1] = -numbers
    if numbers < 8.0:
        with pytest.raises(ValueError, match="no inverse"):
            Corrections(distortion=-numbers * unit).camera(CAMERA)
    with pytest.raises(RecordingError, match="made: to fit the events, the lens would have to have a distortion"):
        refiner._check()
    refiner.value[refiner.parts["lens"].start] = 9.0
    with pytest.raises(RecordingError, match="the focal length would have to be corrected by more than 24 %"):
        refiner._check()


def distorted(first: float) -> Camera:
    return replace(CAMERA, model="radtan", distortion=(first, 0.0, 0.0, 0.0))


def test_a_lens_that_hardly_has_an_inverse_has_slopes():
    """A radius r is seen at r - r^3 / 3 at most, so that the corner, which is seen at 2 / 3, has no larger one."""
    with pytest.raises(ValueError, match="no inverse"):
        distorted(-0.3335)
    refiner = PoseRefiner(RefinerConfig(), replace(recording(), camera=distorted(-0.3325)))
    _, slope = refiner._lens_slopes()
    ends = (distorted(first).pixel_directions().reshape(-1, 3) for first in (-0.3325, -0.3315))
    first, last = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in ends)
    np.testing.assert_allclose(slope, (last - first) / 1e-3, atol=1e-9)


def test_what_no_recording_is_wrong_by_is_an_error():
    refiner = PoseRefiner(RefinerConfig(), recording())
    with pytest.raises(RecordingError, match="clock of the poses would have to be corrected by more than 100 ms"):
        for number in range(40):
            looks(refiner, {"clock": [60.0]}, 0.3, 6, number)
            refiner.solve(400)


def test_a_stored_refiner_goes_on_where_it_was():
    first = PoseRefiner(RefinerConfig(), recording())
    looks(first, {"clock": [4.0]}, 0.3)
    first.solve(400)
    second = PoseRefiner(RefinerConfig(), recording())
    second.load_state_dict(first.state_dict())
    for refiner in (first, second):
        looks(refiner, {"clock": [1.0]}, 0.3, seed=9)
        refiner.solve(400)
    assert second.corrected == first.corrected == ["clock"]
    assert torch.equal(first.value, second.value)


def test_findings_state_values_and_whether_they_are_identifiable():
    refiner = PoseRefiner(RefinerConfig(), recording())
    solved(refiner, {"clock": [4.0]})
    clock, *others = findings(refiner, 2.0)
    assert (
        clock.is_corrected and clock.is_identifiable and clock.value.startswith("+4.0") and clock.flag.endswith("clock")
    )
    assert not any(row.is_corrected for row in others) and all(row.pixels < 1e-6 for row in others)
    nothing = findings(PoseRefiner(RefinerConfig(), recording()), 2.0)
    assert not any(row.is_identifiable for row in nothing if row.what != "drift")


def test_a_pictures_shift_is_that_of_the_focal_length_and_of_a_turn():
    """A turn about the optical axis by a small angle moves a pixel by its distance from the middle times the angle."""
    made = recording()
    columns, rows = np.meshgrid(np.linspace(0, 63, 5).round(), np.linspace(0, 47, 5).round())
    away = np.sqrt(((columns - 32.0) ** 2 + (rows - 24.0) ** 2).mean())
    assert picture_shift(made, Corrections(), Corrections(focal_scale=1.01), 2.0) == pytest.approx(
        0.01 * away, rel=0.02
    )
    assert picture_shift(made, Corrections(), Corrections(rotation=(0.0, 0.0, 0.01)), 2.0) == pytest.approx(
        0.01 * away, rel=0.02
    )


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Callable[[bool], EventRecording]:
    """The demo's scene, with right poses: a second as the demo has it, or half of it on few pixels."""

    @cache
    def of(is_whole: bool) -> EventRecording:
        folder = tmp_path_factory.mktemp("simulated") / "shapes"
        small = {} if is_whole else {"width": 64, "height": 48, "duration": 0.5}
        simulate(SimulationSettings("shapes", layout="event_recording", **small), folder)
        return read_recording(folder)

    return of


DRAWN = pytest.mark.sweep(1)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [1.0, pytest.param(0.0, marks=DRAWN), pytest.param(6.0, marks=DRAWN)])
@pytest.mark.parametrize("is_whole", [False, pytest.param(True, marks=pytest.mark.exhaustive)])
def test_a_training_finds_the_clock(simulated, tmp_path: Path, delay: float, is_whole: bool):
    """Also where it is off by more than a field could learn with."""
    recording = simulated(is_whole)
    moving = recording.trajectory
    late = Trajectory(moving.times + round(delay * 1e6), moving.positions, moving.quaternions)
    changed = replace(recording, trajectory=late, frames=None, blurred_frames=None)
    folder = write_event_recording(changed, tmp_path / "late")
    settings: dict[str, Any] = {"max_num_iterations": 400 if delay else 200, "evaluation_share": 0.0}
    if not is_whole:
        settings["pipeline.datamanager.event_pairs"] = 256
    run = train(method_config("enerf", folder, tmp_path / "runs", settings))
    refiner = run.pipeline.poses
    assert refiner.corrected == (["clock"] if delay else [])
    assert refiner.corrections.delay == pytest.approx(delay, abs=0.3)
    if not delay:  # where nothing is wrong, nothing changes
        parts = {f"pipeline.poses.refine_{part}": False for part in ("clock", "mount", "lens", "drift")}
        without = train(method_config("enerf", folder, tmp_path / "without", {**settings, **parts}))
        weights, same = (one.pipeline.model.field.state_dict() for one in (run, without))
        assert all(torch.equal(weights[name], same[name]) for name in same)


@pytest.mark.exhaustive
def test_a_drift_of_many_pixels_is_corrected(tmp_path: Path):
    """Slopes of details as fine as these pixels do not reach as far."""
    path = _straight(0.6, (-0.15, 0, 0), (0.15, 0.05, 0.05), (-0.1, 2, 0), (0.1, 2, 0))
    sequence = _recording("far", FAR, path, (640, 480), light=False, num_frames=21)
    settings = sequence.simulation_settings(tmp_path, layout="event_recording", sensor=SensorSettings())
    simulate(settings, tmp_path / "right")
    made_wrong(tmp_path / "right", tmp_path / "wrong", {"drift": (10.0, 0.5)}, seed=0)
    few = {"max_num_iterations": 900, "evaluation_share": 0.0}
    run = train(method_config("enerf", tmp_path / "wrong", tmp_path / "runs", few))
    assert run.pipeline.poses.corrected == ["drift"]
    true = read_recording(tmp_path / "right").trajectory
    given = read_recording(tmp_path / "wrong").trajectory
    before, after = errors(true, given), errors(true, run.pipeline.datamanager.recording.trajectory)
    assert after[1] < 0.75 * before[1] and after[0] < before[0]


def test_what_another_scene_explains_is_no_reprojection_error():
    """A world that is turned, shifted and scaled, and the focal length of a camera that only slides."""
    right = replace(recording(), depth_range=(1.0, 3.0))
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5])
    path = right.trajectory
    places = 1.7 * turn.apply(path.positions) + [1.0, 2.0, 3.0]
    turned = (turn * Rotation.from_quat(path.quaternions)).as_quat()
    moved = replace(right, trajectory=Trajectory(path.times, places, turned))
    assert reprojection_error(right, moved) < 1e-6

    unturned = trajectory(turns=0.0)
    level = unturned.positions * [1.0, 1.0, 0.0]
    sliding = replace(right, trajectory=Trajectory(unturned.times, level, unturned.quaternions))
    longer = replace(CAMERA, fx=1.03 * CAMERA.fx, fy=1.03 * CAMERA.fy)
    assert reprojection_error(sliding, replace(sliding, camera=longer)) < 1e-3
    assert reprojection_error(right, replace(right, camera=longer)) > 0.1  # 3 % of 12 pixels of turning


def test_no_scene_explains_noise_of_the_poses():
    """Turns about the two axes across the view move each pixel by the focal length times them; two thirds of their
    variance are left between two poses, on average."""
    narrow = Camera(64, 48, 600.0, 600.0, 32.0, 24.0)
    path = trajectory(turns=0.01)
    right = replace(recording(), camera=narrow, trajectory=path, depth_range=(1.0, 3.0))
    radians = 1e-3
    noise = Rotation.from_rotvec(radians * np.random.default_rng(0).normal(size=(len(path.times), 3)) * [1.0, 1.0, 0.0])
    turned = (Rotation.from_quat(path.quaternions) * noise).as_quat()
    noisy = replace(right, trajectory=Trajectory(path.times, path.positions, turned))
    left = math.sqrt(2.0 / 3.0)
    assert reprojection_error(right, noisy) == pytest.approx(600.0 * radians * math.sqrt(2.0) * left, rel=0.1)
