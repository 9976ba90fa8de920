"""The experiments of `enerf bench`: their rows, sequences, scores and notes."""

from __future__ import annotations

import json
from dataclasses import fields, replace
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
"""Treats blurred frames as sharp ones."""

POSES_AS_READ = {f"pipeline.poses.refine_{part}": False for part in ("clock", "mount", "lens", "drift")}
"""Takes clock, mount, lens and trajectory as they are stated."""

PAPER_LOSS = {
    **POSES_AS_READ,
    MODEL + "event_loss": "squared",
    MODEL + "no_event_margin": 1.0,
    DATA + "pair_mode": "successor",
    DATA + "silent_pairs": 0,
}
"""The paper's event loss on pairs of successive events, without no-event loss. Poses are taken as stated, as in the
paper."""

SILENT_PAIRS = 341
PAPER_C = 0.2
"""Contrast threshold C of the simulated sequences. Our losses are in units of C, and those of the paper are not. So the
paper's weight of the no-event loss is divided by C, and that of the frame loss by C^2."""


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
"""Turns on all parts of the method that some scenes do not need."""

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
"""Turns off each of these parts. 64 even samples replace the proposal network."""

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
"""Assumes an ideal sensor, learns no sensor parameter, and has no loss of the level of brightness."""


def known_sensor(sensor: SensorSettings) -> dict[str, Any]:
    """Settings of the method that state the parameters of a simulated sensor."""
    return {
        SENSOR + "contrast_thresholds": tuple(sensor.contrast_thresholds),
        SENSOR + "response": sensor.response,
        SENSOR + "refractory_period_ns": sensor.refractory_period,
        SENSOR + "leak_rate": sensor.leak_rate,
        SENSOR + "cutoff_frequency": sensor.cutoff_frequency or None,
        **NOTHING_LEARNED,
    }


LEVELLING = ("nerf-blurred", "deblur", "events", "events+blurred")
"""Rows whose budget is varied."""

BUDGETS = (0.25, 0.5, 1, 2)

USLAM: dict[str, Any] = {PARSER + "format": "llff_events", PARSER + "options": {"pose_set": "uslam"}}
"""Reads the poses of Ultimate-SLAM that come with Gen3-HandHeld."""

ROWS: dict[str, Row] = {
    "nerf-sharp": Row({**FRAMES, **SHARP}),
    "nerf-blurred": Row({**FRAMES, **ONE_INSTANT}),
    "deblur": Row(FRAMES),
    "e2vid": Row({**FRAMES, **ONE_INSTANT}, reconstruction="e2vid"),
    "filter": Row({**FRAMES, **ONE_INSTANT}, reconstruction="filter"),
    "events": Row(),
    "events+blurred": Row(EVENTS_AND_FRAMES),
    "uslam-poses": Row({**EVENTS_AND_FRAMES, **USLAM}),
    "uslam-poses-as-read": Row({**EVENTS_AND_FRAMES, **USLAM, **POSES_AS_READ}),
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
    "known-not-completed": Row({DATA + "completed_refractory_ns": 0}, known_sensor=True),
}
"""Rows by name. Experiments with the same row share its runs."""

ROWS |= {
    f"{name}-{budget:g}x": replace(ROWS[name], budget=budget) for name in LEVELLING for budget in BUDGETS if budget != 1
}

NEAR = (0.9, 2.6)
"""Range of depth of the near objects of the unbounded scene, metres."""

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
"""Sequences with one fault of the sensor each, and with several. medium and hard have the spreads of thresholds and the
refractory periods of Robust e-NeRF (Low and Lee, ICCV 2023)."""


def _blind(name: str, milliseconds: float) -> dict[str, Sequence]:
    """A recording of the validation set whose pixels are blind for a while after each event, by its name."""
    sequence = {**CHOSEN_ON, **ONLY_SCORED}[name]
    sensor = {"contrast_thresholds": (0.2, 0.2), "refractory_period": round(1e6 * milliseconds)}
    simulation = {key: value for key, value in sequence.simulation.items() if key != "contrast_thresholds"}
    return {f"{name}-{milliseconds:g}ms": replace(sequence, sensor=sensor, simulation=simulation)}


BLIND_CHOSEN_ON = {**_blind("floor", 0.1), **_blind("relief", 2.0), **_blind("room-hard", 2.0), **_blind("far", 0.5)}
BLIND_ONLY_SCORED = {**_blind("clutter", 0.2), **_blind("plain", 0.5), **_blind("near", 1.0)}

