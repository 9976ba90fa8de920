"""What is learned of a sensor, from pixels whose brightness is known in closed form, without a field."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import scipy.signal
import torch
from torch import Tensor

from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.recording.recording import Events
from enerf_ns.dataparsers.sensor_estimates.estimates import threshold_differences
from enerf_ns.events.batch import EventBatch
from enerf_ns.events.samplers import AccumulationSampler, EventPairSampler, InstantPairSampler, SilentPixelSampler
from enerf_ns.sensor.lag import delay_error
from enerf_ns.sensor.leak import leak_rate_error
from enerf_ns.sensor.part import GREY
from enerf_ns.sensor.sensor_model import SensorModel, SensorModelConfig
from enerf_ns.sensor.threshold_map import SOLVED_EVERY, ThresholdMap
from enerf_ns.sensor.thresholds import ratio_error
from enerf_ns.simulator.event_sensor import EventSensor, SensorSettings
from enerf_ns.supervision.event_supervision import EventSupervision, brightness_change

WIDTH, HEIGHT, SECONDS = 8, 8, 2.0
PIXELS = WIDTH * HEIGHT
RESPONSE = "logarithm:0.001"


def brightness(pixels: Tensor, times: Tensor, delays: Tensor | None = None) -> Tensor:
    """Of pixels at times (ns), float64: log brightness swings, of each pixel by itself."""
    seconds = 1e-9 * (times.double() + (0.0 if delays is None else delays))
    phase, rate = pixels.double() * 2.4, 1.5 + 0.03 * pixels.double()
    return torch.exp(-1.6 + 1.3 * torch.sin(2.0 * torch.pi * rate * seconds + phase))


@dataclass(frozen=True)
class Recorded:
    index: EventIndex
    thresholds: np.ndarray
    """Of each pixel, shape (2, pixels)."""


@cache
def recorded(**settings: Any) -> Recorded:
    """Events of the simulated sensor; it sees a picture every 0.2 ms."""
    settings = {"contrast_thresholds": (0.2, 0.2), "response": RESPONSE, **settings}
    all_pixels = torch.arange(PIXELS)
    times = np.arange(0, int(SECONDS * 1e9), 200_000)

    def picture(time: int) -> np.ndarray:
        return brightness(all_pixels, torch.full_like(all_pixels, int(time))).numpy().reshape(HEIGHT, WIDTH)

    sensor = EventSensor(SensorSettings(**settings), picture(0), 0)
    parts = [sensor.advance(picture(time), int(time)) for time in times[1:]] + [sensor.finish()]
    columns = (np.concatenate([getattr(part, name) for part in parts]) for name in "xytp")
    index = EventIndex.from_events(Events(*columns), WIDTH, HEIGHT)
    return Recorded(index, sensor.contrast_thresholds.reshape(2, PIXELS))


def model(**changes: Any) -> SensorModel:
    settings: dict[str, Any] = {
        "contrast_thresholds": (0.2, 0.2), "response": RESPONSE, "refractory_period_ns": 0, "bayer_pattern": GREY,
        "width": WIDTH, "height": HEIGHT,
    }  # fmt: skip
    return SensorModelConfig(**settings | changes).setup().double()


def seen(sensor: SensorModel, batch: EventBatch) -> tuple[Tensor, Tensor]:
    """What the pixels of a batch see at both instants, shape (pairs, 1)."""
    delays = sensor.blind_after(batch.start, batch.end)
    if delays is not None:
        delays[batch.silent] = 0.0
    return (
        brightness(batch.pixels, batch.start, delays)[:, None],
        brightness(batch.pixels, batch.end)[:, None],
    )


class Drawn:
    """Draws batches of a recording, as training does."""

    def __init__(self, index: EventIndex, seed: int, mode: Any = "successor"):
        self._pairs = EventPairSampler(index, mode, max_distance=10)
        self._silent = SilentPixelSampler(index, 0, int(SECONDS * 1e9) - 1, 10_000_000, 10_000_000)
        self._generator = torch.Generator().manual_seed(seed)

    def batch(self, sensor: SensorModel) -> EventBatch:
        pairs = self._pairs.sample(512, self._generator, sensor.refractory_period if sensor.lags else None)
        return pairs.followed_by(self._silent.sample(128, self._generator, sensor.refractory_period))


def learn(
    sensor: SensorModel,
    index: EventIndex,
    steps: int = 600,
    mode: Any = "successor",
    told: Callable[[EventBatch], EventBatch] = lambda batch: batch,
) -> SensorModel:
    """Trains the sensor alone, with the learning rates of the method, which fall to a tenth; told makes of a batch what
    it is told of it."""
    rates = sensor.learning_rates()
    groups = [{"params": group, "lr": rates[name]} for name, group in sensor.get_param_groups().items()]
    adam = torch.optim.Adam(groups) if groups else None
    drawn = Drawn(index, 0, mode)
    supervision = EventSupervision("huber", 1.0, 0.1, 0.0)
    for step in range(steps):
        batch = told(drawn.batch(sensor))
        start, end = seen(sensor, batch)
        sensor.observe(brightness_change(start, end, batch, sensor).detach(), batch)
        if adam is not None:
            for group, (name, _) in zip(adam.param_groups, sensor.get_param_groups().items(), strict=True):
                group["lr"] = rates[name] * 0.1 ** (step / steps)
            adam.zero_grad()
            torch.stack([*supervision.losses(start, end, batch, sensor).values()]).sum().backward()
            adam.step()
    return sensor


def test_the_ratio_of_the_thresholds_is_learned():
    sensor = learn(model(learn_threshold_ratio=True), recorded(contrast_thresholds=(0.234, 0.166)).index)
    on, off = (float(threshold.detach()) for threshold in map(torch.as_tensor, sensor.contrast_thresholds))
    assert on / off == pytest.approx(0.234 / 0.166, rel=0.01)
    assert 0.5 * (on + off) == pytest.approx(0.2, rel=1e-6)


def test_also_behind_a_refractory_period_where_counts_mislead():
    index = recorded(contrast_thresholds=(0.234, 0.166), refractory_period=8_000_000).index
    sensor = learn(model(learn_threshold_ratio=True, refractory_period_ns=8_000_000), index)
    on, off = (float(torch.as_tensor(threshold).detach()) for threshold in sensor.contrast_thresholds)
    assert on / off == pytest.approx(0.234 / 0.166, rel=0.02)


def test_the_mean_of_the_thresholds_is_learned_where_brightness_is_known():
    sensor = learn(model(learn_mean_threshold=True), recorded(contrast_thresholds=(0.3, 0.3)).index, steps=900)
    assert float(sensor.contrast_thresholds[0]) == pytest.approx(0.3, rel=0.01)


def with_noise(index: EventIndex, rate: float) -> EventIndex:
    """With so many events more a second of each pixel, on or off, that know of nothing."""
    generator, events = np.random.default_rng(3), index.events()
    number = generator.poisson(rate * PIXELS * SECONDS)
    pixel, times = generator.integers(0, PIXELS, number), generator.integers(0, int(SECONDS * 1e9), number)
    noise = (pixel % WIDTH, pixel // WIDTH, times, generator.choice([-1, 1], number))
    both = [np.concatenate(pair) for pair in zip((events.x, events.y, events.t, events.p), noise, strict=True)]
    order = np.argsort(both[2], kind="stable")
    return EventIndex.from_events(Events(*(column[order] for column in both)), WIDTH, HEIGHT)


@pytest.mark.parametrize("mode", ["successor", "partner"])
def test_noise_does_not_draw_the_mean_of_the_thresholds_to_nothing(mode: str):
    """A third as many events more: the mean would be learned as 0.144 and 0.188 from events times the threshold."""
    sensor = learn(model(learn_mean_threshold=True), with_noise(recorded().index, 20.0), steps=900, mode=mode)
    assert float(sensor.contrast_thresholds[0]) == pytest.approx(0.2, rel=0.05)


def test_the_leak_rate_is_learned():
    sensor = learn(model(learn_leak_rate=True), recorded(leak_rate=2.0).index)
    assert float(sensor.leak_rate) == pytest.approx(2.0, rel=0.05)


def test_the_cutoff_frequency_is_learned():
    sensor = learn(model(learn_cutoff_frequency=True), recorded(cutoff_frequency=60.0).index)
    assert sensor.cutoff_frequency == pytest.approx(60.0, rel=0.1)


def test_rendered_slopes_tell_the_cutoff_frequency_from_noisy_rates():
    """Noise of what is multiplied draws a least-squares estimate to 0, but not one with an instrument."""
    generator = torch.Generator().manual_seed(0)

    def with_noise(batch: EventBatch) -> EventBatch:
        assert batch.rates is not None
        noise = batch.rates.std() * torch.randn(batch.rates.shape, generator=generator)
        return replace(batch, rates=batch.rates + noise)

    def with_slopes(batch: EventBatch) -> EventBatch:
        slopes = [
            (brightness(batch.pixels, times + 10_000).log() - brightness(batch.pixels, times - 10_000).log()) / 2e-5
            for times in (batch.start, batch.end)
        ]
        return replace(with_noise(batch), slopes=torch.stack(slopes, dim=-1))

    index, learned = recorded(cutoff_frequency=60.0).index, {}
    for told in (with_noise, with_slopes):
        sensor = learn(model(learn_cutoff_frequency=True), index, mode="partner", told=told)
        learned[told] = sensor.cutoff_frequency
    assert learned[with_slopes] == pytest.approx(60.0, rel=0.15)
    assert learned[with_noise] > 90.0


def test_slopes_move_nothing_but_the_gradient_of_the_delay():
    sensor = model(learn_cutoff_frequency=True, cutoff_frequency=40.0)
    batch = Drawn(recorded(cutoff_frequency=60.0).index, 2, "partner").batch(sensor)
    other = replace(batch, slopes=torch.randn(len(batch), 2, dtype=torch.float64))
    lags = [sensor.lag(*seen(sensor, told), told) for told in (batch, other)]
    torch.testing.assert_close(*lags, rtol=0, atol=0)
    delay = sensor.get_param_groups()["bandwidth"]
    gradients = [torch.autograd.grad(lag.sum(), delay)[0] for lag in lags]
    assert gradients[0] != gradients[1]
    assert other.subset(other.on > 0).slopes is not None


LAGS: dict[str, tuple[float, dict[str, Any], bool, bool]] = {
    "small": (0.04, {"learn_cutoff_frequency": True, "least_delay": 0.05}, False, False),
    "large": (0.06, {"learn_cutoff_frequency": True, "least_delay": 0.05}, True, True),
    "below 0": (-0.1, {"learn_cutoff_frequency": True, "least_delay": 0.05}, False, False),
    "any, below 0": (-0.1, {"learn_cutoff_frequency": True}, True, True),
    "any": (0.001, {"learn_cutoff_frequency": True}, True, True),
    "small, with a second stage": (
        0.04, {"learn_cutoff_frequency": True, "least_delay": 0.05, "second_cutoff_frequency": 30.0}, False, True,
    ),
    "stated": (0.04, {"cutoff_frequency": 1e3 / (2 * math.pi * 0.04), "least_delay": 0.05}, False, True),
}  # fmt: skip
"""Delays (ms) of sensors, and whether they are still learned, and lag, after small ones were left out."""


@pytest.mark.parametrize("name", LAGS)
def test_a_lag_that_is_learned_to_be_small_is_left_out(name: str):
    """Also by who goes on from a checkpoint."""
    delay, settings, learns, lags = LAGS[name]
    sensor = model(**settings)
    learned = sensor.learns_lag
    if isinstance(sensor.delay, torch.nn.Parameter):
        sensor.delay.data.fill_(delay)
    said = sensor.leave_out_small_lag()
    assert (said is not None) == (learned and not learns) and (said is None or "0.05 ms" in said)
    going_on = model(**settings)
    going_on.load_state_dict(sensor.state_dict())
    for each in (sensor, going_on):
        assert (each.learns_lag, each.lags) == (learns, lags)
        assert float(torch.as_tensor(each.delay)) == pytest.approx(0.0 if learned and not learns else delay)
        assert each.leave_out_small_lag() is None


def test_a_lag_that_was_left_out_is_not_learned_again_beside_a_second_stage():
    sensor = model(learn_cutoff_frequency=True, least_delay=0.05, second_cutoff_frequency=30.0)
    torch.as_tensor(sensor.delay).data.fill_(0.04)
    batch = Drawn(recorded(cutoff_frequency=60.0).index, 0).batch(sensor)
    start, end = seen(sensor, batch)
    assert sensor.lag(start, end, batch).requires_grad
    sensor.leave_out_small_lag()
    assert sensor.lags and not sensor.lag(start, end, batch).requires_grad


def test_a_sensor_that_has_no_lag_loses_it_and_one_that_has_keeps_it():
    for cutoff, lags in ((0.0, False), (400.0, True)):
        sensor = learn(
            model(learn_cutoff_frequency=True, least_delay=0.05), recorded(cutoff_frequency=cutoff).index, 200
        )
        sensor.leave_out_small_lag()
        assert sensor.lags == lags, sensor.delay


def test_the_refractory_period_is_learned():
    index = recorded(refractory_period=8_000_000).index
    sensor = learn(model(refractory_period_ns=6_000_000, learn_refractory_period=True), index)
    assert sensor.log_refractory_period is not None
    assert float(sensor.log_refractory_period.exp()) == pytest.approx(8e6, rel=0.02)


def test_the_response_is_learned():
    """A logarithm with an offset that is large, from one that has nearly none; thresholds tell the unit."""
    index = recorded(response="logarithm:0.2", contrast_thresholds=(0.1, 0.1)).index
    sensor = learn(model(learn_response=True, learn_mean_threshold=True), index, steps=1200)
    levels = torch.linspace(0.07, 0.7, 50, dtype=torch.float64)
    learned = sensor.response(levels).detach() / float(sensor.mean_threshold)
    true = torch.log(levels + 0.2) / 0.1
    difference = learned - true
    assert float(difference.std() / true.std()) < 0.03
    before = model().response(levels)
    assert float((before / before.std() - true / true.std()).std()) > 0.1


def test_thresholds_of_single_pixels_are_learned():
    made = recorded(threshold_spread=0.06)
    sensor = learn(model(learn_threshold_map=True), made.index, steps=200)
    assert sensor.threshold_map is not None
    for polarity in range(2):
        found = sensor.threshold_map.deviations[:, polarity].numpy()
        assert np.corrcoef(found, made.thresholds[polarity])[0, 1] > 0.95
    assert sensor.threshold_map.spread.tolist() == pytest.approx([0.06, 0.06], rel=0.3)


@pytest.mark.parametrize("settings", [{}, {"leak_rate": 1.0}, {"contrast_thresholds": (0.234, 0.166)}], ids=str)
def test_events_alone_tell_how_far_the_thresholds_of_a_pixel_differ(settings: dict[str, Any]):
    made = recorded(threshold_spread=0.06, **settings)
    difference, variance = threshold_differences(made.index, settings.get("contrast_thresholds", (0.2, 0.2)), 0.0)
    deviations = made.thresholds / made.thresholds.mean(1, keepdims=True) - 1.0
    expected = deviations[0] - deviations[1]
    assert np.corrcoef(difference, expected)[0, 1] > 0.9
    assert 0.3 < np.sqrt(np.mean((difference.numpy() - expected) ** 2 / variance.numpy())) < 2.0


def test_a_map_solves_what_it_observed_with_what_was_known_before():
    """Of single pixels, by NumPy's least squares; of one of which nothing is known or seen, nothing is said."""
    generator = np.random.default_rng(4)
    known, variance = np.array([0.08, -0.02, 0.0]), np.array([1e-4, 1e-2, np.inf])
    on, off = generator.integers([[[3]], [[1]]], [[[9]], [[3]]], (2, 2, SOLVED_EVERY))
    residual = 0.1 * generator.standard_normal((2, SOLVED_EVERY))
    solver = ThresholdMap(3)
    solver.start_from(torch.from_numpy(known).float(), torch.from_numpy(variance).float())
    start, spread = solver.deviations.clone(), solver.spread.clone()
    assert float(start[0] @ torch.tensor([1.0, -1.0])) > 0.03 and solver.deviations[2].tolist() == [0.0, 0.0]
    solver.deviations.zero_()  # which weighs residuals
    for step in range(SOLVED_EVERY):
        pixels = torch.arange(2)
        ups, downs, left = (torch.from_numpy(column[:, step]) for column in (on, off, residual.astype(np.float32)))
        solver.observe(pixels, ups, downs, left, (1.0, 1.0))
    weights = np.arange(1, SOLVED_EVERY + 1) / SOLVED_EVERY
    running, found, errors = 1.0, [], []
    for step in range(SOLVED_EVERY):
        running += ((residual[:, step] ** 2).mean() - running) / (step + 1)
        weights[step] /= np.sqrt(max(running, 1e-6))
    for pixel in range(2):
        rows = np.stack([on[pixel], -off[pixel]], axis=1) * weights[:, None]
        ridge = np.diag(1.0 / spread.double().numpy())
        difference = np.array([[1.0, -1.0]]) / np.sqrt(variance[pixel])
        right = [residual[pixel] * weights, known[pixel : pixel + 1] / np.sqrt(variance[pixel]), np.zeros(2)]
        equations = np.concatenate([rows, difference, ridge])
        found.append(np.linalg.lstsq(equations, np.concatenate(right), rcond=None)[0])
        errors.append(np.linalg.inv(equations.T @ equations).diagonal())
    expected = np.array(found) - np.mean(found, axis=0)
    np.testing.assert_allclose(solver.deviations[:2].numpy(), expected, atol=1e-4)
    expected = np.sqrt(np.mean(expected**2 + errors, axis=0))
    assert expected[1] > 1.05 * expected[0], "the thresholds of the rarer events are known worse"
    np.testing.assert_allclose(solver.spread.numpy(), expected, rtol=1e-3)


