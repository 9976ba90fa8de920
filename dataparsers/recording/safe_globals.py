"""Types that torch may load from a checkpoint of any method of Nerfstudio."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch


def allow_numpy_scalars_in_checkpoints() -> None:
    """Allows torch 2.6 and later to load the learning rates that Nerfstudio's scheduler stores as NumPy scalars."""
    scalar: Any = np.float64(0).__reduce__()[0]
    torch.serialization.add_safe_globals(
        [
            scalar,
            (scalar, "numpy.core.multiarray.scalar"),
            (scalar, "numpy._core.multiarray.scalar"),
            np.dtype,
            type(np.dtype(np.float64)),
            type(np.dtype(np.float32)),
        ]
    )
