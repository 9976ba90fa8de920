from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import curve_fit
from torch import Tensor

from enerf_ns.evaluation.protocols import DARKEST, DEFAULT_PROTOCOL, EVENTS_PROTOCOL, PROTOCOLS, align, described
from enerf_ns.sensor.response import inverse_linlog, linlog

FITTED = [name for name, protocol in PROTOCOLS.items() if protocol.fit is not None]


def pictures(count: int, seed: int = 0) -> list[Tensor]:
    """Pictures of different mean brightness, float64 [12, 16, 3], from 0.05 to 0.75."""
    random = np.random.default_rng(seed)
    return [torch.from_numpy(0.05 + 0.2 * i + 0.3 * random.random((12, 16, 3))) for i in range(count)]


def columns(images: list[Tensor]) -> np.ndarray:
    """Pixels of all pictures, a column a channel."""
    return torch.cat([image.reshape(-1, 3) for image in images]).numpy()


def line(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Scale and offset by NumPy."""
    return np.linalg.lstsq(np.column_stack([x.ravel(), np.ones(x.size)]), y.ravel(), rcond=None)[0]


def distort(name: str, image: Tensor) -> tuple[Tensor, dict[str, float]]:
    """What a protocol can undo, in closed form, and the parameters by which it does."""
    if name == "eventnerf":
        known = {
            f"brightness_{key}_{colour}": value
            for key, value in (("scale", 0.8), ("offset", 0.1))
            for colour in ("red", "green", "blue")
        }
        return torch.exp(0.8 * torch.log(image + 0.1) + 0.1) - 0.1, known
    if name == "gamma-affine":
        return 0.7 * image**1.4 + 0.05, {"gamma_factor": 0.7, "gamma_power": 1.4, "gamma_offset": 0.05}
    if name == "log-offset":
        return inverse_linlog(linlog(image) + 0.2), {"brightness_offset": 0.2}
    known = {"brightness_scale": 0.8, "brightness_offset": 0.5}
    return inverse_linlog(0.8 * linlog(image) + 0.5), {} if name == "log-affine-image" else known


@pytest.mark.parametrize("name", FITTED)
def test_a_fit_recovers_what_is_known(name: str):
    rendered = pictures(3)
    made = [distort(name, image) for image in rendered]
    aligned = align(rendered, [image for image, _ in made], name)
    assert aligned.faults == [None] * 3
    assert aligned.parameters == pytest.approx(made[0][1], abs=1e-6)
    for image, truth in zip(aligned.rendered, aligned.recorded, strict=True):
        torch.testing.assert_close(image, truth, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["log-affine-set", "log-affine-image", "log-offset", "gamma-affine"])
def test_channels_of_a_sensor_with_a_colour_filter_are_fitted_by_themselves(name: str):
    """Each channel by the same closed form, after a gain of its own."""
    gains = torch.tensor([0.8, 1.0, 1.2], dtype=torch.float64)
    rendered = [image + 0.15 for image in pictures(2)]  # above the linear part of linlog
    recorded = [distort(name, image)[0] * gains for image in rendered]
    together, apart = align(rendered, recorded, name), align(rendered, recorded, name, colour_filter=True)
    for image, truth, worse in zip(apart.rendered, recorded, together.rendered, strict=True):
        torch.testing.assert_close(image, truth, rtol=0, atol=1e-6)
        assert (worse - truth).abs().max() > 0.02
    if name == "log-affine-set":
        for colour, gain in zip(("red", "green", "blue"), gains.tolist(), strict=True):
            assert apart.parameters[f"brightness_scale_{colour}"] == pytest.approx(0.8, abs=1e-6)
            assert apart.parameters[f"brightness_offset_{colour}"] == pytest.approx(0.5 + np.log(gain), abs=1e-6)
    if name == "gamma-affine":
        expected = {"gamma_power": 1.4}
        for colour, gain in zip(("red", "green", "blue"), gains.tolist(), strict=True):
            expected |= {f"gamma_factor_{colour}": 0.7 * gain, f"gamma_offset_{colour}": 0.05 * gain}
        assert apart.parameters == pytest.approx(expected, abs=1e-6)


def test_log_affine_set_is_the_least_squares_of_numpy_over_all_pictures_together():
    rendered, recorded = pictures(3), pictures(3, seed=1)
    x, y = linlog(columns(rendered)), linlog(columns(recorded))
    found = align(rendered, recorded, "log-affine-set").parameters
    np.testing.assert_allclose([found["brightness_scale"], found["brightness_offset"]], line(x, y), rtol=1e-9)
    found = align(rendered, recorded, "log-affine-set", colour_filter=True).parameters
    for channel, colour in enumerate(("red", "green", "blue")):
        fit = [found[f"brightness_{name}_{colour}"] for name in ("scale", "offset")]
        np.testing.assert_allclose(fit, line(x[:, channel], y[:, channel]), rtol=1e-9)


def test_log_affine_image_is_the_least_squares_of_numpy_of_each_picture():
    rendered, recorded = pictures(3), [0.3 * a + 0.7 * b for a, b in zip(pictures(3), pictures(3, seed=1), strict=True)]
    aligned = align(rendered, recorded, "log-affine-image")
    assert aligned.parameters == {}
    for image, shown, truth in zip(rendered, aligned.rendered, recorded, strict=True):
        scale, offset = line(linlog(image).numpy(), linlog(truth).numpy())
        torch.testing.assert_close(shown, inverse_linlog(scale * linlog(image) + offset), rtol=0, atol=1e-9)


def test_log_offset_is_the_difference_of_means():
    rendered, recorded = pictures(3), pictures(3, seed=1)
    expected = linlog(columns(recorded)).mean() - linlog(columns(rendered)).mean()
    assert align(rendered, recorded, "log-offset").parameters == pytest.approx({"brightness_offset": expected})


def test_eventnerf_is_its_definition_written_out_on_gamma_encoded_pictures():
    """Of pictures as EventNeRF's evaluation reads them, in [0, 1]: linear brightness to the power of 1 / 2.2."""
    rendered, recorded = pictures(3), [0.5 * a + 0.5 * b for a, b in zip(pictures(3), pictures(3, seed=1), strict=True)]
    prediction, truth = (columns(images) ** (1 / 2.2) for images in (rendered, recorded))
    a, b = np.log(prediction**2.2 + 0.1), np.log(truth**2.2 + 0.1)
    corrected = np.empty_like(a)
    for channel in range(3):
        slope, offset = np.polyfit(a[:, channel], b[:, channel], 1)
        corrected[:, channel] = np.maximum(0, np.exp(slope * a[:, channel] + offset) - 0.1) ** (1 / 2.2)
    aligned = align(rendered, recorded, "eventnerf")
    np.testing.assert_allclose(columns(aligned.rendered), corrected, atol=1e-9)
    np.testing.assert_allclose(columns(aligned.recorded), truth, atol=1e-12)


def test_gamma_affine_is_the_least_squares_of_scipy():
    rendered, recorded = pictures(3), [0.5 * a + 0.5 * b for a, b in zip(pictures(3), pictures(3, seed=1), strict=True)]
    x, y = columns(rendered).ravel(), columns(recorded).ravel()
    expected = curve_fit(lambda x, a, b, c: a * x**b + c, x, y, p0=(1.0, 1.0, 0.0), xtol=1e-12, ftol=1e-12)[0]
    found = align(rendered, recorded, "gamma-affine").parameters
    names = ("gamma_factor", "gamma_power", "gamma_offset")
    np.testing.assert_allclose([found[name] for name in names], expected, rtol=1e-5)


def test_gamma_affine_takes_black_as_dark():
    rendered = pictures(2)
    rendered[0][0, 0] = 0.0
    recorded = [0.7 * image.clamp(min=DARKEST) ** 1.4 + 0.05 for image in rendered]
    found = align(rendered, recorded, "gamma-affine").parameters
    assert found == pytest.approx({"gamma_factor": 0.7, "gamma_power": 1.4, "gamma_offset": 0.05}, abs=1e-6)


def test_raw_leaves_pictures_as_they_are():
    rendered, recorded = [2.0 * image for image in pictures(2)], pictures(2, seed=1)
    flat = [torch.full((12, 16, 3), 0.4)] * 2
    for renders in (rendered, flat):
        aligned = align(renders, recorded, "raw", colour_filter=True)
        assert aligned.faults == [None] * 2 and aligned.parameters == {}
        for image, same in zip(aligned.rendered + aligned.recorded, renders + recorded, strict=True):
            torch.testing.assert_close(image, same, rtol=0, atol=0)


@pytest.mark.parametrize("name", FITTED)
@pytest.mark.parametrize("colour_filter", [False, True])
def test_what_is_flat_is_refused(name: str, colour_filter: bool):
    sound, flat = pictures(2), [torch.full((12, 16, 3), 0.1, dtype=torch.float64)] * 2
    for rendered, recorded in ((flat, sound), (sound, flat), (flat, flat)):
        aligned = align(rendered, recorded, name, colour_filter)
        assert all(
            str(fault).startswith("no correction of brightness can be fitted, since") for fault in aligned.faults
        )
        assert aligned.parameters == {}
        for image, same in zip(aligned.rendered, rendered, strict=True):
            torch.testing.assert_close(image, PROTOCOLS[name].encode(same))


@pytest.mark.parametrize("name", [name for name in FITTED if name != "log-offset"])
def test_a_negative_is_refused(name: str):
    recorded = pictures(2)
    negative = [inverse_linlog(7.0 - 0.61 * linlog(image)) for image in recorded]
    faults = align(negative, recorded, name).faults
    assert all(str(fault).startswith("the render is a negative of the frame (brightness scale -") for fault in faults)
    red = [torch.cat([a[..., :1], b[..., 1:]], -1) for a, b in zip(negative, recorded, strict=True)]
    assert all("negative" in str(fault) for fault in align(red, recorded, name, colour_filter=True).faults)
    assert "-1.64" in str(align(negative, recorded, DEFAULT_PROTOCOL).faults[0]), "1 / 0.61"


@pytest.mark.parametrize("name", PROTOCOLS)
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_render_that_is_not_finite_leaves_the_fit_of_the_others_as_it_would_be_without(name: str, value: float):
    rendered, recorded = pictures(3), [distort(name, image)[0] for image in pictures(3)]
    without = align(rendered[::2], recorded[::2], name)
    spoilt = rendered[1].clone()
    spoilt[3, 4, 0] = value
    aligned = align([rendered[0], spoilt, rendered[2]], recorded, name)
    assert aligned.parameters == without.parameters and aligned.faults == [None] * 3
    for image, expected in zip(aligned.rendered[::2], without.rendered, strict=True):
        torch.testing.assert_close(image, expected, rtol=0, atol=0)
    assert not aligned.rendered[1].isfinite().all()
    nothing = align([spoilt], recorded[:1], name)
    assert nothing.parameters == {} and nothing.faults == [None]


@pytest.mark.parametrize("name", PROTOCOLS)
def test_pictures_keep_their_type(name: str):
    rendered, recorded = ([image.float() for image in pictures(2, seed)] for seed in (0, 1))
    aligned = align(rendered, recorded, name)
    assert all(image.dtype == torch.float32 for image in aligned.rendered + aligned.recorded)


def test_each_protocol_is_described_in_sentences():
    assert list(PROTOCOLS) == ["log-affine-set", "log-affine-image", "log-offset", "eventnerf", "gamma-affine", "raw"]
    for name in (*PROTOCOLS, EVENTS_PROTOCOL):
        sentence = described(name)
        assert sentence.startswith(f"Protocol {name}: ") and sentence.endswith(".")