def test_pixels_that_are_alike_stay_so():
    sensor = learn(model(learn_threshold_map=True), recorded().index, steps=200)
    assert sensor.threshold_map is not None
    assert float(sensor.threshold_map.deviations.abs().max()) < 0.01


def test_a_map_goes_on_from_where_it_was_stored():
    """It is solved at the same steps, and is the same, as one that was never stored."""
    generator = torch.Generator().manual_seed(3)
    whole = model(learn_threshold_map=True).threshold_map
    assert whole is not None
    going_on = whole
    for number in range(120):
        pixels = torch.randint(PIXELS, (64,), generator=generator)
        ones = torch.ones(64, dtype=torch.long)
        residual = 0.1 * torch.randn(64, generator=generator)
        if number == 70:
            going_on = model(learn_threshold_map=True).threshold_map
            assert going_on is not None
            going_on.load_state_dict(whole.state_dict())
        for each in {whole, going_on}:
            each.observe(pixels, ones, 0 * ones, residual, (1.0, 1.0))
    assert going_on is not whole and whole.deviations.any()
    torch.testing.assert_close(going_on.deviations, whole.deviations, rtol=0, atol=0)


def test_a_residual_that_is_not_finite_teaches_nothing():
    taught, other = (model(learn_threshold_map=True).threshold_map for _ in range(2))
    assert taught is not None and other is not None
    pixels, ones = torch.arange(4), torch.ones(4, dtype=torch.long)
    taught.observe(pixels, ones, 0 * ones, torch.tensor([0.1, torch.nan, torch.inf, 0.2]), (1.0, 1.0))
    other.observe(pixels, ones * torch.tensor([1, 0, 0, 1]), 0 * ones, torch.tensor([0.1, 0.0, 0.0, 0.2]), (1.0, 1.0))
    assert taught.products[0, 3] > 0.0
    torch.testing.assert_close(taught.products, other.products)


