"""The fast hash grid for other methods of Nerfstudio."""

from __future__ import annotations

from jaxtyping import Float
from nerfstudio.field_components.encodings import HashEncoding
from torch import Tensor, nn

from enerf_ns.kernels.hash_grid import fitting


class FastHashEncoding(HashEncoding):
    """Nerfstudio's HashEncoding with `implementation="torch"`, computed by the backend that "auto" selects.

    Parameters, values and checkpoints are the same.
    """

    def pytorch_fwd(self, in_tensor: Float[Tensor, "*bs 3"]) -> Float[Tensor, "*bs encoding"]:
        """Returns the encoding of positions in [0, 1]."""
        if self.scalings.device != in_tensor.device:
            self.scalings = self.scalings.to(in_tensor.device)
        return fitting("auto", in_tensor, self.hash_table)(in_tensor, self.hash_table, self.scalings)


def speed_up_hash_grids(module: nn.Module) -> int:
    """Turns every HashEncoding with `implementation="torch"` inside a module into a `FastHashEncoding`, in place.

    Args:
        module: Any module, such as the model of a Nerfstudio method. Encodings of tiny-cuda-nn are left unchanged.

    Returns:
        The number of encodings that were changed.
    """
    found = [part for part in module.modules() if type(part) is HashEncoding and part.tcnn_encoding is None]
    for encoding in found:
        encoding.__class__ = FastHashEncoding
    return len(found)
