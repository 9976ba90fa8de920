"""The experiments of `enerf bench`: what is learnt from what, on which recordings, and what is told of it."""

from __future__ import annotations

import json
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from enerf_ns.bench import published
from enerf_ns.bench.experiment import Experiment, Row, Sequence
from enerf_ns.bench.validation import CHOSEN_ON, ONLY_SCORED, REAL
from enerf_ns.choices.presets import SPIRAL_1
from enerf_ns.sensor.sensor_model import SensorModelConfig
from enerf_ns.supervision.published_losses import PUBLISHED_LOSSES

if TYPE_CHECKING:
    from enerf_ns.simulator.event_sensor import SensorSettings

PARSER, DATA, MODEL = "pipeline.datamanager.dataparser.", "pipeline.datamanager.", "pipeline.model."
SENSOR = MODEL + "sensor."


FRAMES = {DATA + "supervision": "frames"}
SHARP = {PARSER + "train_frames": "sharp"}
EVENTS_AND_FRAMES = {DATA + "supervision": "events+frames"}
ONE_INSTANT = {DATA + "exposure_samples": 1}
"""Takes blurred frames for sharp ones."""

PAPER_LOSS = {
    MODEL + "event_loss": "squared",
    MODEL + "no_event_margin": 1.0,
    DATA + "pair_mode": "successor",
    DATA + "silent_pairs": 0,
}
"""The paper's event loss, without no-event loss, on pairs of successors."""

SILENT_PAIRS = 341
PAPER_C = 0.2
"""Threshold of the simulated sequences. Losses here count changes of log brightness in thresholds, those of the paper
do not: of its weights, that of the no-event loss is divided by C, and that of frames by C^2."""


def _no_event_loss(weight: float) -> dict[str, Any]:
    """The paper's no-event loss with the paper's weight."""
    on = {DATA + "silent_pairs": SILENT_PAIRS, MODEL + "no_event_loss_weight": weight / PAPER_C}
    return {**PAPER_LOSS, **on} if weight else PAPER_LOSS


FORCED_ON: dict[str, Any] = {
    DATA + "silent_pairs": SILENT_PAIRS,
    MODEL + "sensor.refractory_period_ns": 1000,
    MODEL + "num_channels": 3,
    MODEL + "view_direction": True,
    MODEL + "sampling": "proposal",
    MODEL + "num_levels": 16,
    MODEL + "opacity_loss_weight": 1.0,
    MODEL + "brightness": "exponential",
}
"""What forces each part of the method on that a scene may do without."""

LEFT_OUT: dict[str, dict[str, Any]] = {
    "silent-pixels": {DATA + "silent_pairs": 0},
    "refractory-period": {MODEL + "sensor.refractory_period_ns": 0},
    "colour": {MODEL + "num_channels": 1},
    "view-direction": {MODEL + "view_direction": False},
    "proposal-network": {MODEL + "sampling": "uniform", MODEL + "num_samples": 64},
    "16-levels": {MODEL + "num_levels": 10},
    "opacity-loss": {MODEL + "opacity_loss_weight": 0.0},
    "dynamic-range": {MODEL + "brightness": "log-sigmoid"},
}
"""What leaves each of them out; in place of the proposal network are 64 even samples."""

NOTHING_LEARNED: dict[str, Any] = {
    SENSOR + setting.name: False for setting in fields(SensorModelConfig) if setting.name.startswith("learn_")
}

FIXED_SENSOR: dict[str, Any] = {
    SENSOR + "contrast_thresholds": (0.25, 0.25),
    SENSOR + "response": "linlog",
    SENSOR + "refractory_period_ns": 0,
    **NOTHING_LEARNED,
    DATA + "max_pair_distance": 10,
    MODEL + "level_loss_weight": 0.0,
}
"""Takes a sensor of which nothing is known for an ideal one, and learns nothing of it, nor holds the level of
brightness."""


def known_sensor(sensor: SensorSettings) -> dict[str, Any]:
    """What states a simulated sensor, as far as the method has settings for it."""
    return {
        SENSOR + "contrast_thresholds": tuple(sensor.contrast_thresholds),
        SENSOR + "response": sensor.response,
        SENSOR + "refractory_period_ns": sensor.refractory_period,
        SENSOR + "leak_rate": sensor.leak_rate,
        SENSOR + "cutoff_frequency": sensor.cutoff_frequency or None,
        **NOTHING_LEARNED,
    }