def test_what_a_lag_hides_is_found_from_the_rates_of_events():
    """Changes of brightness between events of a slow pixel, on average within a tenth of a threshold."""
    sensor = model(cutoff_frequency=60.0)
    batch = Drawn(recorded(cutoff_frequency=60.0).index, 1).batch(sensor)
    fired = batch.fired
    errors = {}
    for name, considered in {"with": sensor, "without": model()}.items():
        change = brightness_change(*seen(considered, batch), batch, considered)[fired]
        errors[name] = float((change - considered.measured_change(batch)[fired]).square().mean().sqrt()) / 0.2
    assert errors["with"] < 0.1 < 0.4 < errors["without"]


@pytest.mark.parametrize(("windows", "largest"), [(False, 0.56), (True, 0.7)], ids=["any instants", "windows"])
def test_a_lag_hides_nothing_of_pairs_that_begin_at_no_event(windows: bool, largest: float):
    """Rates make up for the lag: the error is that of a sensor without lag, half a threshold and more."""
    drawn = {}
    for cutoff in (None, 60.0):
        settings = {} if cutoff is None else {"cutoff_frequency": cutoff}
        events = recorded(**settings).index, 0, int(SECONDS * 1e9) - 1, 100_000_000
        draw = AccumulationSampler(*events).sample if windows else InstantPairSampler(*events).sample_chains
        drawn[cutoff] = draw(4000, torch.Generator().manual_seed(0), 0)
    errors = {}
    for cutoff, considered in ((None, None), (60.0, 60.0), (60.0, None)):
        sensor, batch = model(cutoff_frequency=considered), drawn[cutoff]
        change = brightness_change(*seen(sensor, batch), batch, sensor) - sensor.measured_change(batch)
        errors[cutoff, considered] = float(change.square().mean().sqrt()) / 0.2
    assert errors[60.0, 60.0] < 1.1 * errors[None, None] < largest and errors[60.0, None] > 0.85, errors


