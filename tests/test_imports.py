"""What may import what: rooms import downwards, nothing of learning stands on the ground floor, and entry points
have no side effects."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = {"enerf_ns": ROOT / "enerf_ns", "enerf_ns.dataparsers": ROOT / "dataparsers"}
FILES = {
    ".".join([package, *file.relative_to(folder).with_suffix("").parts]).removesuffix(".__init__"): file
    for package, folder in FOLDERS.items()
    for file in sorted(folder.rglob("*.py"))
}
GROUND_FLOOR = "enerf_ns.dataparsers"
ROOMS = [
    *("scripts", "nerfbaselines"),
    *("bench", "report", "export", "simulator", "reconstruction", "method", "choices", "evaluation"),
    *("rendering", "supervision", "sensor", "poses", "events", "kernels", "terminal", "flags", "quiet"),
    *("dataparsers.event_dataparser", "dataparsers.inspection", "dataparsers.sensor_estimates", "dataparsers.scene"),
    *("dataparsers.index", "dataparsers.formats", "dataparsers.recording", "dataparsers.compiled"),
]
"""The rooms of the house: each imports those that stand after it, and none before."""


def imports(source: str, module: str, is_package: bool = False) -> set[str]:
    """Every module that a source names in an import, at any depth: functions and type checking included."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = module.split(".")
                parts = parts[: len(parts) - node.level + is_package]
                base = ".".join([*parts, *([base] if base else [])])
            found |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) == "import_module":
            found |= {str(argument.value) for argument in node.args if isinstance(argument, ast.Constant)}
    return found


GRAPH = {
    module: imports(file.read_text(), module, file.name == "__init__.py") & set(FILES) - {module}
    for module, file in FILES.items()
}


def circle(graph: dict[str, set[str]]) -> list[str]:
    """Some modules that import each other in turn; none if there are no such."""
    done: set[str] = set()

    def visit(module: str, path: list[str]) -> list[str]:
        if module in path:
            return [*path[path.index(module) :], module]
        if module not in done:
            for other in sorted(graph[module]):
                if found := visit(other, [*path, module]):
                    return found
            done.add(module)
        return []

    return next((found for module in sorted(graph) if (found := visit(module, []))), [])


def test_there_is_no_circle_of_imports():
    assert circle(GRAPH) == []


def test_a_circle_would_be_found_wherever_it_hides():
    hidden = {
        "p.a": "def f():\n    from p import b\n",
        "p.b": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from p.c import thing\n",
        "p.c": "from importlib import import_module\nclass C:\n    def g(self):\n        import_module('p.a')\n",
    }
    graph = {module: imports(source, module) & set(hidden) for module, source in hidden.items()}
    assert circle(graph) == ["p.a", "p.b", "p.c", "p.a"]
    assert circle({**graph, "p.c": set()}) == []


def room(module: str) -> str:
    """The room of a module; nothing of one that only holds rooms."""
    inner = module.removeprefix("enerf_ns").removeprefix(".")
    return next((name for name in ROOMS if f"{inner}.".startswith(f"{name}.")), "")


def test_every_module_is_in_a_room():
    assert [module for module in FILES if not room(module)] == ["enerf_ns", GROUND_FLOOR]
    assert {room(module) for module in FILES} == {*ROOMS, ""}


@pytest.mark.parametrize("module", FILES)
def test_rooms_import_downwards(module: str):
    below = ROOMS[ROOMS.index(room(module)) :] if room(module) else []
    assert {room(other) for other in GRAPH[module]} <= {*below, ""}


def test_the_graph_is_the_one_that_python_follows():
    """Of modules that are imported in a fresh interpreter, all that are loaded with them are reachable."""
    code = "import sys, {0}; print(*(name for name in sys.modules if name.startswith('enerf_ns.')))"
    for module in ("enerf_ns.method.config", "enerf_ns.dataparsers.index.indexing", "enerf_ns.scripts.cli"):
        loaded = set(subprocess.run(
            [sys.executable, "-c", code.format(module)], capture_output=True, text=True, check=True
        ).stdout.split())  # fmt: skip
        reached, waiting = set(), {module}
        while waiting:
            following = waiting.pop()
            reached.add(following)
            waiting |= GRAPH[following] - reached
        packages = {name for name, file in FILES.items() if file.name == "__init__.py"}
        registered = {"enerf_ns.dataparsers.event_dataparser"}  # which Nerfstudio loads by its entry points
        for name in registered:
            waiting = {name}
            while waiting:
                following = waiting.pop()
                reached.add(following)
                waiting |= GRAPH[following] - reached
        assert loaded - packages <= reached


@pytest.mark.parametrize("module", [module for module in FILES if module.startswith(GROUND_FLOOR)])
def test_the_ground_floor_imports_nothing_of_learning(module: str):
    file = FILES[module]
    named = imports(file.read_text(), module, file.name == "__init__.py")
    assert not {name for name in GRAPH[module] if not name.startswith(GROUND_FLOOR)} - {"enerf_ns"}
    learning = {name for name in named if name.split(".")[0] in ("torchmetrics", "torchvision", "nerfacc")}
    learning |= {name for name in named if name.startswith(("torch.nn", "torch.optim", "torch.autograd"))}
    if module == "enerf_ns.dataparsers.event_dataparser":
        learning.discard("torchvision.models")  # whose weights the methods of Nerfstudio download
        learning -= {"torchvision.models.AlexNet_Weights", "torchvision.models.alexnet"}
    else:
        learning |= {name for name in named if name.split(".")[0] == "nerfstudio"}
    assert not learning


def test_supervision_sensor_and_samplers_know_no_class_of_nerfstudio():
    rooms = (
        "enerf_ns.supervision",
        "enerf_ns.sensor",
        "enerf_ns.events",
        "enerf_ns.simulator",
        "enerf_ns.kernels.hash_grid",
    )
    for module, file in FILES.items():
        if module.startswith(rooms) and module != "enerf_ns.simulator.sources":
            assert not {name for name in imports(file.read_text(), module) if name.split(".")[0] == "nerfstudio"}


def test_importing_the_entry_points_changes_nothing_of_the_process():
    """What nerfstudio itself changes is imported before."""
    code = """
import json, os, sys
import nerfstudio.configs.base_config, nerfstudio.engine.trainer, nerfstudio.plugins.registry_dataparser
import torch
def state():
    return [os.environ["PATH"], dict(os.environ), len(torch.serialization.get_safe_globals()),
            str(torch.get_default_dtype()), torch.get_num_threads(), torch.initial_seed()]
before = state()
import enerf_ns.method.config, enerf_ns.dataparsers.event_dataparser
heavy = [name for name in ("numba", "h5py", "matplotlib.pyplot", "trimesh", "rosbags") if name in sys.modules]
print(json.dumps([before == state(), heavy]))
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(run.stdout.splitlines()[-1]) == [True, []]
