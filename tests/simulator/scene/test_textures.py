from __future__ import annotations

import numpy as np
import pytest

from enerf_ns.simulator.scene import textures

RNG = np.random.default_rng


def test_the_pyramid_holds_means_of_four_down_to_one_texel():
    image = RNG(0).uniform(size=(8, 8, 3)).astype(np.float32)
    pyramid = textures.mip_pyramid(image)
    assert pyramid.shape == (64 + 16 + 4 + 1, 3) and pyramid.dtype == np.float32
    np.testing.assert_array_equal(pyramid[:64].reshape(8, 8, 3), image)
    for size in (8, 4, 2):
        start, following = 4 * (64 - size**2) // 3, 4 * (64 - (size // 2) ** 2) // 3
        finer = pyramid[start : start + size**2].reshape(size, size, 3)
        for row, column in np.ndindex(size // 2, size // 2):
            mean = finer[2 * row : 2 * row + 2, 2 * column : 2 * column + 2].mean((0, 1))
            np.testing.assert_allclose(pyramid[following + row * (size // 2) + column], mean, atol=1e-6)
    np.testing.assert_allclose(pyramid[-1], image.mean((0, 1)), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", textures.PROCEDURAL)
def test_procedural_textures_are_squares_within_their_range(name):
    levels = textures.PROCEDURAL[name].make(RNG(0))
    assert levels.dtype == np.float32 and levels.shape[0] == levels.shape[1]
    assert 0 <= levels.min() and levels.max() <= 1
    assert len(levels) & (len(levels) - 1) == 0


@pytest.mark.parametrize("name", [pytest.param("roads", marks=pytest.mark.slow), "wood", "clouds"])
def test_textures_that_repeat_have_no_seam(name):
    levels = textures.PROCEDURAL[name].make(RNG(0))
    for axis in (0, 1):
        steps = np.abs(levels - np.roll(levels, 1, axis)).mean(axis=tuple({0, 1, levels.ndim - 1} - {axis}))
        assert steps[0] <= np.quantile(steps, 0.99)
