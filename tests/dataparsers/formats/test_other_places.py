"""Recordings that would have other files of the disk read, or what never ends: refused, whatever their format."""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
import pytest
import test_esim_npz
from recordings import write_davis
from test_bad_input import is_one_sentence, read_all
from test_fuzz import LAYOUTS, write_eds, write_tum_vie

from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import load_image

NO_FILES: dict[str, Callable[[Path], object]] = {
    "a pipe": os.mkfifo,
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "a folder": Path.mkdir,
    "itself": lambda path: path.symlink_to(path),
}


@contextmanager
def within(seconds: int) -> Iterator[None]:
    """Fails where the block waits for longer."""

    def stop(*_: object) -> None:
        raise AssertionError("it waits")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes with names")
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("kind", NO_FILES)
def test_what_is_no_file_is_no_recording(layout: str, kind: str, tmp_path: Path):
    """In the place of each file: one sentence, or a reading without the file where it may be missing; never a wait."""
    whole = tmp_path / "whole"
    LAYOUTS[layout].write(whole)
    refused = 0
    for number, file in enumerate(sorted(path.relative_to(whole) for path in whole.rglob("*") if path.is_file())):
        folder = tmp_path / str(number)
        shutil.copytree(whole, folder)
        (folder / file).unlink()
        NO_FILES[kind](folder / file)
        try:
            with within(20):
                read_all(folder, LAYOUTS[layout].format)
        except RecordingError as error:
            assert is_one_sentence(str(error)), error
            refused += 1
        shutil.rmtree(folder)
    assert refused


def test_an_image_that_is_a_device_is_no_image(tmp_path: Path):
    (tmp_path / "image.png").symlink_to("/dev/zero")
    with within(20), pytest.raises(RecordingError, match="no regular file"):
        load_image(tmp_path / "image.png")


def secret(folder: Path) -> Path:
    """Something else on the disk, which could pass for a column of events."""
    path = folder / "secret"
    np.zeros(10**5, np.uint16).tofile(path)
    with h5py.File(folder / "secret.h5", "w") as file:
        file["x"] = np.zeros(10**5, np.uint16)
    return path


def external_storage(file: h5py.File, name: str, secret: Path) -> None:
    column = file[name]
    shape, kind = column.shape, column.dtype  # type: ignore[union-attr]
    del file[name]
    file.create_dataset(name, shape, kind, external=[(str(secret), 0, h5py.h5f.UNLIMITED)])


def external_link(file: h5py.File, name: str, secret: Path) -> None:
    del file[name]
    file[name] = h5py.ExternalLink(f"{secret}.h5", "x")


def virtual(file: h5py.File, name: str, secret: Path) -> None:
    column = file[name]
    shape, kind = column.shape, column.dtype  # type: ignore[union-attr]
    del file[name]
    layout = h5py.VirtualLayout(shape, kind)
    layout[: min(shape[0], 10**5)] = h5py.VirtualSource(f"{secret}.h5", "x", (10**5,))[: min(shape[0], 10**5)]
    file.create_virtual_dataset(name, layout)


@pytest.mark.parametrize("refer", [external_storage, external_link, virtual])
@pytest.mark.parametrize(
    ("write", "format", "pattern", "name"),
    [
        (lambda folder: write_eds(folder, prepared=False), "eds", "events.h5", "x"),
        (lambda folder: write_tum_vie(folder, "raw"), "tum_vie", "*events_left.h5", "events/y"),
        (lambda folder: write_tum_vie(folder, "raw"), "tum_vie", "*events_left.h5", "events"),
    ],
)
def test_columns_of_events_that_lie_elsewhere_are_not_read(refer, write, format, pattern, name, tmp_path: Path):
    if name == "events" and refer is not external_link:
        pytest.skip("a group has no storage")
    folder = tmp_path / "recording"
    write(folder)
    (path,) = folder.rglob(pattern)
    with h5py.File(path, "r+") as file:
        refer(file, name, secret(tmp_path))
    with pytest.raises(RecordingError, match=r"refers for .* to another place") as error:
        read_all(folder, format)
    assert str(path) in str(error.value) and is_one_sentence(str(error.value))


