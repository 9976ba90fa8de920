"""The code on the pages: programs parse their commands, examples in Python run, and tutorials are followed."""

from __future__ import annotations

import ast
import contextlib
import importlib.util
import io
import json
import re
import shlex
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
import tyro
from recordings import write_davis
from small_runs import SMALL
from warm_commands import WarmCommands

from enerf_ns.dataparsers.formats import registry
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.formats.writer import camera_json
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.scripts import cli

ROOT = Path(__file__).parents[1]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "benchmarks/README.md")),
    *sorted({*(ROOT / "docs").glob("*.md")} - {ROOT / "docs" / "commands.md"}),
]
PROGRAMS = ("enerf", "ns-train", "ns-eval", "ns-render", "ns-export", "ns-viewer")


@dataclass(frozen=True)
class Command:
    """A command of this package or of Nerfstudio as a page has it."""

    page: str
    words: tuple[str, ...]
    in_sentence: bool
    """Whether it stands in a sentence, which may name a command without its arguments."""

    def __str__(self) -> str:
        return f"{self.page}: {' '.join(self.words)}"


def blocks(page: Path, *languages: str) -> list[str]:
    """The blocks of code of a page in some languages; "indented" are those that are indented by four spaces."""
    text = page.read_text()
    found = [body for kind, body in re.findall(r"^ *```(\w*)\n(.*?)^ *```", text, re.M | re.S) if kind in languages]
    if "indented" in languages:
        prose = re.sub(r"^ *```.*?^ *```", "", text, flags=re.M | re.S)
        found += [line.strip() for line in re.findall(r"^ {4}\S.*$", prose, re.M)]
    return found


def commands_of(page: Path) -> list[Command]:
    """The commands of a page, of its blocks and of its inline code, without what redirects or wraps them."""
    shell = [line for block in blocks(page, "bash", "console", "indented") for line in joined(block)]
    prose = re.sub(r"^ *```.*?^ *```", "", page.read_text(), flags=re.M | re.S)
    inline = [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", prose)]
    found = []
    for lines, in_sentence in ((shell, False), (inline, True)):
        for line in lines:
            with contextlib.suppress(ValueError):  # quotes that are not closed: no command
                words = shlex.split(line.removeprefix("$ "), comments=True)
                while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
                    words = words[1:]
                if "docker" in words[:1]:
                    words = words[next((i for i, word in enumerate(words) if word in PROGRAMS), len(words)) :]
                if len(words) > 1 and words[0] in PROGRAMS:
                    found.append(Command(page.relative_to(ROOT).as_posix(), tuple(words), in_sentence))
    return found


def joined(block: str) -> list[str]:
    return block.replace("\\\n", " ").splitlines()


COMMANDS = [command for page in PAGES for command in commands_of(page)]


@cache
def parser_of(program: str) -> Callable[[list[str]], object]:
    """The parser of a program of Nerfstudio, which takes arguments and runs nothing."""
    if program == "ns-train":
        from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion

        return lambda arguments: tyro.cli(AnnotatedBaseConfigUnion, args=arguments)
    module = {"ns-eval": "eval", "ns-render": "render", "ns-export": "exporter", "ns-viewer": "viewer.run_viewer"}
    loaded = import_module(f"nerfstudio.scripts.{module[program]}")
    kind: Any = {"ns-eval": "ComputePSNR", "ns-viewer": "RunViewer"}.get(program, "Commands")
    kind = getattr(loaded, kind)
    if program == "ns-viewer":
        kind = tyro.conf.FlagConversionOff[kind]
    return lambda arguments: tyro.cli(kind, args=arguments)


def parse(words: tuple[str, ...]) -> None:
    """Parses a command as the program would.

    Raises:
        AssertionError: The program would refuse it.
    """
    program, *arguments = words
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint), contextlib.redirect_stdout(complaint):
            if program != "enerf":
                parser_of(program)(arguments)
            elif arguments[0] not in ("--help", "--version"):
                assert arguments[0] in cli.COMMANDS, f"there is no command {arguments[0]}"
                tyro.cli(cli._imported(arguments[0]), args=arguments[1:])
    except SystemExit as end:
        continues = "--load-config" in arguments and "config.yml is missing" in str(end.code)  # its flags are parsed
        assert continues or not end.code, f"{shlex.join(words)}\n{complaint.getvalue()}"


