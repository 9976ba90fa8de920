"""Poses of frames of the event camera by COLMAP, for `enerf convert --poses`; needs `pip install pycolmap`.

    python benchmarks/colmap_poses.py CAMERA.json IMAGES OUTPUT

CAMERA.json is the file of `enerf convert --camera`, or recording.json. The calibration is kept as it is. Images follow
one another in the order of their names. OUTPUT/sparse/0, 1 and so on are models, of which the largest is wanted.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pycolmap  # pyright: ignore[reportMissingImports]  # no dependency of this package

NEIGHBOURS = 20
"""Images after each one that it is matched with."""


def main(camera_file: Path, images: Path, output: Path) -> None:
    camera = json.loads(camera_file.read_text())
    camera = camera.get("camera", camera)
    lens = [*camera.get("distortion", []), 0, 0, 0, 0, 0]
    model, lens = {
        "pinhole": ("PINHOLE", []),
        "radtan": ("FULL_OPENCV", [*lens[:5], 0, 0, 0]),
        "fisheye": ("OPENCV_FISHEYE", lens[:4]),
    }[camera["model"]]
    centre = [camera["cx"] + 0.5, camera["cy"] + 0.5]  # COLMAP counts from the corner of a pixel
    parameters = ",".join(map(str, [camera["fx"], camera["fy"], *centre, *lens]))
    output.mkdir(parents=True)
    database = output / "database.db"
    pycolmap.set_random_seed(0)
    pycolmap.extract_features(
        database,
        images,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=pycolmap.ImageReaderOptions(camera_model=model, camera_params=parameters),
    )
    pycolmap.match_sequential(database, pairing_options=pycolmap.SequentialPairingOptions(overlap=NEIGHBOURS))
    calibrated = pycolmap.IncrementalPipelineOptions(
        ba_refine_focal_length=False,
        ba_refine_principal_point=False,
        ba_refine_extra_params=False,
        num_threads=1,  # several threads give another result each time
        random_seed=0,
    )
    models = pycolmap.incremental_mapping(database, images, output / "sparse", calibrated)
    for number, found in sorted(models.items()):
        error = found.compute_mean_reprojection_error()
        print(f"{output / 'sparse' / str(number)}: {found.num_reg_images()} images, {error:.2f} pixels of error")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
