from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def firenet_weights(shared_data: Path) -> Path:
    """FireNet as its authors published it."""
    path = shared_data / "firenet" / "firenet_1000.pth"
    if not path.is_file():
        pytest.skip(f"no weights of FireNet at {path}")
    return path
