"""`enerf inspect`: where its page goes, and what it refuses."""

from __future__ import annotations

import errno
import html
from pathlib import Path

import pytest
from recordings import write_esim

from enerf_ns.dataparsers.recording.errors import FlagError, OutputError, RecordingError
from enerf_ns.scripts.format_options import format_flags
from enerf_ns.scripts.inspect import Inspect


def test_the_page_is_one_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = write_esim(tmp_path / "esim", frames=("images", "images_corrupted"), channels=3)
    output = tmp_path / "new" / "page.html"
    Inspect(folder, output).main()
    assert [path.name for path in output.parent.iterdir()] == ["page.html"]
    assert output.read_text(encoding="utf-8").endswith("</html>")


def test_the_default_is_a_page_in_the_current_folder_and_the_recording_stays_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    folder = write_esim(tmp_path / "a<b> & [c]")
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    Inspect(folder).main()
    (output,) = here.iterdir()
    assert output.name == "inspect-a<b> & [c].html"
    assert html.escape(str(folder)) in output.read_text(encoding="utf-8")
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


@pytest.mark.parametrize("output", ["esim/page.html", "esim/images/page.html"])
def test_nothing_is_written_into_the_recording(tmp_path: Path, output: str):
    folder = write_esim(tmp_path / "esim")
    with pytest.raises(OutputError, match="never written to"):
        Inspect(folder, tmp_path / output).main()
    assert not (tmp_path / output).exists()


def test_a_page_that_cannot_be_written_is_said_in_one_sentence(tmp_path: Path):
    folder = write_esim(tmp_path / "esim")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"^--output .* could not be written \(.*\); give another file\.$"):
        Inspect(folder, tmp_path / "file" / "page.html").main()
    with pytest.raises(OutputError, match="is a folder"):
        Inspect(folder, tmp_path).main()


def test_a_full_disk_leaves_the_page_that_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder, output = write_esim(tmp_path / "esim"), tmp_path / "page.html"
    output.write_text("before")

    def full(path: Path, content: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OutputError, match=r"^--output .* could not be written \(No space left on device\)"):
        Inspect(folder, output).main()
    assert output.read_text() == "before" and {path.name for path in tmp_path.iterdir()} == {"esim", "page.html"}


def test_a_folder_that_is_no_recording_is_said_in_one_sentence(tmp_path: Path):
    with pytest.raises(RecordingError, match="does not exist"):
        Inspect(tmp_path / "nowhere", tmp_path / "page.html").main()
    folder = write_esim(tmp_path / "esim")
    right = format_flags()(event_camera="right")  # type: ignore[call-arg] - a field made from the options of TUM-VIE
    with pytest.raises(FlagError, match=r"--event-camera is for recordings of tum_vie.*, but .* is read as esim"):
        Inspect(folder, tmp_path / "page.html", right).main()
    assert not (tmp_path / "page.html").exists()
