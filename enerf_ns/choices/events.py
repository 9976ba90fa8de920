"""Rows of the events: the pairs that are drawn at each step."""

from __future__ import annotations

import math

from enerf_ns.choices.scene import Scene
from enerf_ns.dataparsers.inspection.sensor_survey import FASTER_EVENTS
from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.dataparsers.sensor_estimates.estimates import noise_per_event, scene_variance, share_closer
from enerf_ns.events.statistics import silent_share
from enerf_ns.sensor.refractory_period import chosen_refractory_period
from enerf_ns.sensor.thresholds import balanced_thresholds
from enerf_ns.supervision.event_supervision import EVENT_LOSSES

HELD_OUT_SPANS = 8
"""Number of spans of time whose events are kept from training."""

DEFAULT_SILENCE_MS = 20.0
DEFAULT_WINDOW_MS = 60.0

LONGEST_ACCUMULATION = 0.05
"""Longest window of accumulated events, as a share of the recording's time: EventNeRF's 50 of 1000 views."""

LONGEST_DISTANCE = 10
"""Most events that are chosen for a partner to lie ahead; at least 2."""

MOST_NOISE = 0.1
"""Largest variance (squared thresholds) that noise may add to the events of a pair at the largest distance."""

MOST_NOISE_BETWEEN, NOISE_OF_SCENE = 1.0, 0.125
"""Largest variance (squared thresholds) that noise may add to the events between any two instants, whose brightness is
known little better; and the same as a share of the variance of the brightness that a pixel sees, if that is more."""

MOST_NOISE_COMPLETED = 0.4
"""Largest variance (squared thresholds) that noise may add with each event to sums that are completed by what pixels
missed. With more, the sums tell less than each event with the next."""

LEAST_APART = 0.1
"""Shortest time (ms) between any two instants. Between closer ones, errors are so small that, balanced by them, these
pairs would outweigh all others."""

SMALLEST_SILENT_SHARE = 0.01
"""Smallest share of the time for which pixels must be silent for silent pixels to be searched. If pixels are silent for
less, the search finds hardly any."""


def held_out_events(scene: Scene) -> None:
    """Are events kept from training?"""
    share = scene.config.datamanager.held_out_events
    value = f"{100 * share:.3g} % of the time, in {HELD_OUT_SPANS} spans" if share else ""
    why = "the field is scored on them" if share else "the correlation of events is measured over training pairs"
    scene.row("held-out events", bool(share), value, why, "datamanager.held_out_events")


def missed_changes(scene: Scene) -> None:
    """Is what pixels missed while they were blind added to the sums of their events?

    Raises:
        FlagError: It is to be added for another time than that for which pixels are known to be blind.
    """
    name, blind = "datamanager.completed_refractory_ns", scene.once(blind_for)
    noise, is_learned = scene.once(_noise_of_completed), scene.config.model.sensor.learn_refractory_period
    known = 0 if is_learned else blind
    completed = scene.use(name, lambda: known if noise < MOST_NOISE_COMPLETED else 0)
    if completed not in (0, known):
        expected = f"0, or the refractory period of {known}," if known else "0"
        raise FlagError(
            f"--pipeline.datamanager.completed-refractory-ns is {completed}, but {expected} was expected, since sums "
            "are completed for a period that is known and not learned; leave it out."
        )
    kept = bool(completed)
    if not blind:
        why = "pixels are not known to be blind after an event"
    elif is_learned:
        why = "the refractory period is learned, and completed sums would keep the one that it starts from"
    elif not (scene.use_events and scene.defaults.instants):
        why = "the method does not use them" if scene.use_events else "the field does not learn from events"
    elif math.isinf(noise):
        why = "they are not identifiable: events are too few, or some come within the refractory period"
    else:
        why = (
            f"the rates of events tell them; noise then adds {noise:.2g} squared thresholds an event, "
            f"{'less' if kept else 'more'} than {MOST_NOISE_COMPLETED:g}"
        )
    value = "added to the sums of events" if kept else ""
    scene.row("missed changes", kept, value, scene.why(name, why), name)


