"""Specifications for nerfbaselines: the method, recordings as data sets that carry events, and the protocol.

nerfbaselines loads this module by the entry point `nerfbaselines.specs`, and nothing else does. It loads nothing but
nerfbaselines, which wants numpy below 2 and is no dependency of this package.
"""

from __future__ import annotations

from importlib import import_module

register = import_module("nerfbaselines").register

ROOM = "enerf_ns.nerfbaselines"

PAPER = {
    "paper_title": "E-NeRF: Neural Radiance Fields from a Moving Event Camera",
    "paper_authors": ["Simon Klenk", "Lukas Koestler", "Davide Scaramuzza", "Daniel Cremers"],
    "paper_link": "https://arxiv.org/pdf/2208.11300.pdf",
}

register({"id": "log-affine-set", "evaluation_protocol_class": f"{ROOM}.protocol:LogAffineSet"})

register({"id": "enerf-recording", "load_dataset_function": f"{ROOM}.recordings:load_recording"})

register(
    {
        "id": "enerf-simulated",
        "download_dataset_function": f"{ROOM}.recordings:simulate_scene",
        "evaluation_protocol": "log-affine-set",
        "metadata": {
            "id": "enerf-simulated",
            "name": "E-NeRF, simulated",
            "description": "Scenes that enerf simulate renders: events of a shaking camera, and held-out frames.",
            **PAPER,
            "metrics": ["psnr", "ssim"],
            "default_metric": "psnr",
            "scenes": [{"id": scene, "name": scene} for scene in ("shapes", "board", "carpet", "roads", "moon")],
        },
    }
)

register(
    {
        "id": "enerf",
        "method_class": f"{ROOM}.method:EnerfMethod",
        "conda": {
            "environment_name": "enerf",
            "python_version": "3.11",
            "install_script": "pip install enerf-ns 'numpy<2'\n",
        },
        "metadata": {
            "name": "E-NeRF",
            "description": "A radiance field that learns from the events of an event camera.",
            **PAPER,
            "licenses": [{"name": "MIT"}],
        },
        "presets": {},
        "implementation_status": {"enerf-simulated": "working"},
    }
)
