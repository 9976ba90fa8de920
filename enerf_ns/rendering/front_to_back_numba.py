"""Volume rendering on the CPU by compiled kernels, for pictures.

The kernels compute what `enerf_ns.rendering.ray_samplers`, `front_to_back` and `field` compute with PyTorch. PyTorch
writes every intermediate value to memory. Here a few rays go from samples to brightness while all values stay in the
cache, and blocks of their samples go through hash grid and networks by vector instructions.

A change of samplers, field or rendering needs a change of this module. Its contract is a test in
`tests/method/test_model.py`: with kernels and with PyTorch, a picture is the sum over all samples.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.fields.base_field import get_normalized_directions
from torch import Tensor

from enerf_ns.kernels.hash_grid_numba import find_cells, interpolate, new_cells
from enerf_ns.kernels.network_numba import BLOCK, Layers, layers_of, new_values, pass_through, vectorised
from enerf_ns.kernels.threads import on_threads
from enerf_ns.rendering.density_voxels import DensityVoxels
from enerf_ns.rendering.field import DARKEST, LARGEST_EXPONENT, EnerfField, HashDensity
from enerf_ns.rendering.ray_samplers import PairedProposalSampler, PairedSpacedSampler

RAYS = 32
"""Number of rays that are rendered together."""

TASK = 8 * RAYS
"""Number of rays that a thread takes at a time."""

ROUND = 8
"""Number of samples of a ray in one round. After each round, rays without transmittance are left out."""

PADDING = np.float32(0.01)
"""Added to the weight of each stretch of a ray before sampling, as in Nerfstudio's PDFSampler."""

LOG_DARKEST = np.float32(math.log(DARKEST))
HIGHEST = np.float32(LARGEST_EXPONENT)
ZERO, QUARTER, HALF, ONE, TWO = np.float32(0), np.float32(0.25), np.float32(0.5), np.float32(1), np.float32(2)
ACTIVATIONS = ("sigmoid", "log-sigmoid", "exponential")
"""Names of `enerf_ns.rendering.field.Brightness`; the kernels use the index."""


class Geometry(NamedTuple):
    """A `HashDensity` as arrays: the levels of its hash grid, shape (levels, rows, 2), its network and its box."""

    levels: np.ndarray
    scalings: np.ndarray
    network: Layers
    init_density: np.float32
    low: np.ndarray
    size: np.ndarray
    contraction: bool


@vectorised
def _unit(geometry, x, y, z):
    """Returns a position relative to the box or contracted space, as `HashDensity.unit` does."""
    if geometry.contraction:
        distance = max(abs(x), abs(y), abs(z))
        scale = QUARTER if distance < 1 else QUARTER * (TWO - ONE / distance) / distance
        return HALF + scale * x, HALF + scale * y, HALF + scale * z
    low, size = geometry.low, geometry.size
    return (x - low[0]) / size[0], (y - low[1]) / size[1], (z - low[2]) / size[2]


@vectorised
def _geometry(geometry, points, number, cells, values):
    """Returns densities, then features, at points of shape (3, BLOCK). Overwrites points by positions in the grid."""
    inside = np.empty(BLOCK, np.float32)
    for p in range(number):
        x, y, z = _unit(geometry, points[0, p], points[1, p], points[2, p])
        within = geometry.contraction or (min(x, y, z) > 0 and max(x, y, z) < 1)
        inside[p] = ONE if within else ZERO
        points[0, p] = min(max(x, ZERO), ONE)
        points[1, p] = min(max(y, ZERO), ONE)
        points[2, p] = min(max(z, ZERO), ONE)
    for level in range(len(geometry.levels)):
        find_cells(points, 0, number, geometry.scalings[level], cells)
        interpolate(cells, number, geometry.levels[level], values[0, 2 * level : 2 * level + 2], 0)
    outputs = pass_through(geometry.network, number, values, len(geometry.network.weights))
    for p in range(number):
        outputs[0, p] = geometry.init_density * np.exp(min(outputs[0, p], HIGHEST)) * inside[p]
    return outputs


@vectorised
def _distance(share, near, far, contraction):
    """Returns the distance at a share, from 0 to 1, of a ray. Shares are even in distance. With contraction they are
    even in distance up to 1, and in its inverse beyond, as in mip-NeRF 360."""
    if not contraction:
        return near + share * (far - near)
    low = HALF * near if near < ONE else ONE - HALF / near
    high = HALF * far if far < ONE else ONE - HALF / far
    place = low + share * (high - low)
    return TWO * place if place < HALF else HALF / (ONE - place)


@vectorised
def _resample(weights, edges):
    """Writes edges, as shares of a ray, that divide the sum of weights evenly. The weights are of even stretches."""
    number, stretches = len(weights), len(edges) - 1
    total = ZERO
    for s in range(number):
        total += weights[s] + PADDING
    below, above, stretch = ZERO, (weights[0] + PADDING) / total, 0
    for k in range(stretches + 1):
        height = (np.float32(k) + HALF) / np.float32(stretches + 1)
        while above <= height and stretch < number - 1:
            stretch += 1
            below, above = above, above + (weights[stretch] + PADDING) / total
        share = min(max((height - below) / (above - below), ZERO), ONE)
        edges[k] = (np.float32(stretch) + share) / np.float32(number)


