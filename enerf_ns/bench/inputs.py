"""Inputs of the result of a training: the code that runs, and the files of the recording."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import enerf_ns
import enerf_ns.dataparsers

SIMULATION = (
    "enerf_ns.simulator.engine",
    "enerf_ns.dataparsers.formats.esim",
    "enerf_ns.dataparsers.formats.event_recording",
)
"""Modules that make the recordings of the experiments. All that they import counts, too, but for `TRAINED_RUNS`."""

TRAINED_RUNS = ("enerf_ns.method", "enerf_ns.dataparsers.event_dataparser")
"""Packages and modules by which the simulator reads trained runs, from which no experiment simulates."""

RECONSTRUCTION = "enerf_ns.reconstruction.reconstruction"
"""Module that makes frames of events."""

TRAINING = (
    "enerf_ns.method.config",
    "enerf_ns.method.runs",
    "enerf_ns.bench.measures",
    "enerf_ns.kernels.fast_hash_encoding",
    "enerf_ns.kernels.hash_grid_triton",
    *SIMULATION,
    RECONSTRUCTION,
)
"""Modules that the training of a simulated recording calls."""

ALL_READERS = "enerf_ns.dataparsers.formats.registry"
"""Module that imports the readers of all formats, for recordings of the user."""

NUMERICAL_ERRORS = "enerf_ns.bench.numerics.parts"
"""Module that measures the numerical errors of the parts."""

LEFT_OUT = (
    "enerf_ns.bench.experiments",
    "enerf_ns.bench.numerics",
    ALL_READERS,
    "enerf_ns.method.viewer",
    "enerf_ns.report",
)
"""Modules and packages that change no result where others import them: experiments, whose settings count by themselves;
numerical checks; readers of other formats; viewer and reports."""

LARGEST_HASHED = 16_000_000
"""Size in bytes up to which the content of a file of a recording counts, and not only its name and size."""


@cache
def code_digest(*roots: str, left_out: tuple[str, ...] = ()) -> str:
    """A short name for the code of some modules and all that they import, without comments and docstrings.

    Args:
        roots: Names of the modules.
        left_out: Modules and packages that do not count where others import them, beside `LEFT_OUT`.
    """
    found = hashlib.sha256()
    for name in sorted(modules(roots, left_out)):
        found.update(f"{name} {ast.dump(_without_docstrings(_parsed(name)))}".encode())
    return found.hexdigest()[:10]


def modules(roots: Iterable[str], left_out: tuple[str, ...] = ()) -> set[str]:
    """Names of these modules, and of the modules of this package that they import at any level, if not left out."""
    found, left_out = set(roots), (*LEFT_OUT, *left_out)
    to_do = list(found)
    while to_do:
        imported = _imported(_parsed(to_do.pop())) - found
        new = {name for name in imported if not any(name == out or name.startswith(f"{out}.") for out in left_out)}
        found |= new
        to_do += new
    return found


def recording_digest(folder: Path) -> str:
    """A short name for a recording: names and sizes of its files, and the content of those that are not large."""
    found = hashlib.sha256()
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        size = file.stat().st_size
        found.update(f"{file.relative_to(folder)} {size} ".encode())
        if size <= LARGEST_HASHED:
            found.update(file.read_bytes())
    return found.hexdigest()[:10]


def _file(name: str) -> Path | None:
    """The file of a module of this package; None for any other name."""
    for package in (enerf_ns.dataparsers, enerf_ns):
        if name == package.__name__ or name.startswith(f"{package.__name__}."):
            place = Path(package.__path__[0], *name.split(".")[package.__name__.count(".") + 1 :])
            found = [file for file in (place.with_suffix(".py"), place / "__init__.py") if file.is_file()]
            return found[0] if found else None
    return None


@cache
def _parsed(name: str) -> ast.Module:
    file = _file(name)
    assert file is not None, name
    return ast.parse(file.read_text(encoding="utf-8"))


def _imported(module: ast.Module) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(module):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return {name for name in names if _file(name)}


def _without_docstrings(module: ast.Module) -> ast.Module:
    """The module without strings that stand alone, which are docstrings."""

    class Stripped(ast.NodeTransformer):
        def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
            return None if isinstance(node.value, ast.Constant) and isinstance(node.value.value, str) else node

    return Stripped().visit(ast.parse(ast.unparse(module)))
