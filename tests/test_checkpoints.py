"""In processes of their own, since what torch may load is a global of its."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SAVE = "import numpy as np, torch; torch.save({'lr': np.float64(0.01), 'other': np.float32(2.0)}, %r)"
LOAD = "import torch; %s; print(float(torch.load(%r, weights_only=True)['lr']))"


@pytest.mark.parametrize("allowed", [False, True])
def test_learning_rates_that_are_numpy_scalars_can_be_loaded(tmp_path: Path, allowed: bool):
    file = str(tmp_path / "checkpoint.pt")
    subprocess.run([sys.executable, "-c", SAVE % file], check=True)
    first = "from enerf_ns.checkpoints import allow_numpy_scalars_in_checkpoints as allow; allow()" if allowed else "1"
    run = subprocess.run([sys.executable, "-c", LOAD % (first, file)], capture_output=True, text=True)
    assert run.stdout == ("0.01\n" if allowed else "")
    assert allowed or "Unsupported" in run.stderr
