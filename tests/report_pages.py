"""The page of a report as tests read it."""

from __future__ import annotations

import base64
import io
import re
from html.parser import HTMLParser
from pathlib import Path

from PIL import Image

ALONE = {"img", "meta", "rect", "br"}
"""Tags without an end."""


class Page(HTMLParser):
    """What a page loads, its tables as text, and all that it says, in the order of the page."""

    def __init__(self, text: str):
        super().__init__()
        self.sources: list[str] = []
        self.tags: set[str] = set()
        self.cells: list[str] = []
        self.rows: list[list[str]] = []
        self.words: list[tuple[str, bool, str]] = []
        """Tag and class, whether it is folded, and text or description of a picture."""
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        values = {name: value or "" for name, value in attrs}
        self.sources += [values[name] for name in ("src", "href", "srcset", "data", "poster") if name in values]
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.cells.append("")
            self.rows[-1].append("")
        if "alt" in values:
            self._say(f"{tag}.{values.get('class', '')}", values["alt"])
        if tag not in ALONE:
            self.open.append(f"{tag}.{values.get('class', '')}")

    def handle_endtag(self, tag: str) -> None:
        if tag not in ALONE:
            assert self.open.pop().split(".")[0] == tag, "every tag is closed"

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1].split(".")[0] in ("td", "th"):
            self.cells[-1] += data
            self.rows[-1][-1] += data
        if data.strip():
            self._say(self.open[-1] if self.open else "", data.strip())

    def _say(self, where: str, text: str) -> None:
        self.words.append((where, any(tag.startswith("details") for tag in self.open), text))

    def text(self, *left_out: str) -> str:
        """All words, without those in some tags and classes, such as `dd.command`."""
        return "\n".join(text for where, _, text in self.words if where not in left_out)

    def unfolded(self) -> list[str]:
        """Words and descriptions of pictures that a reader sees at once."""
        return [text for _, folded, text in self.words if not folded]


def page_of(folder: Path) -> Page:
    """The page in a folder, which stands alone: every picture is whole, and within it."""
    text = (folder / "report.html").read_text()
    page = Page(text)
    assert not {"script", "link", "iframe", "object"} & page.tags
    assert "http" not in re.sub(r"base64,[A-Za-z0-9+/=]+", "", text) and "url(" not in text
    for source in page.sources:
        found = re.fullmatch(r"data:(image/png|image/webp|video/mp4);base64,(.+)", source, re.DOTALL)
        assert found, source[:40]
        if found[1] != "video/mp4":
            Image.open(io.BytesIO(base64.b64decode(found[2], validate=True))).load()
    return page
