"""Rays rendered per second on this machine, and difference of the picture from the sum over all samples.

Takes turns between ways to render the first held-out camera of a run, and prints a Markdown table: rays a second (the
best of the repetitions), and PSNR against every sample of every ray, which is what Nerfstudio's own parts compute.

    python benchmarks/rendering.py outputs/demo/runs/recording/enerf/TIME
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.field_components.field_heads import FieldHeadNames
from torch import Tensor

from enerf_ns.evaluation.metrics import psnr
from enerf_ns.method.model import EnerfModel
from enerf_ns.method.runs import load
from enerf_ns.method.stopwatch import seconds_of
from enerf_ns.rendering.ray_samplers import PairedProposalSampler

REPETITIONS = 7


@torch.no_grad()
def every_sample(model: EnerfModel, rays: RayBundle) -> Tensor:
    """Brightness (rays, channels) from all samples, of the proposal network and of the field, with normals."""
    pieces, at_once = [], model.config.eval_num_rays_per_chunk
    for start in range(0, len(rays), at_once):
        piece = model.collider(rays.get_row_major_sliced_ray_bundle(start, start + at_once))
        sampler = model.sampler
        if isinstance(sampler, PairedProposalSampler) and model.proposal is not None:
            even = sampler.initial_sampler(piece, num_samples=sampler.num_proposal_samples_per_ray[0])
            weights = even.get_weights(model.proposal.density_fn(even.frustums.get_positions()))
            samples = sampler.pdf_sampler(piece, even, weights, num_samples=sampler.num_nerf_samples_per_ray)
        else:
            samples = sampler(piece)
        field = model.field(samples)
        weights = samples.get_weights(field[FieldHeadNames.DENSITY])
        depth = model.renderer_depth(weights=weights, ray_samples=samples)
        model.normals(piece.origins + piece.directions * depth)
        pieces.append((weights * field[FieldHeadNames.RGB]).sum(dim=-2))
    return torch.cat(pieces)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("run", type=Path)
    flags = parser.parse_args()
    run = load(flags.run / "config.yml" if flags.run.is_dir() else flags.run)
    pipeline, model = run.pipeline.eval(), run.pipeline.model
    camera = pipeline.datamanager.eval_dataset.cameras[:1].to(pipeline.device)
    rays = camera.generate_rays(camera_indices=0, keep_shape=True)
    ways: dict[str, Callable[[], Tensor]] = {
        "every sample, and normals": lambda: every_sample(model, rays),
        "as it is": lambda: model.get_outputs_for_camera_ray_bundle(rays)["rgb"],
    }
    times: dict[str, list[float]] = {name: [] for name in ways}
    shown = {name: way().reshape(len(rays), -1)[:, :1] for name, way in ways.items()}
    for _ in range(REPETITIONS):
        for name, way in ways.items():
            times[name].append(seconds_of(way, pipeline.device))
    whole = shown["every sample, and normals"]
    device = (
        torch.cuda.get_device_name() if pipeline.device.type == "cuda" else f"CPU, {torch.get_num_threads()} threads"
    )
    print(f"PyTorch {torch.__version__}, {device}, {len(whole)} rays, best of {REPETITIONS}\n")
    print("| | rays a second | ratio | dB to every sample |\n| --- | --- | --- | --- |")
    for name in ways:
        rate, slowest = (len(whole) / min(times[way]) for way in (name, "every sample, and normals"))
        score = "-" if shown[name] is whole else psnr(shown[name], whole)
        told = score if isinstance(score, str) else f"{score:.1f}"
        print(f"| {name} | {rate:,.0f} | {rate / slowest:.2f} | {told} |")


if __name__ == "__main__":
    main()
