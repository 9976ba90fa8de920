"""Published scores, which the tables of `enerf bench` show beside ours.

E-NeRF: Klenk, Koestler, Scaramuzza, Cremers, "E-NeRF: Neural Radiance Fields from a Moving Event Camera", RA-L 2023.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

Scores = dict[str, float]
Published = dict[str, dict[str, Scores]]
"""Scores by sequence and row."""

MEAN = "mean"
"""Name in place of a sequence for means over all sequences."""

PSNR_SSIM_LPIPS = ("psnr", "ssim", "lpips")
PSNR_SSIM_LPIPS_OF_VGG = ("psnr", "ssim", "lpips_vgg")


def _table(
    sequences: Sequence[str], rows: Mapping[str, Sequence[Sequence[float]]], scores: Sequence[str] = PSNR_SSIM_LPIPS
) -> Published:
    """Scores by sequence and row, from rows with one tuple of scores for each sequence."""
    published: Published = {sequence: {} for sequence in sequences}
    for row, values in rows.items():
        for sequence, of_sequence in zip(sequences, values, strict=True):
            published[sequence][row] = dict(zip(scores, of_sequence, strict=True))
    return published


SPIRAL = _table(
    ("spiral1", "spiral2", "spiral1-sparse", "spiral1-more-sparse"),
    {
        "nerf-sharp": [(25.74, 0.74, 0.06), (24.36, 0.63, 0.06), (20.67, 0.38, 0.11), (19.85, 0.26, 0.16)],
        "nerf-blurred": [(23.18, 0.59, 0.09), (23.85, 0.54, 0.09), (20.49, 0.32, 0.13), (19.80, 0.26, 0.17)],
        "deblur": [(21.23, 0.46, 0.23), (18.10, 0.18, 0.72), (17.32, 0.18, 0.72), (16.88, 0.16, 0.70)],
        "e2vid": [(21.86, 0.47, 0.14), (21.83, 0.30, 0.13), (19.77, 0.26, 0.18), (19.75, 0.26, 0.17)],
        "events": [(26.91, 0.82, 0.04), (25.71, 0.79, 0.04), (26.91, 0.82, 0.04), (26.91, 0.82, 0.04)],
        "events+blurred": [(28.23, 0.85, 0.04), (27.92, 0.82, 0.03), (27.34, 0.85, 0.04), (27.27, 0.83, 0.04)],
    },
)
"""E-NeRF, table of the spirals; its deblurring baseline is Deblur-NeRF, which estimates the kernel of the blur."""

SHAKE = _table(
    ("shake-moon1", "shake-moon2", "shake-carpet1"),
    {
        "nerf-sharp": [(33.12, 0.93, 0.02), (28.41, 0.84, 0.03), (29.42, 0.87, 0.03)],
        "nerf-blurred": [(24.22, 0.61, 0.12), (22.04, 0.52, 0.13), (19.69, 0.31, 0.22)],
        "deblur": [(25.97, 0.68, 0.20), (24.78, 0.58, 0.36), (16.44, 0.18, 0.69)],
        "e2vid": [(22.39, 0.80, 0.05), (22.31, 0.78, 0.06), (22.81, 0.80, 0.05)],
        "events": [(31.10, 0.94, 0.02), (30.32, 0.93, 0.02), (26.65, 0.89, 0.03)],
        "events+blurred": [(31.35, 0.95, 0.01), (30.60, 0.93, 0.02), (27.90, 0.89, 0.03)],
    },
)
"""E-NeRF, table of the shaking cameras."""

ABLATION = _table(
    (MEAN,),
    {
        "paper-loss": [(28.14, 0.88, 0.028)],
        "normalised-loss": [(28.07, 0.86, 0.031)],
        "windows-60ms": [(28.13, 0.86, 0.033)],
        "no-event-loss": [(27.76, 0.87, 0.030)],
    },
)
"""E-NeRF, ablation, mean over the five simulated sequences."""

NO_EVENT_WEIGHT = _table(
    ("shake-carpet1",),
    {
        "no-event-0": [(26.64, 0.89, 0.027)],
        "no-event-10": [(28.11, 0.92, 0.020)],
        "no-event-100": [(26.72, 0.90, 0.027)],
        "no-event-1000": [(22.43, 0.82, 0.065)],
    },
)
"""E-NeRF, weight of the no-event loss."""

ENCODING = _table(
    ("shake-carpet1",),
    {
        "events": [(26.65, 0.89, 0.028)],
        "levels-14/16": [(24.99, 0.80, 0.059)],
        "levels-24/16": [(27.42, 0.91, 0.025)],
        "resolution/12": [(26.01, 0.86, 0.039)],
        "resolution-x12": [(26.81, 0.89, 0.030)],
    },
)
"""E-NeRF, hash grid: 16 levels and N_max 6144 (2048 times the box of Shake Carpet 1), 14 and 24 levels, N_max 512 and
73728."""

DEPTH = _table(
    ("shake-moon1", "shake-moon2", "shake-carpet1", "spiral1", "spiral2"),
    {
        "nerf-sharp": [(1.28,), (1.19,), (0.78,), (1.67,), (1.99,)],
        "nerf-blurred": [(1.40,), (1.28,), (0.90,), (1.68,), (2.05,)],
        "e2vid": [(1.40,), (1.33,), (0.84,), (1.76,), (2.07,)],
        "events": [(1.29,), (1.22,), (0.84,), (1.62,), (1.99,)],
        "events+blurred": [(1.30,), (1.23,), (0.84,), (1.67,), (2.07,)],
    },
    ("depth_rmse_all_poses",),
)
"""E-NeRF, root mean square error of depth in metres, over all train and test poses."""

FULL_SIZE: Published = {
    sequence: {row: {**scores, **DEPTH[sequence].get(row, {})} for row, scores in (SPIRAL | SHAKE)[sequence].items()}
    for sequence in ("shake-carpet1", "shake-moon2", "spiral1")
}
"""E-NeRF, scores and depth of three sequences."""

RUN_TIME: Published = {
    "spiral1": {
        "nerf-blurred": {"ms_a_step": 210.0},
        "events-30096-pairs": {
            "ms_a_step": 290.0,
            "forward_and_backward": 97.40,
            "sample": 1.95,
            "poses": 0.07,
            "rays": 0.50,
            "images": 0.08,
        },
    }
}
"""E-NeRF, milliseconds of a step of 30096 rays on an A40, and shares of it in percent."""

SLIDER_DEPTH = _table(
    ("slider_depth",),
    {"Event-3DGS (NeurIPS 2024)": [(12.45, 0.497, 0.261)], "E2VID with 3DGS": [(7.62, 0.356, 0.309)]},
    PSNR_SSIM_LPIPS_OF_VGG,
)
"""Event-3DGS (NeurIPS 2024) and its baseline: PSNR of pictures as they are."""

UZH = _table(
    ("boxes", "office_zigzag", "outdoors_walking", "calibration"),
    {"Event-3DGS (NeurIPS 2024)": [(17.70,), (14.04,), (10.58,), (11.07,)]},
    ("psnr",),
)
"""Event-3DGS on other sequences of the same data set."""

EDS = _table(
    ("03_rocket_earth_dark", "07_ziggy_and_fuzz_hdr", "08_peanuts_running", "11_all_characters", "13_airplane"),
    {
        "E2VID with 3DGS": [(15.67,), (15.05,), (14.03,), (13.83,), (18.96,)],
        "Robust e-NeRF": [(19.19,), (14.78,), (14.75,), (14.43,), (18.10,)],
        "EventSplat": [(20.78,), (19.14,), (17.53,), (17.79,), (19.05,)],
        "GPERT": [(19.04,), (20.24,), (21.03,), (16.73,), (20.30,)],
    },
    ("psnr",),
) | {
    MEAN: {
        **_table(
            (MEAN,),
            {
                "E2VID with 3DGS": [(15.51, 0.692, 0.375)],
                "Robust e-NeRF": [(16.25, 0.739, 0.543)],
                "EventSplat": [(18.86, 0.792, 0.363)],
            },
            PSNR_SSIM_LPIPS_OF_VGG,
        )[MEAN],
        **_table((MEAN,), {"GPERT": [(19.47, 0.816, 0.357)]})[MEAN],
    }
}
"""As printed by GPERT (CVPR 2026), who copied the rows of EventSplat (CVPR 2025), whose LPIPS is that of VGG."""

TUM_VIE = _table(
    ("mocap-1d-trans", "mocap-desk2"),
    {"Robust e-NeRF": [(9.61,), (13.97,)], "IncEventGS": [(10.13,), (10.05,)], "GPERT": [(11.97,), (14.20,)]},
    ("psnr",),
) | _table(
    (MEAN,),
    {
        "E2VID with 3DGS": [(9.52, 0.516, 0.759)],
        "Robust e-NeRF": [(11.79, 0.573, 0.588)],
        "IncEventGS": [(10.09, 0.533, 0.685)],
        "GPERT": [(13.09, 0.716, 0.411)],
    },
)
"""As printed by GPERT (CVPR 2026)."""

EVENTNERF = _table(
    ("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic"),
    {"E-3DGS (3DV 2025)": [(30.42,), (31.07,), (34.08,), (30.79,), (30.74,), (33.73,), (35.87,)]},
    ("psnr",),
) | _table(
    (MEAN,),
    {
        "EventNeRF": [(28.85, 0.93, 0.06)],
        "Event3DGS (CoRL 2024)": [(31.46, 0.95, 0.03)],
        "E-3DGS (3DV 2025)": [(32.39, 0.96, 0.03)],
    },
)
"""EventNeRF's synthetic scenes. E-3DGS fits an offset alone, as the protocol log-offset does."""

EV_DEBLUR_BLENDER = _table((MEAN,), {"Ev-DeblurNeRF": [(24.76,)], "DiET-GS": [(26.69,)]}, ("psnr",))
"""Means over the scenes that Ev-DeblurNeRF rendered with Blender."""

EV_DEBLUR_CDAVIS = _table((MEAN,), {"Ev-DeblurNeRF": [(32.30,)], "DiET-GS": [(34.22,)]}, ("psnr",))
"""Means over the scenes that Ev-DeblurNeRF recorded with a DAVIS of colour."""