@pytest.mark.parametrize("refer", [external_storage, external_link])
def test_a_rectify_map_that_lies_elsewhere_is_not_read(refer, tmp_path: Path):
    folder = tmp_path / "recording"
    write_eds(folder, prepared=True)
    (path,) = folder.rglob("rectify_map*.h5")
    with h5py.File(path, "r+") as file:
        refer(file, "rectify_map", secret(tmp_path))
    with pytest.raises(RecordingError, match="refers for rectify_map to another place"):
        read_all(folder, "eds")


@pytest.mark.parametrize(
    "place", ["../elsewhere/frame.png", "/{}/elsewhere/frame.png", "images/../../elsewhere/frame.png"]
)
def test_lists_of_images_stay_within_the_folder(place: str, tmp_path: Path):
    folder = write_davis(tmp_path / "recording")
    images = (folder / "images.txt").read_text().splitlines()
    (tmp_path / "elsewhere").mkdir()
    shutil.copy(folder / images[0].split()[1], tmp_path / "elsewhere/frame.png")
    images[0] = f"{images[0].split()[0]} {place.format(tmp_path)}"
    (folder / "images.txt").write_text("\n".join(images) + "\n")
    with pytest.raises(RecordingError, match=r"line 1 lists .* which lies outside") as error:
        read_all(folder, "davis")
    assert is_one_sentence(str(error.value))


def linked(path: Path, place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    shutil.move(path, place)
    path.symlink_to(place)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_links_that_lead_out_are_followed_and_named_in_one_line(
    layout: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Whatever the format, and whichever of its files is linked."""
    LAYOUTS[layout].write(tmp_path / "whole")
    files = sorted(path.relative_to(tmp_path / "whole") for path in (tmp_path / "whole").rglob("*") if path.is_file())
    for number, file in enumerate(files):
        folder = tmp_path / str(number) / layout / "recording"  # a camera of EVIMO2 is known by a name above it
        shutil.copytree(tmp_path / "whole", folder)
        linked(folder / file, tmp_path / "elsewhere" / file)
        read_all(folder, LAYOUTS[layout].format)
        printed = capsys.readouterr().out
        assert f"Links of {folder} lead out of it: {file} to {tmp_path / 'elsewhere' / file}. They" in printed
        assert printed.count("\n") == 1
        shutil.rmtree(folder)


def test_links_within_a_recording_and_its_own_link_are_not_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = write_davis(tmp_path / "recording")
    linked(folder / "events.txt", folder / "large/events.txt")
    (folder / "nowhere").symlink_to("none")
    (tmp_path / "link").symlink_to(folder)
    read_all(tmp_path / "link", "davis")
    assert capsys.readouterr().out == ""


def test_linked_folders_and_many_links_are_named_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = write_davis(tmp_path / "recording")
    linked(folder / "images", tmp_path / "pictures")
    secret(tmp_path)
    (folder / "a secret").symlink_to(tmp_path / "secret")
    for number in range(1000):
        (tmp_path / "depth").mkdir(exist_ok=True)
        (tmp_path / f"depth/{number}.npy").touch()
        (folder / f"{number}.npy").symlink_to(tmp_path / f"depth/{number}.npy")
    read_all(folder, "davis")
    (line,) = capsys.readouterr().out.splitlines()
    assert f"to {tmp_path}/pictures" in line or f"to {tmp_path}/secret" in line
    assert f"and 999 more to {tmp_path}/depth" in line and len(line) < 600


@pytest.mark.parametrize("place", ["../elsewhere/frame", "/{}/elsewhere/frame.png"])
def test_lists_of_views_stay_within_the_folder(place: str, tmp_path: Path):
    folder = tmp_path / "recording"
    test_esim_npz.write_views(test_esim_npz.write_npz(folder) / "views")
    path = folder / "views/transforms_test.json"
    about = json.loads(path.read_text())
    (tmp_path / "recording/elsewhere").mkdir()
    (tmp_path / "elsewhere").mkdir()
    for elsewhere in (folder / "elsewhere", tmp_path / "elsewhere"):
        shutil.copy(next((folder / "views").rglob("*.png")), elsewhere / "frame.png")
    about["frames"][1]["file_path"] = place.format(tmp_path)
    path.write_text(json.dumps(about))
    with pytest.raises(RecordingError, match=r"frames\[1\]\.file_path = .*within .* was expected") as error:
        read_all(folder, "esim_npz")
    assert is_one_sentence(str(error.value))
