"""What layouts ask, against the data sets that they are of."""

from __future__ import annotations

import json

import numpy as np
from scipy.spatial.transform import Rotation

from enerf_ns.simulator.layouts import LAYOUTS


def test_the_published_cameras_of_tum_vie_are_those_of_its_calibration(shared_data):
    stated = json.loads((shared_data / "tum_vie/camera-calibrationA.json").read_text())["value0"]
    rig = LAYOUTS["tum_vie"].published_rig
    assert rig is not None
    event_camera, frame_camera, event_from_frame = rig
    poses = []
    for index, camera in ((2, event_camera), (0, frame_camera)):
        lens = stated["intrinsics"][index]["intrinsics"]
        assert [camera.width, camera.height] == stated["resolution"][index] and camera.model == "fisheye"
        assert (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion) == tuple(lens.values())
        mount, pose = stated["T_imu_cam"][index], np.eye(4)
        pose[:3, :3] = Rotation.from_quat([mount[f"q{axis}"] for axis in "xyzw"]).as_matrix()
        pose[:3, 3] = [mount[f"p{axis}"] for axis in "xyz"]
        poses.append(pose)
    np.testing.assert_allclose(poses[0] @ event_from_frame, poses[1], atol=1e-12)
