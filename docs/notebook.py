"""Writes demo.ipynb from notebook.md, whose blocks of code are its cells: `python docs/notebook.py`."""

from __future__ import annotations

import json
import re
from pathlib import Path

PAGE = Path(__file__).with_name("notebook.md")
NOTEBOOK = Path(__file__).with_name("demo.ipynb")
SITE_LINK = re.compile(r"\[([^\]]+)\]\([\w-]+\.md[^)]*\)")


def notebook(page: str) -> str:
    """The notebook of a page as JSON: a code cell for each block of Python or of `pip`, and the text between them."""
    cells = []
    for number, part in enumerate(re.split(r"^```(?:python|bash)\n(.*?)^```\n", page, flags=re.MULTILINE | re.DOTALL)):
        text = part.strip("\n")
        if not text:
            continue
        cell: dict[str, object] = {
            "cell_type": "code" if number % 2 else "markdown",
            "id": f"cell-{number}",
            "metadata": {},
        }
        if number % 2:
            text = re.sub(r"^pip ", "%pip ", text)
            cell |= {"execution_count": None, "outputs": []}
        else:
            text = SITE_LINK.sub(r"\1", text)  # pages of the site are not beside the notebook
        cells.append({**cell, "source": text.splitlines(keepends=True)})
    kernel = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    return (
        json.dumps(
            {"cells": cells, "metadata": kernel, "nbformat": 4, "nbformat_minor": 5}, indent=1, ensure_ascii=False
        )
        + "\n"
    )


if __name__ == "__main__":
    NOTEBOOK.write_text(notebook(PAGE.read_text()))