SAMPLES = {"NAME": "auto", "ON": "0.2", "OFF": "0.3", "NEAR": "0.5", "FAR": "4", "A": "1", "B": "2", "N": "8000"}
"""Values for what a page leaves to the reader; of paths, any word will do."""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_command_is_parsed_by_its_program(page: Path):
    """A flag or a command that no longer exists fails, in blocks and in sentences alike."""
    for command in commands_of(page):
        if not is_only_named(command):
            parse(tuple(SAMPLES.get(word, word) for word in command.words if word not in ("[RUN", "...]")))


def is_only_named(command: Command) -> bool:
    """Whether a sentence names a command without its arguments: `enerf inspect`, `enerf simulate --layout`."""
    last = command.words[-1]
    return command.in_sentence and (len(command.words) == 2 or last.startswith("--") or last in ("...", "…"))


FLAG = re.compile(r"(?<![\w/-])--(?:pipeline|machine|viewer|optimizers|frame)\.[\w.-]*\w")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_flag_that_a_sentence_names_exists(page: Path):
    known = flags_of_training("enerf") | flags_of_training("nerfacto") | flags_of("simulate")
    named = set(FLAG.findall(page.read_text()))
    assert sorted(named - known) == []


@cache
def flags_of_training(method: str) -> set[str]:
    return help_of(lambda: parser_of("ns-train")([method, "--help"]))


@cache
def flags_of(command: str) -> set[str]:
    return help_of(lambda: tyro.cli(cli._imported(command), args=["--help"]))


def help_of(called: Callable[[], object]) -> set[str]:
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        patch.setenv("COLUMNS", "200")
        called()
    return set(re.findall(r"--[\w.-]*\w", printed.getvalue()))


def test_a_flag_that_does_not_exist_is_found():
    for words in (
        ("ns-train", "enerf", "--data", "x", "--pipeline.model.no-such", "1"),
        ("enerf", "inspect", "x", "-q"),
    ):
        with pytest.raises(AssertionError):
            parse(words)
    with pytest.raises(AssertionError, match="no command paint"):
        parse(("enerf", "paint", "x"))
    assert len(COMMANDS) > 100


# ------------------------------------------------------------------------------------------------------------ messages


def test_messages_of_the_page_of_errors_are_those_of_the_package():
    """Each message in the first column is somewhere in the package; `…` stands for what differs."""
    texts = "\n".join(strings_of_the_package())
    page = (ROOT / "docs" / "errors.md").read_text()
    ours = page[page.index("These messages come from this package") :]
    first_cells = [
        line.split(" | ")[0] for line in ours.splitlines() if line.startswith("| `") and "(of `ns-" not in line
    ]
    messages = [
        piece.strip() for cell in first_cells for code in re.findall(r"`([^`]+)`", cell) for piece in code.split("…")
    ]
    assert len(messages) > 50
    assert [message for message in messages if message not in texts] == []


def strings_of_the_package() -> Iterator[str]:
    """Every text in the sources of the package, each part of an f-string by itself."""
    for folder in ("enerf_ns", "dataparsers"):
        for file in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    yield node.value


# --------------------------------------------------------------------------------------------------- examples in Python

PYTHON = [(page, number) for page in PAGES for number in range(len(blocks(page, "python")))]
ELSEWHERE = {"hash-grid.md", "notebook.md", "tutorial-pictures.md"}
"""Pages whose examples are not run here: others do so (`tests/kernels/test_fast_hash_encoding.py`, the test of the
notebook), or they need the recording of a command above them."""


@pytest.mark.parametrize(("page", "number"), PYTHON, ids=lambda value: getattr(value, "name", str(value)))
def test_examples_in_python_import_what_exists(page: Path, number: int):
    tree = ast.parse(blocks(page, "python")[number])
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            module = import_module(node.module or "")
            assert [alias.name for alias in node.names if not hasattr(module, alias.name)] == []