EV_DEBLUR_BLENDER = ("blurfactory", "bluroutdoorpool", "blurtanabata", "blurwine")
EV_DEBLUR_CDAVIS = ("blurbatteries", "blurdrones", "blurequipment", "blurfigures", "blurpowersupplies")
"""Scenes in the configs of Ev-DeblurNeRF's authors."""

GEN3_HANDHELD = tuple(f"{exposure}ms/speed{speed}" for exposure in (10, 30, 50) for speed in (1, 2, 3))
"""Scenes in the configs of Gen3-HandHeld's authors, by the exposure of their frames."""

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
    **BLIND_CHOSEN_ON,
    **BLIND_ONLY_SCORED,
    **CHOSEN_ON,
    **ONLY_SCORED,
    "recording": Sequence(),
    "slider_depth": Sequence(),
    **{name: Sequence() for name in published.UZH},
    **{name: Sequence() for name in published.EDS if name != published.MEAN},
    **{
        name: Sequence(
            changes={
                PARSER + "held_out_frame_indices": tuple(range(20, 1001, 10)),
                SENSOR + "contrast_thresholds": (0.25, 0.25),
            }
        )
        for name in published.EVENTNERF
        if name != published.MEAN
    },
    **{name: Sequence(changes={SENSOR + "contrast_thresholds": (0.2, 0.2)}) for name in EV_DEBLUR_BLENDER},
    **{
        name: Sequence(changes={SENSOR + "contrast_thresholds": (0.25, 0.25)})
        for name in (*EV_DEBLUR_CDAVIS, *GEN3_HANDHELD)
    },
    "mocap-1d-trans": Sequence(preset="mocap-1d-trans"),
    "mocap-desk2": Sequence(preset="mocap-desk2"),
    "mocap-desk2-6views": Sequence(preset="mocap-desk2-6views"),
}
"""Sequences by name. A preset sets the paper's frames, times and thresholds, and for enerf-paper also box and batch."""

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
    "nerf-sharp and nerf-blurred train the field of the method with the frame loss alone.",
    "deblur renders each frame over the poses of its exposure. The paper's row is Deblur-NeRF, which has no poses.",
    "e2vid and filter train on frames that are reconstructed from the events. filter is a complementary filter, which "
    "is not in the paper.",
    "events+blurred renders frames over their exposure. events+blurred-one-instant does not, as in the paper.",
)

OF_EV_DEBLUR = (
    "All sharp pictures are held out, as in the publications. Their methods learn from blurred frames and events, and "
    "render colours as frames show them, which raw compares.",
    "The mean of the publications is over their scenes, which may be other ones than those here.",
)