def event_pairs(scene: Scene) -> None:
    """Which pairs of events are drawn?"""
    defaults, hidden = scene.defaults, scene.once(hides_changes)
    mode = scene.use("datamanager.pair_mode", lambda: "successor" if hidden else "partner")
    both = defaults.event_pairs + defaults.silent_pairs
    given = scene.config.datamanager.event_pairs
    alone = mode == "partner" and defaults.instants and scene.use_events and not scene.use_frames and not hidden
    alone = alone and scene.config.datamanager.silent_pairs is None
    instants = scene.use("datamanager.instant_pairs", lambda: (given or both // 2) if alone else 0)
    usual = both - both // 2 if instants else defaults.event_pairs
    usual = defaults.noisy_pairs_beside_frames if scene.once(frames_determine_more) else usual
    pairs = scene.use("datamanager.event_pairs", lambda: usual)
    distance = scene.use("datamanager.max_pair_distance", lambda: scene.once(_distance_by_noise) or LONGEST_DISTANCE)
    longest = LONGEST_ACCUMULATION * 1e-6 * (scene.recording.span[1] - scene.recording.span[0])
    window = scene.use("datamanager.window_ms", lambda: longest if mode == "accumulated" else DEFAULT_WINDOW_MS)
    if not scene.use_events:
        supervision = scene.config.datamanager.supervision
        scene.row("event loss", False, "", f"supervision is {supervision}", "datamanager.supervision")
        return
    values = {
        "successor": "each event with the pixel's next",
        "partner": f"each event with one of the pixel's next {distance}",
        "window": f"each event with the pixel's last in {window:g} ms",
        "accumulated": f"the sum of a pixel's events over up to {window:g} ms",
    }
    why = "the field learns from events"
    if scene.once(_distance_by_noise) is not None:
        why += f"; their noise adds {scene.once(event_noise):.2g} squared thresholds an event"
    if hidden and mode != "successor":
        why += "; pixels are blind after an event, for which only datamanager.pair-mode successor is exact"
    scene.row("event loss", True, f"{pairs} pairs a step: {values[mode]}", why, "datamanager.supervision")


def any_instants(scene: Scene) -> None:
    """Are pairs of any two instants drawn, and how far may their instants be apart?

    Raises:
        FlagError: They are to be so close that nothing changes between them.
    """
    if not scene.use_events:
        return
    name, value, pairs = "datamanager.instant_pairs", "", scene.value("datamanager.instant_pairs")
    apart = scene.use("datamanager.instants_apart_ms", lambda: _longest_worth_summing(scene) if pairs else 0.0)
    if pairs and scene.given("datamanager.instants_apart_ms") is not None and apart < LEAST_APART:
        raise FlagError(
            f"--pipeline.datamanager.instants-apart-ms is {apart:g}, but {LEAST_APART:g} or more was expected, since "
            "nothing changes in less; to draw no such pairs, give --pipeline.datamanager.instant-pairs 0."
        )
    if pairs:
        value = f"{pairs} pairs a step, up to {apart:.3g} ms apart, whatever fired between them"
    why = "they constrain what a pixel sees between edges"
    if scene.once(hides_changes):
        why = "pixels that are blind after an event miss changes between their events"
    elif scene.use_frames:
        why = "frames constrain what lies between edges"
    elif not scene.defaults.instants:
        why = "the method does not use them"
    elif not pairs:
        why = "other pairs are set by flag"
    scene.row("any instants", bool(pairs), value, scene.why(name, why), name)


def silent_pixels(scene: Scene) -> None:
    """Does the field learn from pixels that stay silent, and by which loss?

    Raises:
        FlagError: The event loss does not exist.
    """
    defaults, name = scene.defaults, "datamanager.silent_pairs"
    loss = scene.use("model.event_loss", lambda: defaults.event_loss)
    if loss not in EVENT_LOSSES:
        raise FlagError(f"--pipeline.model.event-loss is {loss!r}, but one of {', '.join(EVENT_LOSSES)} was expected.")
    scene.use("model.no_event_loss_weight", lambda: defaults.no_event_loss_weight)
    scene.use("model.no_event_margin", lambda: defaults.no_event_margin)
    silence = scene.use("datamanager.silence_ms", lambda: DEFAULT_SILENCE_MS)
    if not scene.use_events:
        scene.use(name, lambda: 0)
        scene.row("silent pixels", False, "", "the field does not learn from events", "datamanager.supervision")
        return
    share = silent_share(scene.index, round(silence * 1e6))
    between = scene.config.datamanager.silent_mode == "intervals"
    instants = scene.value("datamanager.instant_pairs")
    usual = defaults.silent_pairs_beside_frames if scene.use_frames else defaults.silent_pairs
    if instants or not (between or share > SMALLEST_SILENT_SHARE):
        usual = 0
    if scene.once(frames_determine_more):
        usual = usual * defaults.noisy_pairs_beside_frames // defaults.event_pairs
    pairs = scene.use(name, lambda: usual)
    value = f"{pairs} pairs a step" if pairs else "they are not searched"
    why = f"pixels are silent for {silence:g} ms and longer during {100 * share:.1f} % of the time"
    if between:
        value += ", between successive events" if pairs else ""
        why = "all pixels are silent between their events"
    if not defaults.silent_pairs:
        why = "the method does not use them"
    elif instants:
        why = "pairs of any instants include silent ones"
    scene.row("silent pixels", bool(pairs), value, scene.why(name, why), name)


def blind_for(scene: Scene) -> int:
    """Refractory period of the sensor, ns; 0 if pixels are never blind."""
    return scene.once(chosen_refractory_period)[0]


def hides_changes(scene: Scene) -> bool:
    """Whether pixels miss changes while they are blind that are not added to the sums of their events."""
    return bool(scene.once(blind_for)) and not scene.value("datamanager.completed_refractory_ns")


def event_noise(scene: Scene) -> float:
    """Variance (squared mean thresholds) that noise adds to the sum of a pixel's events with each event."""
    completed = scene.value("datamanager.completed_refractory_ns")
    return noise_per_event(scene.index, balanced_thresholds(scene.index), completed).value


def _noise_of_completed(scene: Scene) -> float:
    """The variance of `event_noise`, of sums that are completed by what pixels missed; infinity if it is unknown, or if
    events contradict the refractory period."""
    blind = scene.once(blind_for)
    if not (blind and scene.use_events and scene.defaults.instants):
        return math.inf
    if share_closer(scene.index, blind) > FASTER_EVENTS:
        return math.inf
    found = noise_per_event(scene.index, balanced_thresholds(scene.index), blind)
    return found.value if math.isfinite(found.error) else math.inf


def _distance_by_noise(scene: Scene) -> int | None:
    """Events that a partner may lie ahead, by their noise; None if pairs are drawn otherwise."""
    if scene.value("datamanager.pair_mode") != "partner" or not scene.learns_sensor:
        return None
    return max(2, min(LONGEST_DISTANCE, round(MOST_NOISE / max(scene.once(event_noise), 1e-9))))


def frames_determine_more(scene: Scene) -> bool:
    """Whether the field learns from frames beside events that are noisy."""
    distance = scene.once(_distance_by_noise)
    return scene.use_frames and distance is not None and distance < LONGEST_DISTANCE


def _longest_worth_summing(scene: Scene) -> float:
    """Time (ms) over which the noise of a pixel's events stays below the largest that is worth it; at most the whole
    recording."""
    index, noise = scene.index, scene.once(event_noise)
    first, last = index.span
    a_pixel = len(index) / max(int((index.offsets.diff() > 0).sum()), 1)
    completed = scene.value("datamanager.completed_refractory_ns")
    variance = scene_variance(index, balanced_thresholds(index), noise, completed)
    most = max(MOST_NOISE_BETWEEN, NOISE_OF_SCENE * variance)
    share = min(max(2.0, most / max(noise, 1e-9)) / a_pixel, 1.0)
    return max(1e-6 * (last - first) * share, 1e-6)
