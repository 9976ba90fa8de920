from __future__ import annotations

from pathlib import Path

import pytest

from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.inspection.page import Inspection


@pytest.fixture(scope="session")
def slider_depth(shared_data: Path) -> Inspection:
    """A real recording, inspected, which takes seconds."""
    return Inspection.of(read_recording(shared_data / "slider_depth"))