def test_a_second_stage_lags_as_well():
    """Log brightness goes through SciPy's low pass of first order before the slow pixel sees it."""
    times = np.arange(0, int(SECONDS * 1e9), 200_000)
    logs = np.log(brightness(torch.arange(PIXELS)[None], torch.from_numpy(times)[:, None]).numpy())
    low_pass = scipy.signal.bilinear([2 * np.pi * 30.0], [1, 2 * np.pi * 30.0], 1 / 200e-6)
    passed = logs[0] + scipy.signal.lfilter(*low_pass, logs - logs[0], axis=0)
    pictures = np.exp(passed).reshape(-1, HEIGHT, WIDTH)
    settings = SensorSettings(contrast_thresholds=(0.2, 0.2), response=RESPONSE, cutoff_frequency=300.0)
    camera = EventSensor(settings, pictures[0], 0)
    parts = [camera.advance(picture, int(time)) for picture, time in zip(pictures[1:], times[1:], strict=True)]
    parts.append(camera.finish())
    columns = (np.concatenate([getattr(part, name) for part in parts]) for name in "xytp")
    index = EventIndex.from_events(Events(*columns), WIDTH, HEIGHT)

    errors = {}
    for stages in (1, 2):
        considered = model(cutoff_frequency=300.0, second_cutoff_frequency=30.0 if stages == 2 else None)
        batch = Drawn(index, 1).batch(considered)
        change = brightness_change(*seen(considered, batch), batch, considered) - considered.measured_change(batch)
        errors[stages] = float(change[batch.fired].square().mean().sqrt()) / 0.2
    assert errors[2] < 0.1 < 0.2 < errors[1], errors
    assert model(second_cutoff_frequency=30.0).lags


