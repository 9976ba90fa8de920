from __future__ import annotations

import math
from contextlib import nullcontext

import cv2
import numpy as np
import pytest
import torch

from enerf_ns.dataparsers.recording.recording import _is_response
from enerf_ns.sensor.response import (
    LARGEST_OFFSET,
    SMALLEST_OFFSET,
    ColourFilter,
    Gamma,
    Linlog,
    Logarithm,
    inverse_linlog,
    linlog,
    luma,
    pixel_brightness,
    response_named,
)

KNEE = 20.0 / 255.0


@pytest.mark.parametrize(
    ("level", "expected"),
    [(0.0, 0.0), (10.0, 0.5 * math.log(20)), (20.0, math.log(20)), (100.0, math.log(100)), (255.0, math.log(255))],
)
def test_linlog_of_a_grey_level(level: float, expected: float):
    assert linlog(torch.tensor(level / 255.0, dtype=torch.float64)).item() == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    ("level", "expected"),
    [(0.0, math.log(20) / 20), (19.9, math.log(20) / 20), (20.0, 1 / 20), (20.1, 1 / 20.1), (200.0, 1 / 200)],
)
def test_slope_of_linlog_per_grey_level(level: float, expected: float):
    brightness = torch.tensor(level / 255.0, dtype=torch.float64, requires_grad=True)
    linlog(brightness).backward()
    assert brightness.grad is not None
    assert brightness.grad.item() / 255.0 == pytest.approx(expected, rel=1e-12)


def test_linlog_is_continuous_at_the_knee_and_increasing():
    below, above = linlog(torch.tensor([KNEE - 1e-9, KNEE + 1e-9], dtype=torch.float64)).tolist()
    assert above - below == pytest.approx(0.0, abs=1e-6)
    assert (linlog(torch.linspace(-0.1, 1.0, 1000, dtype=torch.float64)).diff() > 0).all()


def test_inverse_linlog_undoes_linlog():
    brightness = torch.linspace(-0.1, 1.2, 1301, dtype=torch.float64)
    torch.testing.assert_close(inverse_linlog(linlog(brightness)), brightness, rtol=0, atol=1e-12)
    assert inverse_linlog(torch.tensor(math.log(100.0))).item() == pytest.approx(100 / 255)


@pytest.mark.parametrize("name", ["linlog", "logarithm:0.001", "logarithm:0.2"])
@pytest.mark.parametrize(("dtype", "rtol"), [(np.float64, 1e-14), (np.float32, 1e-6)])
def test_responses_of_arrays_are_those_of_tensors(name: str, dtype: type, rtol: float):
    response = response_named(name)
    brightness = np.append(np.linspace(0.0, 1.2, 1201), [KNEE, 1e6]).astype(dtype)
    levels = response(brightness)
    back = response.inverse(levels)
    assert isinstance(levels, np.ndarray) and levels.dtype == back.dtype == dtype
    np.testing.assert_allclose(levels, response(torch.from_numpy(brightness)).numpy(), rtol=rtol, atol=rtol)
    np.testing.assert_allclose(back, response.inverse(torch.from_numpy(levels)).numpy(), rtol=rtol, atol=rtol)
    np.testing.assert_allclose(back, brightness, rtol=10 * rtol, atol=rtol)


def test_luma_is_the_grey_of_opencv():
    rgb = np.random.default_rng(0).random((4, 5, 3), dtype=np.float32)
    np.testing.assert_allclose(luma(torch.from_numpy(rgb)), cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), atol=1e-5)


def test_luma_of_one_channel_is_that_channel():
    grey = torch.rand(4, 5, 1)
    torch.testing.assert_close(luma(grey), grey[..., 0], rtol=0, atol=0)


@pytest.mark.parametrize(("width", "height"), [(4, 4), (5, 3), (1, 2), (6, 1)])
@pytest.mark.parametrize("pattern", ["RGGB", "GRBG", "BGGR", "RRGB"])
def test_every_pixel_sees_the_channel_of_its_filter(pattern: str, width: int, height: int):
    letters = [pattern[2 * (y % 2) + x % 2] for y in range(height) for x in range(width)]
    channels = ColourFilter(pattern, width).channels(torch.arange(width * height))
    assert channels.dtype == torch.int64
    assert "".join("RGB"[channel] for channel in channels.tolist()) == "".join(letters)


@pytest.mark.parametrize("pattern", ["", "RGB", "RGGBR", "RGBW", "rggb"])
def test_what_is_no_colour_filter_is_refused(pattern: str):
    with pytest.raises(ValueError, match="four letters"):
        ColourFilter(pattern, 4)


def test_a_mosaic_is_that_of_opencv_demosaiced():
    """OpenCV leaves the channel that a pixel sees as it is; it names patterns by the pixels (1, 1) to (2, 2)."""
    mosaic = np.random.default_rng(0).integers(0, 256, (8, 10), dtype=np.uint8)
    rgb = torch.from_numpy(cv2.cvtColor(mosaic, cv2.COLOR_BayerBG2RGB)).float()
    seen = pixel_brightness(rgb, ColourFilter("RGGB", 10).channels(torch.arange(80)).reshape(8, 10))
    np.testing.assert_array_equal(seen[1:-1, 1:-1], mosaic[1:-1, 1:-1])


