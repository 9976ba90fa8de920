from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from importlib.metadata import distribution, distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

from enerf_ns.supervision.published_losses import PUBLISHED_LOSSES

ROOT = Path(__file__).parents[1]
SPECIFICATIONS = {
    "nerfstudio.method_configs": "MethodSpecification",
    "nerfstudio.dataparser_configs": "DataParserSpecification",
}
ENTRY_POINTS = [point for point in distribution("enerf-ns").entry_points if point.group in SPECIFICATIONS]
PACKAGES = {"enerf_ns": ROOT / "enerf_ns", "enerf_ns.dataparsers": ROOT / "dataparsers"}
MODULES = sorted(
    ".".join([package, *file.relative_to(folder).with_suffix("").parts]).removesuffix(".__init__")
    for package, folder in PACKAGES.items()
    for file in folder.rglob("*.py")
    if file.parts[-2:] != ("nerfbaselines", "spec.py")  # which nerfbaselines alone imports
)
WITHOUT_NERFSTUDIO = [
    module
    for module in MODULES
    if module.startswith(("enerf_ns.kernels.hash_grid", "enerf_ns.simulator", "enerf_ns.dataparsers"))
    and module != "enerf_ns.dataparsers.event_dataparser"
] + ["enerf_ns.events.samplers", "enerf_ns.sensor.response", "enerf_ns.supervision.losses"]


def run_python(code: str, python: str | Path = sys.executable) -> str:
    """The output of a fresh interpreter outside the source tree; that of another environment sees no PYTHONPATH."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH" or python == sys.executable}
    run = subprocess.run([python, "-c", code], cwd=ROOT.parent, capture_output=True, text=True, env=kept)
    assert run.returncode == 0, run.stderr
    return run.stdout


def test_modules_below_the_plugin_import_no_nerfstudio():
    loaded = run_python(
        f"import importlib, sys\nfor module in {WITHOUT_NERFSTUDIO}: importlib.import_module(module)\n"
        "print([name for name in sys.modules if name.split('.')[0] == 'nerfstudio'])"
    )
    assert loaded.strip() == "[]"


def test_the_data_parsers_import_no_part_of_nerfstudio_that_imports_data_parsers():
    """Nerfstudio's base data manager loads them while it is half imported itself."""
    loaded = run_python(
        "import sys, enerf_ns.dataparsers.event_dataparser\n"
        "print(*(name for name in sys.modules if name.startswith('nerfstudio')))"
    ).split()
    forbidden = ("datamanagers", "pipelines", "trainer", "models", "method_configs", "dataparser_configs")
    assert "nerfstudio.data.dataparsers.base_dataparser" in loaded
    assert not [name for name in loaded if name.split(".")[-1] in forbidden]


