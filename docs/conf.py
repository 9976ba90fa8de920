"""The pages as a site: `make docs` writes it to build/docs/."""

from __future__ import annotations

import io
import os
import sys
from contextlib import redirect_stdout, suppress
from pathlib import Path
from typing import Any
from unittest.mock import patch

project = "enerf-ns"
author = "The enerf-ns developers"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "sphinx_book_theme"
html_title = "enerf-ns"
html_theme_options = {"show_toc_level": 2, "use_download_button": False, "navbar_persistent": []}
html_show_sourcelink = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
highlight_language = "text"  # of blocks that name no language
myst_heading_anchors = 3
default_role = "code"
suppress_warnings = ["ref.python"]  # Sphinx takes the names of axes in shapes for names of classes
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
napoleon_use_rtype = False

COMMANDS_PAGE = Path(__file__).with_name("commands.md")


def write_commands(app: Any) -> None:
    """Writes the page of all commands and their flags from the output of `--help` of each command."""
    from nerfstudio.scripts import train

    from enerf_ns.scripts import cli

    programs = {f"enerf {name}": cli.entrypoint for name in cli.COMMANDS} | {"ns-train enerf": train.entrypoint}
    texts = []
    for program, entrypoint in programs.items():  # in this process, since starting each would take seconds of imports
        printed = io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True)
        environment = {"COLUMNS": "110", "NO_COLOR": "1", "TERM": "dumb"}
        with patch.dict(os.environ, environment), patch.object(sys, "argv", [*program.split(), "--help"]):
            with redirect_stdout(printed), suppress(SystemExit):
                entrypoint()
        printed.seek(0)
        texts.append(printed.read())
        assert texts[-1], f"{program} --help prints nothing"
    sections = [f"## {name}\n\n```text\n{text.strip()}\n```" for name, text in zip(programs, texts, strict=True)]
    head = (
        "# Commands and flags\n\nThe output of `--help` of each command. [Training](training.md) lists the flags of "
        "`ns-train enerf`, which stand last here, by purpose."
    )
    COMMANDS_PAGE.write_text("\n\n".join([head, *sections]) + "\n")


def setup(app: Any) -> None:
    """Connects the function that Sphinx calls before it reads the pages."""
    app.connect("builder-inited", write_commands)