def test_a_grey_sensor_sees_luma():
    rgb = torch.rand(4, 5, 3)
    torch.testing.assert_close(pixel_brightness(rgb, None), luma(rgb), rtol=0, atol=0)


@pytest.mark.parametrize("response", [Linlog(), Logarithm(0.001), Logarithm(1e-6)])
def test_a_response_rises_and_its_inverse_undoes_it(response):
    brightness = torch.linspace(0.0, 2.0, 1001, dtype=torch.float64)
    levels = response(brightness)
    assert (levels.diff() > 0).all()
    torch.testing.assert_close(response.inverse(levels), brightness, rtol=0, atol=1e-12)


def test_gamma_decodes_brightness_before_the_logarithm():
    encoded = torch.linspace(0.0, 1.5, 301, dtype=torch.float64)
    np.testing.assert_allclose(Gamma()(encoded.numpy()), Gamma()(encoded), rtol=0, atol=1e-14)
    torch.testing.assert_close(Gamma(2.2, 0.1)(encoded), torch.log(encoded**2.2 + 0.1), rtol=0, atol=0)
    torch.testing.assert_close(Gamma(2.2, 0.1)(encoded), Logarithm(0.1)(encoded**2.2), rtol=0, atol=1e-15)
    torch.testing.assert_close(Gamma(1.0, 0.01)(encoded), Logarithm(0.01)(encoded), rtol=0, atol=1e-15)


@pytest.mark.parametrize("offset", [1e-5, 0.1])
def test_gamma_rises_and_its_inverse_undoes_it(offset: float):
    response = Gamma(2.2, offset)
    encoded = torch.linspace(0.01, 2.0, 1001, dtype=torch.float64)
    assert (response(torch.cat([torch.zeros(1), encoded])).diff() > 0).all()
    torch.testing.assert_close(response.inverse(response(encoded)), encoded, rtol=0, atol=1e-11)
    assert response.inverse(response(torch.zeros(1, dtype=torch.float64))).item() == pytest.approx(0.0, abs=1e-7)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("exponent", [1.0, 2.2, 3.0])
def test_gamma_is_finite_in_the_dark_and_in_the_brightest_light_of_a_field(exponent: float, dtype: torch.dtype):
    brightness = torch.tensor([-1e-7, 0.0, 1e-38, 1e-12, 1.0, math.exp(28.0)], dtype=dtype, requires_grad=True)
    levels = Gamma(exponent, 1e-9)(brightness)
    (slope,) = torch.autograd.grad(levels.sum(), brightness)
    assert levels.isfinite().all() and slope.isfinite().all() and (slope >= 0).all()
    assert levels[:3].tolist() == pytest.approx([math.log(1e-9)] * 3)


@pytest.mark.parametrize("response", [Linlog(), Logarithm(0.001), Gamma(2.2, 1e-5), Gamma(2.2, 0.1)])
def test_the_slope_of_a_response_is_that_of_finite_differences(response):
    brightness = torch.linspace(0.001, 1.5, 40, dtype=torch.float64, requires_grad=True)
    torch.autograd.gradcheck(response, brightness, eps=1e-7, atol=1e-5)


def test_the_two_responses_in_the_dark():
    """From a brightness of 0.005 to 0.01 the paper's pixel and a simulator's see different changes."""
    dark = torch.tensor([0.005, 0.01], dtype=torch.float64)
    assert Logarithm(0.001)(dark).diff().item() == pytest.approx(math.log(0.011 / 0.006))
    assert Linlog()(dark).diff().item() == pytest.approx(255 * 0.005 * math.log(20) / 20)


@pytest.mark.parametrize("response", [Linlog(), Logarithm(0.001), Logarithm(0.25), Gamma(), Gamma(1.8, 0.1)])
def test_a_response_is_found_by_its_name(response):
    assert response_named(response.name) == response


@pytest.mark.parametrize(
    "name",
    ["", "log", "linlog:1", "logarithm", "logarithm:", "logarithm:0", "logarithm:nan", "logarithm:1:0.1", "gamma",
     "gamma:2.2", "gamma:2.2:0", "gamma:0.9:0.1", "gamma:3.1:0.1", "gamma:nan:0.1", "gamma:2.2:0.1:1"],
)  # fmt: skip
def test_a_response_that_there_is_not_is_refused(name: str):
    with pytest.raises(ValueError, match=r"linlog, or logarithm:OFFSET .* was expected"):
        response_named(name)


@pytest.mark.parametrize(
    ("offset", "is_taken"),
    [(SMALLEST_OFFSET, True), (LARGEST_OFFSET, True), (0.9 * SMALLEST_OFFSET, False), (1.1 * LARGEST_OFFSET, False)],
)
def test_a_recording_states_what_a_sensor_may_have(offset: float, is_taken: bool):
    name = f"logarithm:{offset!r}"
    assert _is_response(name) == is_taken
    with nullcontext() if is_taken else pytest.raises(ValueError, match="but linlog, or logarithm"):
        response_named(name)