EXPERIMENTS: dict[str, Experiment] = {
    "spiral": Experiment(
        "Frames, events, and both, on the spiral sequences and with fewer views.",
        BASELINES,
        tuple(published.SPIRAL),
        published=published.SPIRAL,
        notes=OF_BASELINES,
    ),
    "shake": Experiment(
        "Frames, events, and both, of a shaking camera with mild, medium and strong blur.",
        BASELINES,
        tuple(published.SHAKE),
        published=published.SHAKE,
        notes=OF_BASELINES,
    ),
    "ablation": Experiment(
        "Variants of the paper's event loss, mean over five sequences.",
        ("events", "paper-loss", "normalised-loss", "windows-60ms", "no-event-loss"),
        FIVE,
        published=published.ABLATION,
        mean=True,
        notes=(
            "events is our default method. The other rows have the paper's losses and pairs. The paper does not state "
            "the weight of its no-event loss, which is 1 here.",
        ),
    ),
    "losses": Experiment(
        "Published losses on the same field, mean over five sequences.",
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
        notes=("The paper shows pictures without scores: large weights bring back blur, small weights lose colour.",),
    ),
    "encoding": Experiment(
        "Levels and finest resolution of the hash grid.",
        tuple(published.ENCODING["shake-carpet1"]),
        ("shake-carpet1",),
        published=published.ENCODING,
        notes=(
            "Levels and finest resolution are those chosen for the recording, times the ratio of the paper's values to "
            "its 16 levels and N_max of 6144.",
        ),
    ),
    "depth": Experiment(
        "Depth error at all training and test poses, of the runs of spiral and shake.",
        BASELINES,
        FIVE,
        columns=("depth_rmse_all_poses",),
        published=published.DEPTH,
    ),
    "full-size": Experiment(
        "Frames, events, and both, at the size of the paper (--scale 1).",
        ("nerf-blurred", "events", "events+blurred"),
        tuple(published.FULL_SIZE),
        columns=(*published.PSNR_SSIM_LPIPS, "depth_rmse_all_poses"),
        published=published.FULL_SIZE,
        notes=OF_BASELINES[:1] + OF_BASELINES[3:],
    ),
    "levelling": Experiment(
        "The budget, from a quarter to twice --budget, to find out where quality levels off.",
        tuple(f"{name}-{budget:g}x".removesuffix("-1x") for name in LEVELLING for budget in BUDGETS),
        ("shake-moon2", "shake-carpet1"),
        notes=("Learning rates fall to the end of each training, so that each row is a training of its own.",),
    ),
    "run-time": Experiment(
        "Time of a training step, and the share of each part in percent.",
        ("nerf-blurred", "events", "events+blurred", "events-30096-pairs"),
        ("spiral1",),
        columns=("ms_a_step", "sample", "poses", "rays", "images", "forward_and_backward"),
        measures=("step",),
        published=published.RUN_TIME,
        notes=("The paper's step has 30096 rays, on an A40.",),
    ),
    "views": Experiment(
        "Many views against 6 views, for frames and for events.",
        ("nerf-blurred", "events"),
        ("spiral1", "spiral1-6views"),
        recorded=("mocap-desk2", "mocap-desk2-6views"),
        notes=("The paper compares pictures of 60 and 6 views of mocap-desk2. --data FOLDER gives this recording.",),
    ),
    "slider-depth": Experiment(
        "UZH's slider_depth (--data), compared with Event-3DGS.",
        ("nerf-blurred", "e2vid", "filter", "events", "events+blurred"),
        recorded=("slider_depth",),
        protocols=("raw", "log-affine-set"),
        columns=("psnr", "ssim", "correlation", "lpips", "lpips_vgg"),
        published=published.SLIDER_DEPTH,
        source="Event-3DGS",
        notes=(
            "Event-3DGS trains on frames that E2VID made of the events, and scores views that it does not name, as "
            "they are; here every fourth frame is held out, and raw compares as it does.",
        ),
    ),
    "uzh": Experiment(
        "Other sequences of UZH's data set (folders in --data), compared with Event-3DGS.",
        ("events",),
        recorded=tuple(published.UZH),
        protocols=("raw", "log-affine-set"),
        columns=("psnr", "ssim", "lpips", "lpips_vgg"),
        published=published.UZH,
        source="Event-3DGS",
        notes=("Event-3DGS does not name the views that it scores. Here every fourth frame is held out.",),
    ),
    "eds": Experiment(
        "Sequences of EDS (folders in --data), compared with GPERT and EventSplat.",
        ("events",),
        recorded=tuple(name for name in published.EDS if name != published.MEAN),
        columns=("psnr", "ssim", "lpips", "lpips_vgg"),
        published=published.EDS,
        source="GPERT",
        notes=(
            "GPERT copied EventSplat's rows, and follows Robust e-NeRF's evaluation; here the whole recording is used "
            "and every fourth frame held out.",
        ),
    ),
    "tum-vie": Experiment(
        "Sequences of TUM-VIE (folders in --data), compared with GPERT.",
        ("events",),
        recorded=tuple(name for name in published.TUM_VIE if name != published.MEAN),
        published=published.TUM_VIE,
        source="GPERT",
        notes=("Frames and time range are those of E-NeRF's configs. GPERT uses those of Robust e-NeRF.",),
    ),
    "eventnerf": Experiment(
        "EventNeRF's synthetic scenes (folders in --data), compared with EventNeRF and two methods of Gaussians.",
        ("events",),
        recorded=tuple(name for name in published.EVENTNERF if name != published.MEAN),
        protocols=("eventnerf", "log-offset"),
        published=published.EVENTNERF,
        source="EventNeRF and others",
        notes=(
            "EventNeRF trains on all events and scores every tenth view of their path, without the first two, as here. "
            "The threshold of 0.25 is that of its configs.",
            "E-3DGS fits an offset alone, as log-offset, and its code reads the validation views.",
        ),
    ),
    "ev-deblur-blender": Experiment(
        "Ev-DeblurNeRF's rendered scenes (folders in --data), compared with Ev-DeblurNeRF and DiET-GS.",
        ("nerf-blurred", "events+blurred"),
        recorded=EV_DEBLUR_BLENDER,
        protocols=("raw", "log-affine-set"),
        published=published.EV_DEBLUR_BLENDER,
        source="Ev-DeblurNeRF and DiET-GS",
        notes=OF_EV_DEBLUR,
    ),
    "ev-deblur-cdavis": Experiment(
        "Ev-DeblurNeRF's real scenes (folders in --data), compared with Ev-DeblurNeRF and DiET-GS.",
        ("nerf-blurred", "events+blurred"),
        recorded=EV_DEBLUR_CDAVIS,
        protocols=("raw", "log-affine-set"),
        published=published.EV_DEBLUR_CDAVIS,
        source="Ev-DeblurNeRF and DiET-GS",
        notes=OF_EV_DEBLUR,
    ),
    "gen3-handheld": Experiment(
        "Gen3-HandHeld (folders in --data), with poses of motion capture, and with noisy ones that are refined or not.",
        ("events+blurred", "uslam-poses", "uslam-poses-as-read"),
        recorded=GEN3_HANDHELD,
        protocols=("raw", "log-affine-set"),
        notes=(
            "All sharp pictures are held out, with poses of motion capture. uslam-poses has those of Ultimate-SLAM, on "
            "which the publication (Zou et al., T-RO 2026) trains, and as-read does not refine them.",
            "The publication's scores are not known here. It aligns the held-out poses with the trained field before "
            "it scores; here they stay as they are.",
        ),
    ),
    "validation": Experiment(
        "Different recordings on which changes of defaults are chosen and checked.",
        ("events", "without-instants", "nerf-sharp"),
        (*CHOSEN_ON, *ONLY_SCORED),
        recorded=(REAL,),
        beside=True,
        columns=("psnr", "ssim", "event_correlation", "depth_rmse", "brightness_scale"),
        measures=("events",),
        notes=(
            f"Defaults may be chosen on {', '.join(CHOSEN_ON)} and {REAL}; {', '.join(ONLY_SCORED)} are only scored.",
            "without-instants uses pairs of events and silent pairs, but no pairs of arbitrary instants.",
            "nerf-sharp trains on sharp frames alone, which shows the limit of the field, sampler and renderer.",
        ),
    ),
    "parts": Experiment(
        "Numerical error of quadrature, poses, float32 and brightness fit, to find the part that limits a result.",
        ("events",),
        ("shapes", "shake-carpet1"),
        parts=True,
    ),
    "design": Experiment(
        "The method against single changes of its design, on the demo's scene or on any recording.",
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
        "Settings that trade error for time: samples, batch, distance of pairs, levels of the hash grid.",
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
        "Cost of the parts that a grey, bounded, rectified scene does not need.",
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
            "Memory is that of the values that a step keeps for its backward pass, parameters, gradients and moments "
            "of Adam. 64 even samples replace the proposal network.",
        ),
    ),
    "unbounded": Experiment(
        "Space beyond the box, ignored or contracted.",
        ("no-contraction", "contraction"),
        ("unbounded",),
        columns=("psnr", "ssim", "correlation", "near_depth_error"),
        measures=("near_depth",),
        notes=("The depth error is the median in metres over objects 1 to 2 m away. Walls are at 30 and 300 m.",),
    ),
    "sensor": Experiment(
        "A sensor with single and with several faults, which training assumes to be ideal, learns, or knows.",
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
            "The recordings do not state their sensor. fixed assumes thresholds of 0.25 for all pixels, no refractory "
            "period and a linlog response. learned learns the sensor. known has the simulated parameters, as far as "
            "the method has settings for them.",
            "The true value is in brackets. The scale is the factor by which the brightness fit multiplies contrast. "
            "Its true value is the true mean threshold divided by the one that training used.",
            "Columns of maps show the correlation of learned and true thresholds over pixels.",
        ),
    ),
    "refractory": Experiment(
        "Pixels that are blind after each event: what they missed is added to the sums of events, or is not.",
        ("known", "known-not-completed"),
        (*BLIND_CHOSEN_ON, *BLIND_ONLY_SCORED),
        columns=("psnr", "ssim", "event_correlation", "depth_rmse", "brightness_scale"),
        measures=("events",),
        notes=(
            "The recordings are those of the validation set, with an ideal sensor but for the refractory period in "
            "their name. Training has all its parameters stated.",
            f"The limit of noise was chosen on {', '.join(BLIND_CHOSEN_ON)}; the others are only scored.",
        ),
    ),
}
"""Experiments by name."""
