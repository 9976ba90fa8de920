from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torch import Tensor

from enerf_ns.evaluation.metrics import (
    align_brightness,
    align_channels,
    correlation,
    depth_rmse,
    fit_fault,
    image_metrics,
)
from enerf_ns.sensor.response import inverse_linlog, linlog


def pictures(count: int, seed: int = 0) -> list[Tensor]:
    """Pictures of different mean brightness, float64 [12, 16, 3], from 0.05 to 0.75."""
    random = np.random.default_rng(seed)
    return [torch.from_numpy(0.05 + 0.2 * i + 0.3 * random.random((12, 16, 3))) for i in range(count)]


def test_alignment_recovers_a_known_scale_and_offset_over_several_pictures():
    rendered = pictures(3)
    recorded = [inverse_linlog(0.8 * linlog(image) + 0.5) for image in rendered]
    aligned, (scale, offset) = align_brightness(rendered, recorded)
    assert scale == pytest.approx(0.8, abs=1e-9) and offset == pytest.approx(0.5, abs=1e-9)
    for image, truth in zip(aligned, recorded, strict=True):
        torch.testing.assert_close(image, truth, rtol=0, atol=1e-9)


def test_alignment_is_the_least_squares_of_numpy_over_all_pictures_together():
    rendered, recorded = pictures(3), pictures(3, seed=1)[::-1]
    x, y = (torch.cat([linlog(image).flatten() for image in images]).numpy() for images in (rendered, recorded))
    expected = np.linalg.lstsq(np.column_stack([x, np.ones_like(x)]), y, rcond=None)[0]
    np.testing.assert_allclose(align_brightness(rendered, recorded)[1], expected, rtol=1e-9)


def test_channels_align_by_the_least_squares_of_numpy_each_by_itself():
    rendered = pictures(3)
    scale, offset = torch.tensor([0.6, 1.1, 0.9]), torch.tensor([0.9, -0.4, 0.1])
    noise = pictures(3, seed=1)
    recorded = [
        inverse_linlog(scale * linlog(a) + offset + 0.05 * b).clamp(0, 1) for a, b in zip(rendered, noise, strict=True)
    ]
    aligned, fits = align_channels(rendered, recorded)
    assert len(fits) == 3 and [image.shape for image in aligned] == [image.shape for image in rendered]
    for channel, fit in enumerate(fits):
        x, y = (
            torch.cat([linlog(image[..., channel]).flatten() for image in images]).numpy()
            for images in (rendered, recorded)
        )
        expected = np.linalg.lstsq(np.column_stack([x, np.ones_like(x)]), y, rcond=None)[0]
        np.testing.assert_allclose(fit, expected, rtol=1e-9)
        for image, original in zip(aligned, rendered, strict=True):
            truth = inverse_linlog(expected[0] * linlog(original[..., channel]) + expected[1]).clamp(0, 1)
            torch.testing.assert_close(image[..., channel], truth, rtol=0, atol=1e-9)


def test_channels_of_equal_pictures_align_as_grey_ones_do():
    grey, recorded = ([image[..., :1] for image in pictures(2, seed)] for seed in (0, 1))
    aligned, fit = align_brightness(grey, recorded)
    in_colour, fits = align_channels(*([image.repeat(1, 1, 3) for image in images] for images in (grey, recorded)))
    assert fits == [fit] * 3
    for image, expected in zip(in_colour, aligned, strict=True):
        torch.testing.assert_close(image, expected.expand(-1, -1, 3), rtol=0, atol=0)


def test_alignment_keeps_the_type_of_the_pictures_and_their_range():
    rendered = [image.float() for image in pictures(2)]
    recorded = [(4.0 * image).clamp(max=1.0) for image in rendered]
    aligned, _ = align_brightness(rendered, recorded)
    assert all(image.dtype == torch.float32 and image.min() >= 0 and image.max() <= 1 for image in aligned)


def test_constant_renders_align_to_the_mean_of_the_recorded():
    recorded = pictures(2)
    mean = torch.stack([linlog(image) for image in recorded]).mean()
    aligned, (scale, offset) = align_brightness([torch.full((12, 16, 3), 0.4)] * 2, recorded)
    assert scale == 0.0 and offset == pytest.approx(mean.item())
    torch.testing.assert_close(aligned[1], torch.full((12, 16, 3), inverse_linlog(mean).item()))