PARTS: dict[str, dict[str, Any]] = {
    "threshold_ratio": {"learn_threshold_ratio": True},
    "mean_threshold": {"learn_mean_threshold": True},
    "refractory_period": {"learn_refractory_period": True, "refractory_period_ns": 3_000_000},
    "response": {"learn_response": True},
    "bandwidth": {"learn_cutoff_frequency": True, "cutoff_frequency": 40.0},
    "leak_rate": {"learn_leak_rate": True, "leak_rate": 0.5},
}


@pytest.mark.parametrize("name", PARTS)
def test_gradients_are_those_of_finite_differences(name: str):
    sensor = model(**PARTS[name])
    ((found, (parameter,)),) = sensor.get_param_groups().items()
    assert found == name
    index = recorded(cutoff_frequency=60.0, refractory_period=3_000_000, leak_rate=1.0).index
    batch = Drawn(index, 2, "partner").batch(sensor)

    def loss() -> Tensor:
        change = brightness_change(*seen(sensor, batch), batch, sensor) - sensor.measured_change(batch)
        return change.square().mean()

    (gradient,) = torch.autograd.grad(loss(), parameter)
    direction = torch.linspace(1.0, 2.0, parameter.numel(), dtype=torch.float64).view_as(parameter)
    with torch.no_grad():
        step = 1e-3 * direction
        parameter += step
        above = loss()
        parameter -= 2.0 * step
        slope = (above - loss()) / 2e-3
    assert float((gradient * direction).sum()) == pytest.approx(float(slope), rel=1e-3)