@pytest.fixture
def folder(tmp_path: Path, recording: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with path/to/recording. Runs are small, plots open no window, nothing stays registered."""
    from enerf_ns.method import runs
    from enerf_ns.supervision import event_supervision

    (tmp_path / "path" / "to").mkdir(parents=True)
    shutil.copytree(recording, tmp_path / "path" / "to" / "recording")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.setenv("ENERF_LPIPS_WEIGHTS", str(tmp_path / "no-weights"))
    whole = runs.method_config

    def smaller(name: str, data: Path, output_dir: Path, changes: Mapping[str, Any] = MappingProxyType({})) -> Any:
        return whole(name, data, output_dir, {**changes, **SMALL})

    monkeypatch.setattr(runs, "method_config", smaller)
    monkeypatch.setattr(registry, "_FORMATS", dict(registry._FORMATS))
    monkeypatch.setattr(event_supervision, "EVENT_LOSSES", dict(event_supervision.EVENT_LOSSES))
    return tmp_path


def arrays(recording: Path) -> dict[str, Any]:
    """The arrays that the page on NumPy needs, from a recording."""
    read = read_recording(recording)
    events, trajectory = index_events(read).events(), read.trajectory
    return {
        **{"x": events.x, "y": events.y, "t": events.t, "p": events.p},
        "pose_times": trajectory.times,
        "poses": np.column_stack([trajectory.positions, trajectory.quaternions]),
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if blocks(page, "python") and page.name not in ELSEWHERE],
    ids=lambda page: page.name,
)
def test_examples_in_python_run(page: Path, folder: Path, recording: Path):
    """The blocks of a page run one after another, as a reader would paste them."""
    names: dict[str, Any] = {"__name__": "page", "read": read_recording, **arrays(recording)}
    for block in blocks(page, "python"):
        exec(compile(block, page.name, "exec"), names)
    if page.name == "tutorial-numpy.md":
        assert len(index_events(read_recording(folder / "my-recording"))) > 0


# ------------------------------------------------------------------------------------------------------------- notebook


def load_script(name: str) -> Any:
    """A script of the folder docs/ as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_notebook_is_that_of_its_page():
    script = load_script("notebook")
    assert script.NOTEBOOK.read_text() == script.notebook(script.PAGE.read_text()), "run: python docs/notebook.py"


@pytest.mark.slow
def test_the_cells_of_the_notebook_run(folder: Path, capsys: pytest.CaptureFixture[str]):
    """All but the installation, on a small recording and for two steps."""
    cells = json.loads((ROOT / "docs" / "demo.ipynb").read_text())["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert code[0].startswith("%pip install ")
    small = "WIDTH, DURATION, STEPS = 32, 0.1, 2"
    source, changed = re.subn(r"WIDTH, DURATION, STEPS = .*", small, "\n".join(code[1:]))
    assert changed == 1
    exec(compile(source, "demo.ipynb", "exec"), {"__name__": "notebook"})
    printed = capsys.readouterr().out
    assert "depth_rmse" in printed and "config.yml" in printed


@pytest.mark.slow
def test_the_figures_are_drawn(tmp_path: Path):
    load_script("figures").main(tmp_path)
    drawn, committed = ({file.name for file in where.glob("*.png")} for where in (tmp_path, ROOT / "docs" / "figures"))
    assert drawn == {name for name in committed if not name.startswith("results-")} and drawn


def test_every_committed_figure_is_shown_on_a_page():
    pages = "".join(page.read_text() for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")))
    assert [file.name for file in (ROOT / "docs" / "figures").iterdir() if f"figures/{file.name})" not in pages] == []


# ------------------------------------------------------------------------------------------------------------ tutorials

SMALLER = {
    "simulate": ["--width", "32", "--height", "24", "--duration", "0.1", "--num-frames", "11", "--exposure-ms", "5"],
    "report": ["--no-video", "--lpips"],
    "enerf": [word for name, value in SMALL.items() for word in (f"--{name.replace('_', '-')}", str(value))],
}
"""Flags that make a command small, by command; the flags of a method stand first. A run has a name, not a time."""

FOLLOWED = ("tutorial-simulated.md", "tutorial-davis.md", "tutorial-numpy.md", "tutorial-frames-and-events.md")
SKIPPED = ("ns-render", "ns-viewer", "ns-export")
"""Programs of Nerfstudio, which other tests run."""


def small(words: tuple[str, ...], number: int) -> list[str] | None:
    """A command of a tutorial in few steps on few pixels, or None for one that is not followed."""
    program, command, *rest = [word.replace("/TIME", "/run") for word in words]
    if program in SKIPPED or (program == "enerf" and command == "export"):
        return None
    if program == "enerf":
        return [program, command, *rest, *SMALLER.get(command, [])]
    while "--max-num-iterations" in rest:
        place = rest.index("--max-num-iterations")
        del rest[place : place + 2]
    if "--time-range" in rest:  # of slider_depth; the recording of the test is shorter
        return None
    if "--exposure-ms" in rest:
        rest[rest.index("--exposure-ms") + 1] = "5"
    rest += ["--depth-range", "0.5", "5"] if "event-data" in rest else ["event-data", "--depth-range", "0.5", "5"]
    flags = list(SMALLER["enerf"])
    if number:  # a folder for each run but the first, which the pages go on with
        flags[flags.index("run")] = f"run-{number}"
    return [program, command, "--vis", "tensorboard", *flags, *rest]


@pytest.mark.slow
@pytest.mark.parametrize("name", FOLLOWED)
def test_a_tutorial_can_be_followed(name: str, folder: Path, recording: Path, warm_commands: WarmCommands):
    """Its commands run one after another in one folder, each in a process of its own."""
    if name == "tutorial-davis.md":
        write_davis_of(recording, folder / "slider_depth")
    if name == "tutorial-numpy.md":
        exec(blocks(ROOT / "docs" / name, "python")[0], arrays(recording))
        about = {"camera": camera_json(read_recording(recording).camera)}
        (folder / "my-recording" / "recording.json").write_text(json.dumps(about))
    trained = 0
    for block in blocks(ROOT / "docs" / name, "bash"):
        for line in joined(block):
            words = tuple(shlex.split(line, comments=True))
            if not words or words[0] not in PROGRAMS or (command := small(words, trained)) is None:
                continue
            trained += words[0] == "ns-train"
            code, printed = warm_commands.run(*command, cwd=folder, limit=120)
            assert code == 0, f"{line}\n{printed[-3000:]}"
    assert list(folder.rglob("report.html")) or name == "tutorial-numpy.md"


def write_davis_of(recording: Path, target: Path) -> None:
    """The small simulated recording in the text format of the tutorial, whose files are first those of a tiny one."""
    write_davis(target)
    read = read_recording(recording)
    events, camera = index_events(read).events(), read.camera
    assert read.frames is not None
    lines = zip(events.t.tolist(), events.x.tolist(), events.y.tolist(), events.p.tolist(), strict=True)
    (target / "events.txt").write_text("".join(f"{t * 1e-9:.9f} {x} {y} {int(p > 0)}\n" for t, x, y, p in lines))
    poses = np.column_stack([read.trajectory.times * 1e-9, read.trajectory.positions, read.trajectory.quaternions])
    np.savetxt(target / "groundtruth.txt", poses, fmt="%.9f")
    (target / "calib.txt").write_text(f"{camera.fx} {camera.fy} {camera.cx} {camera.cy} 0 0 0 0 0\n")
    shutil.rmtree(target / "images")
    (target / "images").mkdir()
    listed = []
    for number, (file, time) in enumerate(zip(read.frames.filenames, read.frames.times.tolist(), strict=True)):
        shutil.copy(file, target / "images" / f"frame_{number:08d}.png")
        listed.append(f"{time * 1e-9:.9f} images/frame_{number:08d}.png\n")
    (target / "images.txt").write_text("".join(listed))