def test_a_negative_and_flat_pictures_are_no_fit_and_a_picture_is_one():
    recorded = pictures(2)
    negative = [inverse_linlog(7.0 - 0.61 * linlog(image)) for image in recorded]
    flat = [torch.full((12, 16, 3), 0.1)] * 2
    good, bad = (align_brightness(rendered, recorded)[1] for rendered in (recorded, negative))
    assert bad[0] == pytest.approx(-1 / 0.61)
    assert fit_fault([good]) is None
    assert str(fit_fault([bad])).startswith("the render is a negative of the frame (brightness scale -1.64); check the")
    assert fit_fault([good, bad]) == fit_fault([bad])
    for pair in ((flat, recorded), (recorded, flat), (flat, flat)):
        fit = align_brightness(*pair)[1]
        assert fit[0] == 0.0
        assert str(fit_fault([fit])).startswith("no brightness scale fits, since what is rendered or recorded is flat")
    red_negative = [torch.cat([a[..., :1], b[..., 1:]], -1) for a, b in zip(negative, recorded, strict=True)]
    assert "negative" in str(fit_fault(align_channels(red_negative, recorded)[1]))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_render_with_a_pixel_that_is_not_finite_has_no_score(value: float):
    rendered, recorded = pictures(1)[0], pictures(1, seed=1)[0]
    rendered[3, 4, 1] = value
    assert image_metrics(rendered, recorded) == dict.fromkeys(("psnr", "ssim"), "the render is not finite")
    assert correlation(rendered, recorded) == "the render is not finite"


def test_pictures_smaller_than_the_window_of_ssim_have_a_psnr():
    smallest, recorded = (picture[:11, :11] for picture in (pictures(1)[0], pictures(1, seed=1)[0]))
    assert all(isinstance(score, float) and np.isfinite(score) for score in image_metrics(smallest, recorded).values())
    for cut in (slice(10), (slice(None), slice(10))):
        scores = image_metrics(smallest[cut], recorded[cut])
        assert scores["ssim"] == "the frame is smaller than 11 x 11 pixels"
        expected = peak_signal_noise_ratio(recorded[cut].numpy(), smallest[cut].numpy(), data_range=1.0)
        assert scores["psnr"] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("values", [(0.4, 0.4), (0.4, 0.6), (0.0, 1.0)])
def test_constant_pictures_have_scores_but_no_correlation(values: tuple[float, float]):
    constant = [torch.full((12, 16, 3), value) for value in values]
    scores = image_metrics(*constant)
    assert isinstance(scores["ssim"], float) and np.isfinite(scores["ssim"])
    assert correlation(*constant) == correlation(constant[0], pictures(1)[0]) == "what is rendered is flat"
    assert correlation(pictures(1)[0], constant[1]) == "what is recorded is flat"
    assert scores["psnr"] == pytest.approx(120.0 if values[0] == values[1] else -20 * np.log10(values[1] - values[0]))


def test_scores_equal_those_of_scikit_image():
    random = np.random.default_rng(0)
    recorded = random.random((40, 50, 3)).astype(np.float32)
    rendered = (recorded + 0.1 * random.standard_normal(recorded.shape)).clip(0, 1).astype(np.float32)
    scores = image_metrics(torch.from_numpy(rendered), torch.from_numpy(recorded))
    assert scores["psnr"] == pytest.approx(peak_signal_noise_ratio(recorded, rendered, data_range=1.0), abs=1e-4)
    gaussian = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    ssim: Any = structural_similarity(recorded, rendered, data_range=1.0, channel_axis=2, full=True, **gaussian)
    assert scores["ssim"] == pytest.approx(ssim[1].mean(), abs=5e-4)  # they mirror the border differently


def test_correlation_is_that_of_numpy_and_blind_to_scale_and_offset():
    rendered, recorded = pictures(1)[0], pictures(1, seed=1)[0] + pictures(1)[0]
    expected = np.corrcoef(rendered.flatten(), recorded.flatten())[0, 1]
    assert correlation(rendered, recorded) == pytest.approx(expected, abs=1e-9)
    assert correlation(0.3 * rendered + 0.2, recorded) == pytest.approx(expected, abs=1e-9)


def test_depth_error_leaves_out_what_is_unknown():
    rendered = torch.tensor([[1.0, 2.0], [3.0, 100.0]])[..., None]
    recorded = torch.tensor([[2.0, 2.0], [5.0, 0.0]])[..., None]
    assert depth_rmse(rendered, recorded) == pytest.approx(np.sqrt((1 + 0 + 4) / 3))
    for unknown in (torch.nan, torch.inf, -1.0):
        recorded[1, 1] = unknown
        assert depth_rmse(rendered, recorded) == pytest.approx(np.sqrt((1 + 0 + 4) / 3))
    rendered[1, 1] = torch.nan
    assert depth_rmse(rendered, recorded) == pytest.approx(np.sqrt((1 + 0 + 4) / 3))
    rendered[0, 0] = torch.nan
    assert depth_rmse(rendered, recorded) == "the rendered depth is not finite"
    assert depth_rmse(rendered, torch.zeros_like(recorded)) == "no depth is known"