@pytest.mark.parametrize("name", PARTS)
def test_what_is_learned_is_stored(name: str):
    sensor, other = model(**PARTS[name]), model(**PARTS[name])
    with torch.no_grad():
        for parameter in sensor.parameters():
            parameter += 0.1
    other.load_state_dict(sensor.state_dict())
    for a, b in zip(sensor.parameters(), other.parameters(), strict=True):
        torch.testing.assert_close(a, b)


def test_the_errors_of_learning_are_those_of_estimates_from_many_recordings():
    """Events are at random times; estimated are their rate, the balance of their polarities, and the time of a step."""
    generator = np.random.default_rng(5)
    pixels, seconds, rate = 40, 2.0, 30.0
    rates, ratios, found = [], [], []
    for _ in range(200):
        counts = generator.poisson(rate * seconds, pixels)
        times = np.sort(generator.uniform(0.0, seconds * 1e9, counts.sum())).astype(np.int64)
        pixel = generator.permutation(np.repeat(np.arange(pixels), counts))
        is_on = generator.random(len(times)) < 0.5
        events = Events(pixel, np.zeros_like(pixel), times, np.where(is_on, 1, -1))
        index = EventIndex.from_events(events, pixels, 1)
        found.append({measure: measure(index) for measure in (ratio_error, leak_rate_error, delay_error)})
        rates.append(len(times) / (pixels * seconds))
        ratios.append(np.log(is_on.sum() / (~is_on).sum()))
    mean = {name: np.mean([errors[name] for errors in found]) for name in found[0]}
    assert mean[leak_rate_error] == pytest.approx(np.std(rates), rel=0.15)
    assert mean[ratio_error] == pytest.approx(np.std(ratios), rel=0.15)
    median = 1e3 * np.log(2.0) / rate  # ms, of an exponential distribution
    assert mean[delay_error] == pytest.approx(median / np.sqrt(rate * seconds * pixels), rel=0.1)