@vectorised
def _expect(rays, r, voxels, field, faint, weights):
    """Writes weights of even stretches of a ray, from densities at the corners of voxels. Weights are 0 where the
    transmittance is almost 0."""
    origins, directions, nears, fars, _ = rays
    top0, top1, top2 = voxels.shape[2] - 2, voxels.shape[1] - 2, voxels.shape[0] - 2
    size0, size1, size2 = np.float32(top0 + 1), np.float32(top1 + 1), np.float32(top2 + 1)
    near, far, parts, light = nears[r], fars[r], np.float32(len(weights)), ONE
    begin = _distance(ZERO, near, far, field.contraction)
    for s in range(len(weights)):
        end = _distance(np.float32(s + 1) / parts, near, far, field.contraction)
        middle = HALF * (begin + end)
        x, y, z = _unit(
            field,
            origins[r, 0] + directions[r, 0] * middle,
            origins[r, 1] + directions[r, 1] * middle,
            origins[r, 2] + directions[r, 2] * middle,
        )
        x, y, z = min(max(x, ZERO), ONE) * size0, min(max(y, ZERO), ONE) * size1, min(max(z, ZERO), ONE) * size2
        # the index of NaN is undefined
        i, j, k = min(max(int(x), 0), top0), min(max(int(y), 0), top1), min(max(int(z), 0), top2)
        x, y, z = x - np.float32(i), y - np.float32(j), z - np.float32(k)
        low = (ONE - y) * ((ONE - x) * voxels[k, j, i] + x * voxels[k, j, i + 1]) + y * (
            (ONE - x) * voxels[k, j + 1, i] + x * voxels[k, j + 1, i + 1]
        )
        high = (ONE - y) * ((ONE - x) * voxels[k + 1, j, i] + x * voxels[k + 1, j, i + 1]) + y * (
            (ONE - x) * voxels[k + 1, j + 1, i] + x * voxels[k + 1, j + 1, i + 1]
        )
        passed = np.exp(-((ONE - z) * low + z * high) * (end - begin))
        weight = light * (ONE - passed)
        weights[s] = weight if weight >= 0 else ZERO  # NaN becomes 0
        light *= passed
        begin = end
        if light <= faint:
            weights[s + 1 :] = ZERO
            break


@vectorised
def _brightness(output, activation):
    """Returns the brightness of `enerf_ns.rendering.field.brightness_of`."""
    if activation == 2:
        return np.exp(HALF * LOG_DARKEST + min(-QUARTER * LOG_DARKEST * output, HIGHEST))
    share = ONE / (ONE + np.exp(-output))
    return share if activation == 0 else np.exp(LOG_DARKEST * (ONE - share))


