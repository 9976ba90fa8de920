"""Each place in Nerfstudio, viser and torch that is not public, and that this package uses, is where it was read."""

from __future__ import annotations

import ast
import inspect
import re
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

import nerfstudio
import pytest

from enerf_ns.method import nerfstudio_seams
from enerf_ns.method.nerfstudio_seams import READ_IN, SEAMS, Seam
from enerf_ns.terminal import CHATTER


def moved(seam: Seam) -> str:
    """How a seam has moved, as a sentence; empty if it has not."""
    module, _, name = seam.place.partition(":")
    package = module.partition(".")[0]
    after = f"(read in {package} {READ_IN[package]}, now {version(package)}; used by {seam.use})."
    try:
        owner = import_module(module)
    except ImportError:
        return f"The module {module} is gone {after}"
    *owners, last = name.split(".")
    for part in owners:
        if not hasattr(owner, part):
            return f"{module}:{part} is gone {after}"
        owner = getattr(owner, part)
    if seam.parameters is not None:
        if not callable(getattr(owner, last, None)):
            return f"The method {seam.place} is gone {after}"
        found = tuple(inspect.signature(getattr(owner, last)).parameters)
        return "" if found == seam.parameters else f"{seam.place} takes {found}, no longer {seam.parameters} {after}"
    is_there = hasattr(owner, last) or last in getattr(owner, "__annotations__", {})
    if not is_there and inspect.isclass(owner):  # else it may be made by a method
        is_there = bool(re.search(rf'\bself(\.{last}\b|, "{last}")', inspect.getsource(owner)))
    return "" if is_there else f"The attribute {seam.place} is gone {after}"


@pytest.mark.parametrize("seam", SEAMS, ids=lambda seam: seam.place)
def test_a_seam_is_where_it_was_read(seam: Seam):
    sentence = moved(seam)
    assert not sentence, sentence


@pytest.mark.parametrize(
    ("seam", "sentence"),
    [
        (Seam("nerfstudio.nowhere:Thing", "x"), "The module nerfstudio.nowhere is gone (read in nerfstudio"),
        (Seam("nerfstudio.engine.trainer:Nobody.step", "x"), "nerfstudio.engine.trainer:Nobody is gone"),
        (Seam("nerfstudio.engine.trainer:Trainer._nothing", "x"), "The attribute nerfstudio.engine.trainer:Trainer._n"),
        (Seam("nerfstudio.engine.trainer:Trainer._nothing", "x", ("self",)), "The method nerfstudio.engine.trainer:Tr"),
        (Seam("nerfstudio.engine.trainer:Trainer.train", "x", ("self", "step")), "takes ('self',), no longer ('self',"),
    ],
)
def test_a_seam_that_has_moved_is_named(seam: Seam, sentence: str):
    assert sentence in moved(seam)


@pytest.mark.parametrize("beginning", CHATTER)
def test_nerfstudio_prints_the_lines_that_are_left_out(beginning: str):
    folder, words = Path(nerfstudio.__file__).parent, beginning.removeprefix("[bold yellow]")
    files = [*folder.glob("engine/*.py"), *folder.glob("utils/*.py")]
    assert any(f'"{words}' in file.read_text() for file in files), (
        f'Nerfstudio {version("nerfstudio")} prints no line "{words}…" any more; take it out of terminal.CHATTER.'
    )


def test_no_private_attribute_of_another_package_is_used_without_a_seam():
    trees = [ast.parse(file.read_text()) for file in Path(nerfstudio_seams.__file__).parents[1].rglob("*.py")]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    own = {node.name for node in nodes if isinstance(node, ast.FunctionDef)}
    used = set()
    for node in nodes:
        if isinstance(node, ast.Attribute) and node.attr.startswith("_") and not node.attr.startswith("__"):
            of_itself = isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")
            (own if of_itself else used).add(node.attr)
    listed = {seam.place.rpartition(".")[2] for seam in SEAMS}
    documented = {"_target", "_exit", "_replace"}  # of Nerfstudio's configs, of os, of named tuples
    assert used - own - listed - documented == set()