FIRST = """
import os, sys
from contextlib import suppress
from importlib import import_module
def in_a_fork(module):
    # exit code, and the packages that were imported with it
    receive, send = os.pipe()
    if not os.fork():
        try:
            import_module(module)
            os.write(send, " ".join({name.split(".")[0] for name in sys.modules}).encode())
        except BaseException:
            sys.excepthook(*sys.exc_info())
        os._exit(0)
    os.close(send)
    with os.fdopen(receive) as names:
        imported = names.read().split()
    os.wait()
    return imported
below = set(in_a_fork("enerf_ns.method.config")) - {"nerfstudio", "enerf_ns", "__main__"}
for package in sorted(below - {name.split(".")[0] for name in sys.modules}):
    with suppress(ImportError):  # of names that are no packages
        import_module(package)  # so that each fork imports what may depend on the order, and nothing else
assert not any(name.split(".")[0] in ("nerfstudio", "enerf_ns") for name in sys.modules)
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="no forks")
@pytest.mark.sweep(1)
@pytest.mark.parametrize("part", range(9))
def test_every_module_of_the_plugin_can_be_imported_first(part: int):
    modules = sorted(set(MODULES) - set(WITHOUT_NERFSTUDIO))[part::9]
    failed = run_python(f"{FIRST}\nprint(*[module for module in {modules} if not in_a_fork(module)])")
    assert failed.strip() == ""


def test_constraints_hold_on_the_first_release_of_each_python():
    """A version that wants Python 3.11.5 cannot be installed on the 3.11.2 of a distribution."""
    wanted = {canonicalize_name(found.metadata["Name"]): found for found in distributions()}
    unusable = []
    for line in (ROOT / "constraints.txt").read_text().splitlines():
        if line.startswith("#"):
            continue
        constraint = Requirement(line)
        found = wanted.get(canonicalize_name(constraint.name))
        if found is None or not constraint.specifier.contains(found.version):
            continue
        pythons = SpecifierSet(found.metadata["Requires-Python"] or "")
        for python in ("3.10.0", "3.11.0", "3.12.0"):
            environment = {"python_version": python.removesuffix(".0"), "python_full_version": python}
            if (constraint.marker is None or constraint.marker.evaluate(environment)) and python not in pythons:
                unusable.append(f"{line} on {python}")
    assert unusable == []


def test_entry_points_are_specifications():
    assert {point.name for point in ENTRY_POINTS} >= {
        "enerf", "enerf-paper", "event-data", "esim-events", "esim-npz", "esim-bag", "davis-events", "eds-events",
        "tumvie-events", "eventnerf-events", "llff-events", "evimo2-events", "mvsec-events", "vector-events",
        "rosbag-events", "m3ed-events", "dsec-events", "e2nerf-events", "event-recording", *PUBLISHED_LOSSES,
    }  # fmt: skip
    for point in ENTRY_POINTS:
        assert type(point.load()).__name__ == SPECIFICATIONS[point.group]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the sources: a build writes into its source tree, and packs files that an earlier build left there."""
    source = tmp_path_factory.mktemp("packaging") / "source"
    for folder in ("enerf_ns", "dataparsers"):
        shutil.copytree(ROOT / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / file, source)
    return source


def built_wheel(source: Path, target: Path) -> Path:
    """The wheel that pip builds of a source tree or a source distribution."""
    pip_wheel = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "-w", target, source]
    subprocess.run(pip_wheel, check=True)
    (wheel,) = target.glob("enerf_ns-*.whl")
    return wheel


@pytest.fixture(scope="module")
def wheel(source: Path) -> Path:
    return built_wheel(source, source.parent / "wheel")


def contents(wheel: Path) -> dict[str, bytes]:
    """The files of a wheel by name."""
    with zipfile.ZipFile(wheel) as files:
        return {name: files.read(name) for name in files.namelist()}


@pytest.mark.slow
def test_the_source_distribution_builds_the_same_wheel(source: Path, wheel: Path, tmp_path: Path):
    copy = shutil.copytree(source, tmp_path / "source", ignore=shutil.ignore_patterns("build", "*.egg-info"))
    build = "import sys; from setuptools import build_meta; build_meta.build_sdist(sys.argv[1])"
    subprocess.run([sys.executable, "-c", build, tmp_path], cwd=copy, check=True)
    (archive,) = tmp_path.glob("enerf_ns-*.tar.gz")
    again = built_wheel(archive, tmp_path / "wheel")
    assert again.name == wheel.name and contents(again) == contents(wheel)