@vectorised
def _render(rays, first, last, voxels, num_stretches, field, colour, activation, faint, num_samples, pictures):
    """Renders the rays from first to last - 1. If voxels is None, samples lie evenly along each ray."""
    origins, directions, nears, fars, encoded = rays
    rgb, accumulation, depth = pictures
    cells, points = new_cells(), np.empty((3, BLOCK), np.float32)
    field_values, colour_values = new_values(field.network), new_values(colour)
    num_features = field.network.weights[-1].shape[0] - 1
    thin = faint / np.float32(num_samples)
    edges = np.empty((RAYS, num_samples + 1), np.float32)
    densities = np.empty(RAYS * ROUND, np.float32)
    features = np.empty((num_features, RAYS * ROUND), np.float32)
    weights, seen = np.empty(RAYS * ROUND, np.float32), np.empty(RAYS * ROUND, np.int64)
    transmittance, lit = np.empty(RAYS, np.float32), np.empty(RAYS, np.int64)
    found = np.empty(num_stretches, np.float32)
    for start in range(first, last, RAYS):
        num_rays = min(RAYS, last - start)

        for r in range(num_rays):
            for s in range(num_samples + 1):
                edges[r, s] = np.float32(s) / np.float32(num_samples)
        if voxels is not None:
            for r in range(num_rays):
                _expect(rays, start + r, voxels, field, faint, found)
                _resample(found, edges[r])
        for r in range(num_rays):
            for s in range(num_samples + 1):
                edges[r, s] = _distance(edges[r, s], nears[start + r], fars[start + r], field.contraction)

        num_lit = num_rays
        for r in range(num_rays):
            lit[r], transmittance[r] = r, ONE
            depth[start + r, 0] = HALF * (edges[r, num_samples - 1] + edges[r, num_samples])
        for begin in range(0, num_samples, ROUND):
            samples = min(ROUND, num_samples - begin)
            total = num_lit * samples
            for block in range(0, total, BLOCK):
                number = min(BLOCK, total - block)
                for p in range(number):
                    r, s = lit[(block + p) // samples], begin + (block + p) % samples
                    for axis in range(3):
                        middle = HALF * (edges[r, s] + edges[r, s + 1])
                        points[axis, p] = origins[start + r, axis] + directions[start + r, axis] * middle
                outputs = _geometry(field, points, number, cells, field_values)
                densities[block : block + number] = outputs[0, :number]
                for k in range(num_features):
                    features[k, block : block + number] = outputs[1 + k, :number]

            num_seen, still_lit = 0, 0
            for i in range(num_lit):
                r = lit[i]
                light = transmittance[r]
                for s in range(samples):
                    p = i * samples + s
                    near, far = edges[r, begin + s], edges[r, begin + s + 1]
                    passed = np.exp(-densities[p] * (far - near))
                    weights[p] = light * (ONE - passed)
                    before = accumulation[start + r, 0]
                    accumulation[start + r, 0] += weights[p]
                    if before < HALF and accumulation[start + r, 0] >= HALF:
                        depth[start + r, 0] = HALF * (near + far)
                    light *= passed
                    if not weights[p] <= thin:  # NaN counts as seen
                        seen[num_seen] = p
                        num_seen += 1
                transmittance[r] = light

            for block in range(0, num_seen, BLOCK):
                number = min(BLOCK, num_seen - block)
                for p in range(number):
                    r = start + lit[seen[block + p] // samples]
                    for k in range(encoded.shape[1]):
                        colour_values[0, k, p] = encoded[r, k]
                    for k in range(num_features):
                        colour_values[0, encoded.shape[1] + k, p] = features[k, seen[block + p]]
                outputs = pass_through(colour, number, colour_values, len(colour.weights))
                for p in range(number):
                    r = start + lit[seen[block + p] // samples]
                    for channel in range(rgb.shape[1]):
                        rgb[r, channel] += weights[seen[block + p]] * _brightness(outputs[channel, p], activation)

            for i in range(num_lit):
                if not transmittance[lit[i]] <= faint:
                    lit[still_lit] = lit[i]
                    still_lit += 1
            num_lit = still_lit


def _geometry_of(density: HashDensity) -> Geometry:
    scalings, low = density.grid.scalings.numpy(), density.aabb[0].numpy()
    levels = density.grid.table.detach().numpy().reshape(len(scalings), -1, 2)
    size, init_density = density.aabb[1].numpy() - low, np.float32(density.init_density)
    return Geometry(
        levels,
        scalings,
        layers_of(density.network.parameters()),
        init_density,
        low,
        size,
        density.contraction is not None,
    )


def render(
    rays: RayBundle,
    field: EnerfField,
    sampler: PairedSpacedSampler | PairedProposalSampler,
    expected: DensityVoxels | None,
    faint: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Renders rays, without gradients.

    Args:
        rays: Rays on the CPU, shape (rays), with nears and fars.
        field: A field in float32, with two features per level.
        sampler: The sampler, for its number of samples along a ray. Without `expected` they are even in distance. With
            contraction they are even in distance up to 1, and in its inverse beyond.
        expected: Density by which samples are placed: the weights along a ray are shared evenly between them. None
            where the sampler has no proposal network.
        faint: Transmittance at which a ray ends. Samples of small weight are left out; their sum is at most `faint`,
            too.

    Returns:
        Brightness (rays, channels) before a black background, accumulation (rays, 1), and median depth along the ray
        (rays, 1) in scene units.
    """
    assert rays.nears is not None and rays.fars is not None
    directions, encoded = rays.directions, rays.directions[:, :0]
    if field.direction_encoding is not None:
        encoded = field.direction_encoding(get_normalized_directions(directions))
    given = (rays.origins, directions, rays.nears[:, 0], rays.fars[:, 0], encoded)
    inputs = tuple(tensor.detach().float().contiguous().numpy() for tensor in given)
    rgb = torch.zeros(len(rays), field.num_channels)
    accumulation, depth = torch.zeros(len(rays), 1), torch.zeros(len(rays), 1)
    pictures = (rgb.numpy(), accumulation.numpy(), depth.numpy())
    voxels, num_stretches = None, 0
    if expected is not None and isinstance(sampler, PairedProposalSampler):
        voxels, num_stretches = expected.values().contiguous().numpy(), sampler.num_proposal_samples_per_ray[0]
        num_samples = sampler.num_nerf_samples_per_ray
    else:
        num_samples = sampler.num_samples
    geometry, colour = _geometry_of(field.geometry), layers_of(field.colour_network.parameters())
    activation = ACTIVATIONS.index(field.brightness)

    def task(index: int) -> None:
        first, last = TASK * index, min(TASK * (index + 1), len(rays))
        _render(
            inputs, first, last, voxels, num_stretches, geometry, colour, activation, np.float32(faint), num_samples,
            pictures,
        )  # fmt: skip

    on_threads(task, -(-len(rays) // TASK))
    return rgb, accumulation.nan_to_num(), depth
