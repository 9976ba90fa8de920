"""The report as one HTML page, and as Markdown."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from enerf_ns.dataparsers.recording.files import fill_page
from enerf_ns.report.film import webp
from enerf_ns.report.pictures import EVENTS, POLARITIES, Column
from enerf_ns.report.reported import Reported
from enerf_ns.report.tables import HOW_TO_READ, Table

PICTURE_WIDTH = 320
"""Largest width of a picture on the page in pixels, and the least of one that is enlarged."""


@dataclass(frozen=True)
class Part:
    """A part of the report below the pictures."""

    title: str
    tables: Sequence[Table] = ()
    figures: dict[str, bytes] = field(default_factory=dict)
    """PNG files by name."""
    is_folded: bool = True
    """Whether the page shows only the title until a reader opens the part."""

    @property
    def reading(self) -> dict[str, str]:
        """The meaning of each column of scores, by its header."""
        header = dict.fromkeys(name for table in self.tables for name in table.header)
        return {name: HOW_TO_READ[name] for name in header if name in HOW_TO_READ}


def page(reported: Sequence[Reported], parts: Sequence[Part]) -> str:
    """One HTML file that holds all tables, pictures and films, and loads no other file.

    One run is shown with all pictures. Several runs are shown with a row of pictures each, and the rest folded.
    """
    several = len(reported) > 1
    return fill_page(
        Path(__file__).with_name("report.html"),
        title=title_of(reported),
        runs=[_run_on_page(one, several) for one in reported],
        several=several,
        parts=[
            {
                "title": part.title,
                "tables": part.tables,
                "figures": [data_uri("image/png", content) for content in part.figures.values()],
                "reading": part.reading,
                "is_folded": part.is_folded,
            }
            for part in parts
        ],
    )


def markdown(reported: Sequence[Reported], parts: Sequence[Part]) -> str:
    """The contents of the page in Markdown, with links to the files."""
    lines = [f"# {title_of(reported)}"]
    for one in reported:
        lines.append(f"## {one.name}")
        lines += [line for line in (one.summary, f"State: {one.files.state}.") if line]
        if one.picture:
            lines.append(f"![{one.name}]({one.picture[0]})")
        lines += [*([one.caption] if one.caption else []), *one.notes, *one.not_scored()]
        if one.moving is not None:
            lines.append(f"![Events, render and depth along the recorded path]({one.prefix}moving.webp)")
        if one.mesh is not None:
            lines.append(f"![Mesh]({one.prefix}mesh.webp)")
        if one.video is not None:
            lines.append(f"[Video]({one.prefix}video.mp4). {one.video_note}")
    for part in parts:
        lines.append(f"## {part.title}")
        for table in part.tables:
            lines += [table.markdown(), *([table.note] if table.note else [])]
        if part.reading:
            lines.append("\n".join(f"* {name}: {meaning}" for name, meaning in part.reading.items()))
        lines += [f"![{part.title}]({name})" for name in part.figures]
    for one in reported:
        lines.append(f"## How {one.name} was made")
        lines.append("\n".join(f"* {name}: {value}" for name, value in one.making()))
    return "\n\n".join(lines) + "\n"


def title_of(reported: Sequence[Reported]) -> str:
    """The name of the run, or the number of runs."""
    return reported[0].name if len(reported) == 1 else f"{len(reported)} runs"


def data_uri(kind: str, content: bytes) -> str:
    """A file within the page."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _run_on_page(one: Reported, several: bool) -> dict[str, Any]:
    """The values of a run for the template."""
    main = [column for column in one.columns if column.is_main]
    more = [column for column in one.columns if not column.is_main]
    number = len(main[0].pictures) if main else 0
    rest: list[list[Column]] = [more]
    if several and number > 1:
        middle = number // 2
        rest = [[_without(column, middle) for column in main], more]
        main = [replace(column, **_chosen(column, [middle])) for column in main]
    preview = None if one.columns or one.picture is None else data_uri("image/png", one.picture[1])
    return {
        "name": one.name,
        "state": "" if one.files.state == "done" else one.files.state,
        "summary": one.summary,
        "main": [_column_on_page(column) for column in main],
        "more": [[_column_on_page(column) for column in columns] for columns in rest if columns],
        "caption": one.caption,
        "preview": preview,
        "notes": [*one.notes, *one.not_scored()],
        "moving": one.moving and data_uri("image/webp", one.moving),
        "video": one.video and data_uri("video/mp4", one.video),
        "poster": one.poster and data_uri("image/webp", one.poster),
        "video_note": one.video_note,
        "mesh": one.mesh and data_uri("image/webp", one.mesh),
        "making": one.making(),
    }


def _without(column: Column, number: int) -> Column:
    return replace(column, **_chosen(column, [n for n in range(len(column.pictures)) if n != number]))


def _chosen(column: Column, numbers: Sequence[int]) -> dict[str, Any]:
    """The fields of a column for some of its views."""
    opacities = column.opacities
    return {
        "pictures": [column.pictures[number] for number in numbers],
        "opacities": None if opacities is None else [opacities[number] for number in numbers],
    }


def _column_on_page(column: Column) -> dict[str, Any]:
    """The values of a column for the template: pictures, and the scale or the meaning of colours."""
    pictures = [column.coloured(number) for number in range(len(column.pictures))]
    low, high = column.limits
    colours = np.linspace(low, high, 256)[None]
    scale = replace(column, pictures=[colours], opacities=None).coloured(0) if column.bar else None
    return {
        "title": column.title,
        "pictures": [
            None if picture is None else data_uri("image/webp", webp(_fitted(picture))) for picture in pictures
        ],
        "scale": None if scale is None else data_uri("image/webp", webp(scale)),
        "ends": (f"{low:.2g}", f"{high:.2g}"),
        "bar": column.bar,
        "legend": [(what, "#{:02x}{:02x}{:02x}".format(*colour)) for what, colour in POLARITIES.items()]
        if column.title == EVENTS
        else [],
    }


def _fitted(picture: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "tall wide 3"]:
    """The picture at a size for the page. Its pixels become whole squares if it is small."""
    height, width = picture.shape[:2]
    if width > PICTURE_WIDTH:
        size = PICTURE_WIDTH, max(1, round(height * PICTURE_WIDTH / width))
        return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    times = -(-PICTURE_WIDTH // width)
    return picture.repeat(times, axis=0).repeat(times, axis=1)
