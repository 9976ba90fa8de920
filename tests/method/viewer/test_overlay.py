from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.index.event_index import OFF_COLOUR, ON_COLOUR, EventIndex
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import Events
from enerf_ns.method.viewer.overlay import EVENT_OPACITY, draw_events, for_the_eye, recent_events

CAMERA = Camera(8, 6, 7.0, 7.0, 3.5, 2.5)


def some_events(number: int = 400) -> Events:
    random = np.random.default_rng(0)
    t = np.sort(random.integers(0, 1000, number))
    x, y = (random.integers(0, side, number).astype(np.uint16) for side in (8, 6))
    return Events(x, y, t, random.choice(np.array([-1, 1], np.int8), number))


@pytest.mark.parametrize(("first", "last"), [(200, 320), (-5, 1000), (-1, 0), (990, 5000), (400, 400)])
def test_recent_events_are_those_of_a_loop(first: int, last: int):
    events = some_events()
    expected = np.zeros((6, 8, 2), np.uint8)
    for y in range(6):
        for x in range(8):
            chosen = (events.x == x) & (events.y == y) & (events.t > first) & (events.t <= last)
            if chosen.any():
                expected[y, x, 0 if events.p[chosen].sum() > 0 else 1] = 255
    found = recent_events(EventIndex.from_events(events, 8, 6), CAMERA, first, last)
    np.testing.assert_array_equal(found, expected)
    assert found.any() == (first < last and last > 0)


def test_events_are_drawn_where_the_sensor_sees_the_points():
    """Points are made from pixels, at any depth; other points, also those behind the sensor, keep their colour."""
    pose = np.column_stack([Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix(), [1.0, -2.0, 0.5]])
    events = np.zeros((6, 8, 2), np.uint8)
    events[2, 5, 0] = events[4, 1, 1] = 255
    seen_at = {(5, 2): ON_COLOUR, (1, 4): OFF_COLOUR, (5, 3): None, (9, 2): None, (5, -1): None}
    points, colours = [], []
    for (column, row), colour in seen_at.items():
        for depth in (0.4, 3.0, -2.0):
            along = np.array([(column - 3.5) / 7.0, (row - 2.5) / 7.0, 1.0]) * depth
            points.append(pose[:, :3] @ along + pose[:, 3])
            colours.append(None if depth < 0 else colour)
    rgb = torch.rand(len(points), 3, generator=torch.Generator().manual_seed(1))
    drawn = draw_events(rgb, torch.from_numpy(np.stack(points)).float(), events, CAMERA, pose)
    for before, after, colour in zip(rgb, drawn, colours, strict=True):
        expected = before
        if colour is not None:
            expected = (1 - EVENT_OPACITY) * before + EVENT_OPACITY * torch.tensor(colour) / 255
        torch.testing.assert_close(after, expected)


def test_the_eye_sees_stops_and_gamma():
    brightness = torch.tensor([[0.1, 0.2, 0.4], [0.5, 0.6, 3.0]])
    torch.testing.assert_close(for_the_eye(brightness, 0.0, 1.0), brightness.clamp(max=1.0))
    torch.testing.assert_close(for_the_eye(brightness[:1], 1.0, 1.0), 2.0 * brightness[:1])
    expected = torch.tensor([[0.05**0.5, 0.1**0.5, 0.2**0.5]])
    torch.testing.assert_close(for_the_eye(brightness[:1], -1.0, 2.0), expected)