ROWS: dict[str, Row] = {
    "nerf-sharp": Row({**FRAMES, **SHARP}),
    "nerf-blurred": Row({**FRAMES, **ONE_INSTANT}),
    "deblur": Row(FRAMES),
    "e2vid": Row({**FRAMES, **ONE_INSTANT}, reconstruction="e2vid"),
    "filter": Row({**FRAMES, **ONE_INSTANT}, reconstruction="filter"),
    "events": Row(),
    "events+blurred": Row(EVENTS_AND_FRAMES),
    "events+blurred-one-instant": Row({**EVENTS_AND_FRAMES, **ONE_INSTANT}),
    "paper-loss": Row(PAPER_LOSS),
    "normalised-loss": Row({**PAPER_LOSS, MODEL + "event_loss": "normalised"}),
    "windows-60ms": Row({**PAPER_LOSS, DATA + "pair_mode": "window", DATA + "window_ms": 60.0}),
    "no-event-loss": Row(_no_event_loss(1.0)),
    **{f"no-event-{weight}": Row(_no_event_loss(weight)) for weight in (0, 10, 100, 1000)},
    **{
        f"frame-weight-{weight}": Row(
            {**EVENTS_AND_FRAMES, **ONE_INSTANT, **PAPER_LOSS, MODEL + "frame_loss_weight": weight / PAPER_C**2}
        )
        for weight in (0.01, 0.1, 1, 10)
    },
    "levels-14/16": Row(factors={MODEL + "num_levels": 14 / 16, MODEL + "max_res": 1}),
    "levels-24/16": Row(factors={MODEL + "num_levels": 24 / 16, MODEL + "max_res": 1}),
    "resolution/12": Row(factors={MODEL + "num_levels": 1, MODEL + "max_res": 1 / 12}),
    "resolution-x12": Row(factors={MODEL + "num_levels": 1, MODEL + "max_res": 12}),
    "events-30096-pairs": Row({DATA + "event_pairs": 30096}),
    "successor-pairs": Row({DATA + "pair_mode": "successor"}),
    "window-pairs": Row({DATA + "pair_mode": "window"}),
    "without-instants": Row({DATA + "instant_pairs": 0}),
    "no-silent-pairs": Row({DATA + "silent_pairs": 0}),
    "uniform-samples": Row({MODEL + "sampling": "uniform", MODEL + "num_samples": 64}),
    "no-distortion-loss": Row({MODEL + "distortion_loss_weight": 0.0}),
    "view-direction": Row({MODEL + "view_direction": True}),
    "16-levels-2^19": Row({MODEL + "num_levels": 16, MODEL + "log2_table_size": 19}),
    **{f"{number}-samples": Row({MODEL + "num_samples": number}) for number in (16, 32)},
    **{f"{number}-proposal-samples": Row({MODEL + "num_proposal_samples": number}) for number in (32, 64)},
    **{
        f"{number}-pairs": Row({DATA + "event_pairs": number, DATA + "silent_pairs": number // 3})
        for number in (512, 2048)
    },
    **{f"pairs-up-to-{number}-events": Row({DATA + "max_pair_distance": number}) for number in (5, 30)},
    "16-levels": Row({MODEL + "num_levels": 16}),
    "contraction": Row({MODEL + "contraction": True}),
    "no-contraction": Row({MODEL + "contraction": False}),
    **{name: Row(method=name) for name in PUBLISHED_LOSSES},
    "everything-forced-on": Row(FORCED_ON),
    **{f"without-{part}": Row({**FORCED_ON, **off}) for part, off in LEFT_OUT.items()},
    "everything-left-out": Row({name: value for off in LEFT_OUT.values() for name, value in off.items()}),
    "fixed": Row(FIXED_SENSOR),
    "learned": Row(),
    "known": Row(known_sensor=True),
}
"""Rows by name; two experiments that have one of the same name share its runs."""

NEAR = (0.9, 2.6)
"""Metres between which the near things of the unbounded scene lie."""

UNBOUNDED_SCENE = {
    "parts": [
        {"shape": "plane", "size": [60, 50], "position": [-14, 30, 0], "rotation": [90, 0, 0], "texture": "mosaic"},
        {"shape": "plane", "size": [700, 500], "position": [0, 300, 0], "rotation": [90, 0, 0], "texture": "bricks"},
        {"shape": "box", "size": [0.5, 0.4, 0.6], "position": [-0.4, 1.5, -0.2], "texture": "bricks"},
        {"shape": "ball", "size": 0.45, "position": [0.45, 1.3, 0.15], "texture": "clouds"},
        {"shape": "box", "size": [0.3, 0.3, 0.9], "position": [0.15, 1.9, -0.1], "texture": "mosaic"},
    ],
    "camera": [0, 0, 0],
    "target": [0, 2, 0],
    "light": None,
}
UNBOUNDED_PATH = "0 -0.25 0 0 0 2 0\n0.25 -0.08 0 0.06 0 2 0\n0.5 0.1 0 -0.05 0 2 0\n0.7 0.25 0 0.03 0 2 0\n"

FIVE = ("spiral1", "spiral2", "shake-moon1", "shake-moon2", "shake-carpet1")

SENSORS: dict[str, Sequence] = {
    "ideal": Sequence("shapes", sensor={"contrast_thresholds": (0.2, 0.2)}),
    "ratio": Sequence("shapes", sensor={"contrast_thresholds": (0.28, 0.2)}),
    "spread": Sequence("shapes", sensor={"threshold_spread": 0.06}),
    "leak": Sequence("shapes", sensor={"leak_rate": 1.0}),
    "shot-noise": Sequence("shapes", sensor={"shot_noise_rate": 5.0}),
    "bandwidth": Sequence("shapes", sensor={"cutoff_frequency": 100.0}),
    "jitter": Sequence("shapes", sensor={"timestamp_jitter": 500_000.0}),
    "medium": Sequence(
        "shapes", simulation={"duration": 4.0}, sensor={"threshold_spread": 0.03, "refractory_period": 8_000_000}
    ),
    "hard": Sequence(
        "shapes", simulation={"duration": 4.0}, sensor={"threshold_spread": 0.06, "refractory_period": 25_000_000}
    ),
    "faults": Sequence(
        "shapes",
        sensor={"contrast_thresholds": (0.28, 0.2), "threshold_spread": 0.06, "refractory_period": 8_000_000},
    ),
    "all-faults": Sequence(
        "shapes",
        simulation={"duration": 2.0},
        sensor={
            "contrast_thresholds": (0.28, 0.2),
            "threshold_spread": 0.06,
            "refractory_period": 8_000_000,
            "leak_rate": 0.5,
            "shot_noise_rate": 2.0,
            "cutoff_frequency": 200.0,
            "timestamp_jitter": 200_000.0,
        },
    ),
}
"""One recording for each fault of a sensor, then several together: medium and hard are the spreads and refractory
periods of Robust e-NeRF (Low and Lee, ICCV 2023)."""

SEQUENCES: dict[str, Sequence] = {
    **{name: Sequence(name, preset=name) for name in FIVE},
    "spiral1-sparse": Sequence("spiral1", preset="spiral1-sparse"),
    "spiral1-more-sparse": Sequence("spiral1", preset="spiral1-more-sparse"),
    "spiral1-6views": Sequence(
        "spiral1",
        preset="spiral1",
        changes={PARSER + "train_frame_indices": tuple(SPIRAL_1[view] for view in (0, 6, 12, 17, 23, 29))},
    ),
    "shapes": Sequence("shapes"),
    "unbounded": Sequence(
        "unbounded.json",
        changes={PARSER + "depth_range": NEAR},
        simulation={"key_frames": "unbounded.txt", "num_frames": 29},
        files={"unbounded.json": json.dumps(UNBOUNDED_SCENE), "unbounded.txt": UNBOUNDED_PATH},
    ),
    **SENSORS,
    **CHOSEN_ON,
    **ONLY_SCORED,
    "recording": Sequence(),
    "slider_depth": Sequence(),
    **{name: Sequence() for name in published.UZH},
    **{name: Sequence() for name in published.EDS if name != published.MEAN},
    "mocap-1d-trans": Sequence(preset="mocap-1d-trans"),
    "mocap-desk2": Sequence(preset="mocap-desk2"),
    "mocap-desk2-6views": Sequence(preset="mocap-desk2-6views"),
}
"""Sequences by name. Presets bring the paper's frames, times and thresholds, and to enerf-paper its box and batch."""

BASELINES = (
    "nerf-sharp",
    "nerf-blurred",
    "deblur",
    "e2vid",
    "filter",
    "events",
    "events+blurred",
    "events+blurred-one-instant",
)
OF_BASELINES = (
    "nerf-sharp and nerf-blurred are the field, sampler and renderer of the method with the frame loss alone.",
    "deblur renders each frame over the poses of its exposure; the paper's row is Deblur-NeRF, which knows none.",
    "e2vid and filter reconstruct frames from the events and learn from these; filter is a complementary filter, which "
    "the paper does not have.",
    "events+blurred renders frames over their exposure; events+blurred-one-instant does not, as in the paper.",
)

EXPERIMENTS: dict[str, Experiment] = {
    "spiral": Experiment(
        "Frames, events, and both, on the spirals and with fewer views.",
        BASELINES,
        tuple(published.SPIRAL),
        published=published.SPIRAL,
        notes=OF_BASELINES,
    ),
    "shake": Experiment(
        "Frames, events, and both, by a shaking camera: mild, medium and strong blur.",
        BASELINES,
        tuple(published.SHAKE),
        published=published.SHAKE,
        notes=OF_BASELINES,
    ),
    "ablation": Experiment(
        "The paper's event loss, normalised, over windows, with no-event loss; mean over five sequences.",
        ("events", "paper-loss", "normalised-loss", "windows-60ms", "no-event-loss"),
        FIVE,
        published=published.ABLATION,
        mean=True,
        notes=(
            "events is the method as it is, the others have the paper's losses and pairs; the paper does not tell the "
            "weight of its no-event loss, which is 1 here.",
        ),
    ),
    "losses": Experiment(
        "Published losses on the same field; mean over five sequences.",
        ("events", *PUBLISHED_LOSSES),
        FIVE,
        mean=True,
    ),
    "no-event-weight": Experiment(
        "Weight of the no-event loss, in the paper's unit.",
        tuple(published.NO_EVENT_WEIGHT["shake-carpet1"]),
        ("shake-carpet1",),
        published=published.NO_EVENT_WEIGHT,
    ),
    "frame-weight": Experiment(
        "Weight of the loss on blurred frames beside events, in the paper's unit.",
        tuple(name for name in ROWS if name.startswith("frame-weight-")),
        ("shake-carpet1",),
        notes=("The paper shows pictures and no scores: large weights bring back blur, small ones lose colour.",),
    ),
    "encoding": Experiment(
        "Levels and finest resolution of the hash grid.",
        tuple(published.ENCODING["shake-carpet1"]),
        ("shake-carpet1",),
        published=published.ENCODING,
        notes=(
            "Levels and finest resolution are those chosen for the recording, times what the paper's are of its 16 "
            "levels and N_max of 6144.",
        ),
    ),
    "depth": Experiment(
        "Depth at all train and test poses, of the runs of spiral and shake.",
        BASELINES,
        FIVE,
        columns=("depth_rmse_all_poses",),
        published=published.DEPTH,
    ),
    "run-time": Experiment(
        "What a training step spends its time on, in percent.",
        ("nerf-blurred", "events", "events+blurred", "events-30096-pairs"),
        ("spiral1",),
        columns=("ms_a_step", "sample", "poses", "rays", "images", "forward_and_backward"),
        measures=("step",),
        published=published.RUN_TIME,
        notes=("The paper's step has 30096 rays, on an A40.",),
    ),
    "views": Experiment(
        "Many views against 6, of frames and of events.",
        ("nerf-blurred", "events"),
        ("spiral1", "spiral1-6views"),
        recorded=("mocap-desk2", "mocap-desk2-6views"),
        notes=("The paper compares 60 with 6 views of mocap-desk2 by pictures; --data FOLDER names that recording.",),
    ),
    "slider-depth": Experiment(
        "UZH's slider_depth (--data) beside Event-3DGS, and what events add to its frames.",
        ("nerf-blurred", "e2vid", "filter", "events", "events+blurred"),
        recorded=("slider_depth",),
        protocols=("raw", "log-affine-set"),
        columns=("psnr", "ssim", "correlation", "lpips_vgg"),
        published=published.SLIDER_DEPTH,
        source="Event-3DGS",
        notes=(
            "Event-3DGS trains on frames that E2VID made of the events, and scores views that it does not name, as "
            "they are; here every fourth frame is held out, and raw compares as it does.",
        ),
    ),
    "uzh": Experiment(
        "Other sequences of UZH's data set (--data holds their folders) beside Event-3DGS.",
        ("events",),
        recorded=tuple(published.UZH),
        protocols=("raw", "log-affine-set"),
        columns=("psnr", "ssim", "lpips_vgg"),
        published=published.UZH,
        source="Event-3DGS",
        notes=(
            "As of slider-depth: Event-3DGS does not name the views that it scores; here every fourth is held out.",
        ),
    ),
    "eds": Experiment(
        "EDS (--data holds the folders of the sequences) beside GPERT and EventSplat.",
        ("events",),
        recorded=tuple(name for name in published.EDS if name != published.MEAN),
        columns=("psnr", "ssim", "lpips", "lpips_vgg"),
        published=published.EDS,
        source="GPERT",
        notes=(
            "GPERT copied EventSplat's rows, whose LPIPS is of VGG where its own is of AlexNet, and follows Robust "
            "e-NeRF's evaluation; here the whole recording is used and every fourth frame held out.",
        ),
    ),
    "tum-vie": Experiment(
        "TUM-VIE (--data holds the folders of the sequences) beside GPERT.",
        ("events",),
        recorded=tuple(name for name in published.TUM_VIE if name != published.MEAN),
        published=published.TUM_VIE,
        source="GPERT",
        notes=("Here frames and time range are those of E-NeRF's configs; GPERT's are those of Robust e-NeRF.",),
    ),
    "validation": Experiment(
        "Recordings that differ in what matters, by which defaults are chosen and held to account.",
        ("events", "without-instants", "nerf-sharp"),
        (*CHOSEN_ON, *ONLY_SCORED),
        recorded=(REAL,),
        beside=True,
        columns=("psnr", "ssim", "event_correlation", "depth_rmse", "brightness_scale"),
        measures=("events",),
        notes=(
            f"Settings may be chosen by looking at {', '.join(CHOSEN_ON)} and {REAL}; {', '.join(ONLY_SCORED)} are "
            "only ever scored.",
            "without-instants pairs events with events, and looks at silent pixels, as all of enerf did before.",
            "nerf-sharp learns from sharp frames alone: the ceiling of the field, sampler and renderer.",
        ),
    ),
    "parts": Experiment(
        "Numerical error of the parts, which tells what limits a result: quadrature, poses, float32, brightness fit.",
        ("events",),
        ("shapes", "shake-carpet1"),
        parts=True,
    ),
    "design": Experiment(
        "What the method was chosen against, one change each, on the demo's scene or on any recording.",
        (
            "events",
            "successor-pairs",
            "window-pairs",
            "no-silent-pairs",
            "uniform-samples",
            "no-distortion-loss",
            "view-direction",
            "16-levels-2^19",
            "nerf-blurred",
            "deblur",
            "events+blurred",
            "events+blurred-one-instant",
        ),
        ("shapes",),
        recorded=("recording",),
        columns=("psnr", "ssim", "lpips", "correlation", "depth_rmse"),
    ),
    "front": Experiment(
        "What moves error against time: samples, batch, distance of pairs, levels of the hash grid.",
        (
            "events",
            "16-samples",
            "32-samples",
            "32-proposal-samples",
            "64-proposal-samples",
            "512-pairs",
            "2048-pairs",
            "pairs-up-to-5-events",
            "pairs-up-to-30-events",
            "16-levels",
        ),
        ("shapes",),
        recorded=("recording",),
        columns=("psnr", "correlation", "depth_rmse"),
    ),
    "left-out": Experiment(
        "What the parts would cost that a grey, bounded, rectified scene does not need.",
        (
            "everything-forced-on",
            *(f"without-{part}" for part in LEFT_OUT),
            "everything-left-out",
            "events",
        ),
        ("shapes",),
        recorded=("recording",),
        columns=("psnr", "correlation", "depth_rmse", "ms_a_step", "megabytes_a_step"),
        measures=("memory",),
        notes=(
            "Memory is what a step keeps for its backward pass, and the parameters with their gradients and running "
            "means. In place of the proposal network are 64 even samples.",
        ),
    ),
    "unbounded": Experiment(
        "Space beyond the box, left out or contracted.",
        ("no-contraction", "contraction"),
        ("unbounded",),
        columns=("psnr", "ssim", "correlation", "near_depth_error"),
        measures=("near_depth",),
        notes=("The depth error is the median, in metres, at things 1 to 2 m away; walls are at 30 and 300 m.",),
    ),
    "sensor": Experiment(
        "An unknown sensor, taken for ideal, learned, and known: each of its faults alone, and together.",
        ("fixed", "learned", "known"),
        tuple(SENSORS),
        columns=(
            "psnr",
            "correlation",
            "depth_rmse",
            "brightness_scale",
            "threshold_ratio",
            "refractory_ms",
            "threshold_map_on",
            "threshold_map_off",
        ),
        measures=("sensor",),
        notes=(
            "The recordings state nothing of their sensor. fixed takes both thresholds for 0.25, all pixels for alike "
            "and never blind, and the response for linlog; learned is told nothing; known is told what was simulated, "
            "as far as the method has settings for it.",
            "In brackets is the truth. The scale is the factor by which the brightness fit multiplies contrast, which "
            "should be the true mean threshold over the one learnt with.",
            "Maps of thresholds are compared with the true thresholds of the pixels by their correlation.",
        ),
    ),
}
"""Experiments by name."""
