"""The registration that Nerfstudio asks of an external method, against the installed Nerfstudio and this package."""

from __future__ import annotations

import re
from importlib.metadata import distribution
from pathlib import Path

import pytest
from nerfstudio.configs import external_methods
from nerfstudio.configs.external_methods import ExternalMethod

FOLDER = Path(__file__).parents[1] / "contrib" / "nerfstudio"


def entry() -> ExternalMethod:
    """The entry; Nerfstudio's own list stays as it is."""
    code, known = (FOLDER / "external_method.py").read_text(), external_methods.external_methods
    before = list(known)
    try:
        exec(compile(code, "external_method.py", "exec"), {})
        (added,) = known[len(before) :]
    finally:
        known[:] = before
    return added


def test_the_entry_registers_every_method_of_this_package_and_no_other():
    slugs = [slug for slug, _ in entry().configurations]
    points = distribution("enerf-ns").entry_points
    assert sorted(slugs) == sorted(point.name for point in points if point.group == "nerfstudio.method_configs")
    taken = {slug for method in external_methods.external_methods for slug, _ in method.configurations}
    assert not taken & set(slugs)


def test_nerfstudio_offers_every_method_of_the_entry(monkeypatch: pytest.MonkeyPatch):
    """As its ns-train does where this package is not installed."""
    added = entry()
    monkeypatch.setattr(external_methods, "external_methods", [*external_methods.external_methods, added])
    configs, descriptions = external_methods.get_external_methods()
    for slug, text in added.configurations:
        assert configs[slug].method.pip_package == distribution("enerf-ns").metadata["Name"]
        assert descriptions[slug] == f"[External, run 'ns-train {slug}' to install] {text}"


def test_the_entry_is_shown_by_nerfstudio_and_names_the_page_and_one_command():
    added = entry()
    assert isinstance(added.instructions, str) and added.pip_package == "enerf-ns"
    assert f"pip install {added.pip_package}" in added.instructions
    assert f"https://docs.nerf.studio/nerfology/methods/{(FOLDER / 'enerf.md').stem}.html" in added.instructions
    assert all(isinstance(text, str) and text for pair in added.configurations for text in pair)


def test_the_page_has_the_parts_that_pages_of_methods_have():
    page = (FOLDER / "enerf.md").read_text()
    assert page.startswith("# ") and page.count("{button-link} https://") == 2
    assert re.findall(r"^## (.+)$", page, re.MULTILINE)[:3] == ["Installation", "Requirements", "Running"]
    assert f"pip install {entry().pip_package}\n" in page
    assert all(f"| `{slug}` |" in page for slug, _ in entry().configurations)
