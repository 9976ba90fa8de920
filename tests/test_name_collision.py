"""Another package that registers the name enerf, as SaENeRF does; what its page says of it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from nerfstudio.plugins.registry import discover_methods

ROOT = Path(__file__).parents[1]


@pytest.fixture
def other_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A package that is found before this one."""
    (tmp_path / "other-1.0.dist-info").mkdir()
    (tmp_path / "other-1.0.dist-info/METADATA").write_text("Name: other\nVersion: 1.0\n")
    points = "[nerfstudio.method_configs]\nenerf = other_methods:enerf\n"
    (tmp_path / "other-1.0.dist-info/entry_points.txt").write_text(points)
    (tmp_path / "other_methods.py").write_text(
        "from nerfstudio.engine.trainer import TrainerConfig\n"
        "from nerfstudio.plugins.types import MethodSpecification\n"
        "enerf = MethodSpecification(TrainerConfig(method_name='enerf'), 'Another method.')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delenv("NERFSTUDIO_METHOD_CONFIGS", raising=False)


def test_the_package_that_is_found_first_has_the_name_and_nobody_is_told(other_first, capsys):
    methods, descriptions = discover_methods()
    assert descriptions["enerf"] == "Another method." and "enerf-paper" in methods
    assert capsys.readouterr().out == ""


def test_the_variable_of_the_readme_gives_the_name_back(other_first, monkeypatch: pytest.MonkeyPatch):
    (value,) = re.findall(r"export NERFSTUDIO_METHOD_CONFIGS=(\S+)", (ROOT / "docs" / "limits.md").read_text())
    monkeypatch.setenv("NERFSTUDIO_METHOD_CONFIGS", value)
    assert discover_methods()[1]["enerf"].startswith("E-NeRF")
