"""Figure of the corrections of a trajectory."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.report.figures import COLOURS, GREY, WIDTH, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INSTANTS = 400
"""Number of instants that are drawn."""


def corrections_over_time(recording: EventRecording) -> Figure | None:
    """Figure of a recorded and a refined path; None if the poses were not refined.

    The view is along the axis in which the path is shortest. Two plots below show the shift in mm and the rotation in
    degrees between both paths over time, in the axes of the camera.
    """
    if recording.as_read is None:
        return None
    from matplotlib.figure import Figure

    times = recording.instants(INSTANTS)
    stated, refined = (
        trajectory.poses(torch.from_numpy(times)).numpy()
        for trajectory in (recording.as_read.trajectory, recording.trajectory)
    )
    back = stated[:, :, :3].transpose(0, 2, 1)
    shift = 1e3 * (back @ (refined[:, :, 3:] - stated[:, :, 3:]))[..., 0]
    turn = np.degrees(Rotation.from_matrix(back @ refined[:, :, :3]).as_rotvec())
    seconds = 1e-9 * times
    across, up = sorted(np.argsort(np.ptp(refined[:, :, 3], axis=0))[1:])

    figure = Figure(figsize=(WIDTH, 7.0), layout="constrained", dpi=150)
    path, *others = figure.subplots(3, 1, height_ratios=(2, 1, 1))
    path.plot(*stated[:, (across, up), 3].T, color=GREY, linestyle="--", label="recorded")
    path.plot(*refined[:, (across, up), 3].T, color=COLOURS[0], label="refined")
    path.set_xlabel(f"{'xyz'[across]}, m")
    path.set_ylabel(f"{'xyz'[up]}, m")
    path.set_aspect("equal", adjustable="datalim")
    path.legend(frameon=False)
    for axis, values, label in zip(others, (shift, turn), ("shift, mm", "rotation, degrees"), strict=True):
        for number, name in enumerate(("x, right", "y, down", "z, forward")):
            axis.plot(seconds, values[:, number], color=COLOURS[number], label=name)
        axis.set_ylabel(label)
    others[0].legend(frameon=False, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    others[1].sharex(others[0])
    others[1].set_xlabel("time, s")
    for axis in (path, *others):
        plain(axis)
    return figure
