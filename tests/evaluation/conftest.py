from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def no_lpips(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No test downloads weights."""
    for variable in ("ENERF_LPIPS_WEIGHTS", "ENERF_LPIPS_VGG_WEIGHTS"):
        monkeypatch.setenv(variable, str(tmp_path / "no-weights"))