@pytest.mark.slow
def test_wheel_in_a_fresh_environment(wheel: Path, tmp_path: Path):
    """The fresh environment sees the packages of this one behind its own, so that only the wheel is installed."""
    environment = tmp_path / "environment"
    venv.create(environment, symlinks=os.name != "nt", with_pip=True)
    scripts = environment / ("Scripts" if os.name == "nt" else "bin")
    subprocess.run([scripts / "python", "-m", "pip", "install", "--no-deps", wheel], check=True)
    packages = Path(run_python("import sysconfig; print(sysconfig.get_path('purelib'))", scripts / "python").strip())
    (packages / "packages_of_the_running_environment.pth").write_text(sysconfig.get_path("purelib"))

    code = f"""
import importlib
from importlib.metadata import distribution, distributions
for module in {MODULES}:
    print("file", importlib.import_module(module).__file__)
for point in distribution("enerf-ns").entry_points:
    if point.group in {list(SPECIFICATIONS)}:
        print("specification", point.name, type(point.load()).__name__)
"""
    lines = [line.split(maxsplit=1) for line in run_python(code, scripts / "python").splitlines()]
    files = [Path(rest) for kind, rest in lines if kind == "file"]
    assert len(files) == len(MODULES) and all(file.is_relative_to(packages / "enerf_ns") for file in files)
    assert sorted(rest.split() for kind, rest in lines if kind == "specification") == sorted(
        [point.name, SPECIFICATIONS[point.group]] for point in ENTRY_POINTS
    )
    assert (packages / "enerf_ns" / "py.typed").is_file()
    assert (packages / "enerf_ns" / "dataparsers" / "inspection" / "inspection.html").is_file()
    assert (packages / "enerf_ns" / "report" / "report.html").is_file()
    enerf = subprocess.run([scripts / "enerf", "--help"], cwd=tmp_path, capture_output=True, text=True)
    assert enerf.returncode == 0 and "simulate" in enerf.stdout, enerf.stderr


def test_the_oldest_and_the_newest_python_are_tested():
    """The workflows install the wheel on both ends of requires-python, and run all tests on every version between."""
    about = (ROOT / "pyproject.toml").read_text()
    oldest, beyond = map(int, re.findall(r'requires-python = ">=3\.(\d+),<3\.(\d+)"', about)[0])
    workflow = (ROOT / ".github" / "workflows" / "ci.yml").read_text()
    every, ends = (re.findall(r'"3\.(\d+)"', line) for line in re.findall(r"python: \[.*\]", workflow))
    assert list(map(int, every)) == list(range(oldest, beyond)) and list(map(int, ends)) == [oldest, beyond - 1]


def test_the_container_file_copies_and_installs_what_a_build_needs():
    """It copies files that exist, and installs the system packages of CI and extras of the package."""
    lines = (ROOT / "Dockerfile").read_text().replace("\\\n", " ").splitlines()
    copied = {name for line in lines if line.startswith("COPY ") for name in line.split()[1:-1]}
    allowed = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert copied == allowed and all((ROOT / name).exists() for name in copied)
    assert copied >= {"enerf_ns", "dataparsers", "pyproject.toml", "README.md", "LICENSE", "constraints.txt"}
    (needed,) = re.findall(r"^needed=\((.*)\)$", (ROOT / ".ci" / "run").read_text(), re.MULTILINE)
    of_python = {"make", "python3-dev", "python3-venv"}  # which the base image has, or which the image does not use
    (installed,) = [line for line in lines if "apt-get install" in line]
    assert set(needed.split()) - of_python <= set(installed.split())
    extras = set(distribution("enerf-ns").metadata.get_all("Provides-Extra") or [])
    named = {extra for line in lines for found in re.findall(r"'\.\[([\w,-]+)\]'", line) for extra in found.split(",")}
    assert named and named <= extras


@pytest.mark.slow
@pytest.mark.skipif(not (ROOT / ".git").exists() or shutil.which("git") is None, reason="no repository of git")
def test_pip_installs_the_repository_without_a_clone(tmp_path):
    assert 'pip install -c constraints.txt "git+file://$PWD"' in (ROOT / "README.md").read_text()
    alone = ["--no-deps", "--no-build-isolation", "--target", tmp_path]
    subprocess.run([sys.executable, "-m", "pip", "install", *alone, f"git+file://{ROOT}"], check=True)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    command = [sys.executable, tmp_path / "bin/enerf", "check-numerics", "--help"]
    checked = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert checked.returncode == 0 and "check-numerics" in checked.stdout, checked.stderr
