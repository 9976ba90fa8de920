"""`enerf fetch-lpips`: download the weights that LPIPS needs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from enerf_ns.dataparsers.recording.errors import printable
from enerf_ns.evaluation.lpips import Net, fetch_weights


@dataclass
class FetchLpips:
    """Download the weights that LPIPS needs, for the methods of this package and of Nerfstudio."""

    networks: Annotated[tuple[Net, ...], tyro.conf.Positional] = ("alex",)
    """Networks of LPIPS: alex (AlexNet, 233 MB), vgg (VGG-16, 528 MB)."""

    def main(self) -> None:
        for net in self.networks:
            print(printable(f"The weights of LPIPS with {net} are in {fetch_weights(net)}"))
