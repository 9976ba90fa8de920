from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torch import Tensor
from torchmetrics.image import PeakSignalNoiseRatio, StructuralSimilarityIndexMeasure

from enerf_ns.evaluation.metrics import correlation, depth_rmse, event_scores, psnr, ssim


def pictures(count: int, seed: int = 0) -> list[Tensor]:
    """Pictures of different mean brightness, float64 [12, 16, 3], from 0.05 to 0.75."""
    random = np.random.default_rng(seed)
    return [torch.from_numpy(0.05 + 0.2 * i + 0.3 * random.random((12, 16, 3))) for i in range(count)]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_render_with_a_pixel_that_is_not_finite_has_no_score(value: float):
    rendered, recorded = pictures(1)[0], pictures(1, seed=1)[0]
    rendered[3, 4, 1] = value
    assert {score(rendered, recorded) for score in (psnr, ssim, correlation)} == {"the render is not finite"}


def test_pictures_smaller_than_the_window_of_ssim_have_a_psnr():
    smallest, recorded = (picture[:11, :11] for picture in (pictures(1)[0], pictures(1, seed=1)[0]))
    found: Any = ssim(smallest, recorded)
    assert np.isfinite(found)
    for cut in (slice(10), (slice(None), slice(10))):
        assert ssim(smallest[cut], recorded[cut]) == "the frame is smaller than 11 x 11 pixels"
        expected = peak_signal_noise_ratio(recorded[cut].numpy(), smallest[cut].numpy(), data_range=1.0)
        assert psnr(smallest[cut], recorded[cut]) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("values", [(0.4, 0.4), (0.4, 0.6), (0.0, 1.0)])
def test_constant_pictures_have_scores_but_no_correlation(values: tuple[float, float]):
    constant = [torch.full((12, 16, 3), value) for value in values]
    found: Any = ssim(*constant)
    assert np.isfinite(found)
    assert correlation(*constant) == correlation(constant[0], pictures(1)[0]) == "the rendered values are all equal"
    assert correlation(pictures(1)[0], constant[1]) == "the recorded values are all equal"
    assert psnr(*constant) == pytest.approx(120.0 if values[0] == values[1] else -20 * np.log10(values[1] - values[0]))


def test_scores_equal_those_of_scikit_image_and_torchmetrics():
    random = np.random.default_rng(0)
    recorded = random.random((40, 50, 3)).astype(np.float32)
    rendered = (recorded + 0.1 * random.standard_normal(recorded.shape)).clip(0, 1).astype(np.float32)
    pair = torch.from_numpy(rendered), torch.from_numpy(recorded)
    assert psnr(*pair) == pytest.approx(peak_signal_noise_ratio(recorded, rendered, data_range=1.0), abs=1e-4)
    assert psnr(*pair) == pytest.approx(float(PeakSignalNoiseRatio(data_range=1.0)(*pair)), abs=1e-4)
    gaussian = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    expected: Any = structural_similarity(recorded, rendered, data_range=1.0, channel_axis=2, full=True, **gaussian)
    assert ssim(*pair) == pytest.approx(expected[1].mean(), abs=5e-4)  # they mirror the border differently
    batches = [image.movedim(-1, 0)[None] for image in pair]
    assert ssim(*pair) == pytest.approx(float(StructuralSimilarityIndexMeasure(data_range=1.0)(*batches)), abs=1e-6)


def test_scores_of_events_are_those_of_a_loop():
    random = np.random.default_rng(0)
    measured = 0.25 * random.integers(-3, 4, 500)
    predicted = 0.9 * measured + 0.2 * random.standard_normal(500)
    scores = event_scores(torch.from_numpy(predicted), torch.from_numpy(measured), 0.25)
    errors = [((a - b) / 0.25) ** 2 for a, b in zip(predicted, measured, strict=True)]
    right = [(a > 0) == (b > 0) for a, b in zip(predicted, measured, strict=True) if b != 0]
    assert scores["event_correlation"] == pytest.approx(np.corrcoef(predicted, measured)[0, 1], abs=1e-9)
    assert scores["event_rmse"] == pytest.approx(np.sqrt(sum(errors) / 500))
    assert scores["event_sign"] == pytest.approx(sum(right) / len(right)) and 0.5 < sum(right) / len(right) < 1.0


def test_changes_that_are_flat_or_not_finite_have_the_scores_that_they_can_have():
    measured = torch.tensor([0.2, -0.2, 0.4])
    flat = event_scores(torch.zeros(3), measured, 0.2)
    assert flat["event_correlation"] == "the rendered values are all equal" and flat["event_sign"] == 0.0
    assert flat["event_rmse"] == pytest.approx(np.sqrt(2.0))
    spoilt = event_scores(torch.tensor([0.1, torch.nan, 0.1]), measured, 0.2)
    assert set(spoilt.values()) == {"the render is not finite"}
    nothing = event_scores(measured, torch.zeros(3), 0.2)
    assert nothing["event_sign"] == "no pair measured a change"


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
