"""Event files of the makers of cameras, encoded here from the public descriptions of their formats, word by word."""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable
from pathlib import Path

import aedat4_files
import numpy as np
import pytest
from aedat4_files import events_packet
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_fuzz import within_limits

from enerf_ns.dataparsers.formats import event_files
from enerf_ns.dataparsers.formats.event_files import open_event_file
from enerf_ns.dataparsers.recording.errors import RecordingError

WIDTH, HEIGHT = 640, 480


def events(num_events: int = 500, start: int = 5_000_000, duration: int = 40_000_000, seed: int = 0) -> np.ndarray:
    """Rows t (microseconds), x, y, polarity 0 or 1, with groups of one time, row and polarity as sensors send them."""
    rng = np.random.default_rng(seed)
    rows = []
    for time in np.sort(rng.choice(duration, num_events, replace=False)) + start:
        x, y, p = rng.integers(WIDTH - 40), rng.integers(HEIGHT), rng.integers(2)
        pixels = np.flatnonzero(rng.random(40) < rng.choice([0.02, 0.5])) if rng.random() < 0.3 else [0]
        rows += [(time, x + pixel, y, p) for pixel in pixels]
    return np.array(rows, dtype=np.int64)


def header(evt: str, *lines: str, size: tuple[int, int] | None = (WIDTH, HEIGHT), end: bool = True) -> bytes:
    lines = ("date 2023-03-29 16:37:46", "integrator_name Prophesee", *([f"evt {evt}"] if evt else []), *lines)
    lines += (f"geometry {size[0]}x{size[1]}",) if size else ()
    lines += ("end",) if end else ()
    return "".join(f"% {line}\n" for line in lines).encode()


def evt2_words(rows: np.ndarray) -> list[int]:
    words, high = [], None
    for t, x, y, p in rows.tolist():
        if t >> 6 != high:
            high = t >> 6
            words.append(0x8 << 28 | high & 0xFFFFFFF)
            words.append(0xA << 28 | (t & 63) << 22 | 1 << 8)  # an external trigger, to be passed over
        words.append(p << 28 | (t & 63) << 22 | x << 11 | y)
    return words


def evt2(rows: np.ndarray) -> bytes:
    return np.array(evt2_words(rows), "<u4").tobytes()


def groups(rows: np.ndarray, length: int) -> list[list[list[int]]]:
    """Consecutive events of one time, row and polarity whose columns rise within `length` pixels."""
    found: list[list[list[int]]] = []
    for row in rows.tolist():
        if found:
            first, last = found[-1][0], found[-1][-1]
            if (row[0], row[2], row[3]) == (first[0], first[2], first[3]) and last[1] < row[1] < first[1] + length:
                found[-1].append(row)
                continue
        found.append([row])
    return found


def evt21(rows: np.ndarray, legacy: bool) -> bytes:
    words, high = [], None
    for group in groups(rows, 32):
        t, x, y, p = group[0]
        if t >> 6 != high:
            high = t >> 6
            words.append(0x8 << 60 | (high & 0xFFFFFFF) << 32)
        mask = sum(1 << (row[1] - x) for row in group)
        words.append(p << 60 | (t & 63) << 54 | x << 43 | y << 32 | mask)
    if legacy:  # the two halves are sent one after the other, the upper one first
        return b"".join(struct.pack("<II", word >> 32, word & 0xFFFFFFFF) for word in words)
    return b"".join(struct.pack("<Q", word) for word in words)


def evt3(rows: np.ndarray, vectors: bool = True) -> bytes:
    words: list[int] = []
    high, low, row_sent = (int(rows[0, 0]) >> 12) - 1, None, None
    for group in groups(rows, 44) if vectors else [[row] for row in rows.tolist()]:
        t, x, y, p = group[0]
        while high < t >> 12:  # a sensor sends each, so that none of the counter's rounds is missed
            high += 1
            words.append(0x8 << 12 | high & 0xFFF)
        if low != t & 0xFFF:
            low = t & 0xFFF
            words.append(0x6 << 12 | low)
        if row_sent != y:
            row_sent = y
            words.append(0x0 << 12 | y)
        if len(group) == 1:
            words.append(0x2 << 12 | p << 11 | x)
            continue
        words.append(0x3 << 12 | p << 11 | x)
        mask = sum(1 << (row[1] - x) for row in group)
        while mask:
            if mask < 256:
                words.append(0x5 << 12 | mask)
                break
            words.append(0x4 << 12 | mask & 0xFFF)
            mask >>= 12
    return np.array(words, "<u2").tobytes()


def dat(rows: np.ndarray, kind: int = 12) -> bytes:
    pairs = (struct.pack("<II", t & 0xFFFFFFFF, x | y << 14 | p << 28) for t, x, y, p in rows.tolist())
    return bytes([kind, 8]) + b"".join(pairs)


def dat_header(*lines: str) -> bytes:
    lines = ("Data file containing CD events.", "Version 2", f"Height {HEIGHT}", f"Width {WIDTH}", *lines)
    return "".join(f"% {line}\n" for line in lines).encode()


def aedat4(rows: np.ndarray, streams: int = 1, kind: str = "EVTS", compress: Callable | None = None) -> bytes:
    packets = [(0, events_packet(rows[i : i + 100], kind)) for i in range(0, len(rows), 100)]
    return aedat4_files.aedat4((WIDTH, HEIGHT), [kind] * streams, packets, compress)


FORMATS: dict[str, tuple[str, Callable[[np.ndarray], bytes]]] = {
    "EVT2": ("EVT2", lambda rows: header("2.0") + evt2(rows)),
    "EVT2 of a new header": (
        "EVT2",
        lambda rows: header("", "format EVT2;height=480;width=640", size=None) + evt2(rows),
    ),
    "EVT2 without an end": ("EVT2", lambda rows: header("2.0", end=False) + evt2(rows)),
    "EVT2.1": ("EVT2.1", lambda rows: header("2.1", "format EVT21;endianness=little") + evt21(rows, legacy=False)),
    "EVT2.1 of an IMX636": ("EVT2.1", lambda rows: header("", "format EVT21;endianness=legacy") + evt21(rows, True)),
    "EVT2.1 endianness alone": (
        "EVT2.1",
        lambda rows: header("", "endianness legacy", "format EVT21") + evt21(rows, True),
    ),
    "EVT2.1 unstated": ("EVT2.1", lambda rows: header("2.1") + evt21(rows, legacy=False)),
    "EVT2.1 legacy unstated": ("EVT2.1", lambda rows: header("2.1") + evt21(rows, legacy=True)),
    "EVT3": ("EVT3", lambda rows: header("3.0", "format EVT3;height=480;width=640") + evt3(rows)),
    "EVT3 without vectors": ("EVT3", lambda rows: header("3.0") + evt3(rows, vectors=False)),
    "DAT": ("DAT", lambda rows: dat_header() + dat(rows)),
    "DAT of 2D events": ("DAT", lambda rows: dat_header() + dat(rows, kind=0)),
    "AEDAT4": ("AEDAT4", aedat4),
}


def decoded(path: Path) -> np.ndarray:
    """Rows t (microseconds), x, y, p as they are in the file."""
    file = open_event_file(path)
    pieces = [np.column_stack([e.t + file.start, e.x, e.y, e.p]).astype(np.int64) for e in file.stream()]
    rows = np.concatenate(pieces)
    assert (rows[:, 0] % 1000 == 0).all() and next(file.stream()).t.dtype == np.int64
    return rows // [1000, 1, 1, 1]


@pytest.fixture(params=FORMATS.values(), ids=list(FORMATS))
def encoding(request: pytest.FixtureRequest) -> tuple[str, Callable[[np.ndarray], bytes]]:
    """Its name and how it writes events."""
    library = {"EVT3": "evt3", "AEDAT4": "aedat"}.get(request.param[0])
    if library:
        pytest.importorskip(library)
    return request.param


@pytest.mark.parametrize("piece", [64, 2**18])
def test_events_are_those_that_were_encoded(
    tmp_path: Path, encoding: tuple[str, Callable], piece: int, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(event_files, "BYTES_AT_A_TIME", piece)
    rows = events()
    path = tmp_path / "recording"
    path.write_bytes(encoding[1](rows))
    file = open_event_file(path)
    assert file.encoding == encoding[0] and file.size == (WIDTH, HEIGHT) and file.path == path
    assert file.start == rows[0, 0] * 1000
    np.testing.assert_array_equal(decoded(path), rows)
    assert next(file.stream()).t[0] == 0


@pytest.mark.parametrize(("name", "bits"), [("EVT2", 34), ("EVT2.1", 34), ("DAT", 32)])
def test_clocks_that_begin_again(tmp_path: Path, name: str, bits: int):
    """After hours the camera's counter starts at zero; time goes on."""
    rows = events(100, start=2**bits - 1_000_000, duration=3_000_000)
    path = tmp_path / "recording"
    path.write_bytes(FORMATS[name][1](rows))
    assert rows[0, 0] < 2**bits < rows[-1, 0]
    np.testing.assert_array_equal(decoded(path), rows)


@pytest.mark.parametrize("name", ["EVT2", "EVT2.1", "EVT2.1 of an IMX636"])
def test_events_before_the_first_time_are_left_out(tmp_path: Path, name: str):
    rows = events(20)
    content = FORMATS[name][1](rows)
    word = event_files.WORD_BYTES[FORMATS[name][0]]
    start = content.index(b"% end\n") + 6
    path = tmp_path / "recording"
    path.write_bytes(content[:start] + content[-word:] + content[start:])  # its last event also as its first word
    np.testing.assert_array_equal(decoded(path), rows)


def test_a_file_that_grows_is_read_as_it_was(tmp_path: Path):
    path = tmp_path / "recording"
    rows = events(20)
    path.write_bytes(FORMATS["EVT2"][1](rows))
    file = open_event_file(path)
    with open(path, "ab") as more:
        more.write(evt2(rows))
    assert sum(len(piece) for piece in file.stream()) == len(rows)


def test_a_file_that_shrinks_is_noticed(tmp_path: Path):
    path = tmp_path / "recording"
    path.write_bytes(FORMATS["DAT"][1](events(50)))
    file = open_event_file(path)
    path.write_bytes(path.read_bytes()[:-80])
    with pytest.raises(RecordingError, match="became shorter while it was read"):
        list(file.stream())


def test_compressed_aedat4(tmp_path: Path):
    pytest.importorskip("aedat")
    compress = pytest.importorskip("lz4.frame").compress
    rows = events(2000)
    (tmp_path / "recording").write_bytes(aedat4(rows, compress=compress))
    assert len(aedat4(rows, compress=compress)) < len(aedat4(rows)) / 1.5
    np.testing.assert_array_equal(decoded(tmp_path / "recording"), rows)


ROWS = events(50)
BAD: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "is empty; an event file was expected"),
    "text": (b"0.1 2 3 1\n", "begins with b'0.1 2 3 1\\n', but Prophesee's .raw"),
    "HDF5": (b"\x89HDF\r\n\x1a\n", "begins with b'\\x89HDF"),
    "no header": (evt2(ROWS), "but Prophesee's .raw (EVT2, EVT2.1, EVT3) and .dat files"),
    "PDF": (b"%PDF-1.4\n", "states no encoding, but EVT2, EVT2.1, EVT3 and DAT are known"),
    "per cent signs": (b"%" * 100, "states no encoding"),
    "AEDAT2": (b"#!AER-DAT2.0\r\n# This is a raw AE data file\r\n", "begins with b'#!AER-DAT2.0', but"),
    "EVT4": (header("4.0") + b"12345678", "states evt 4.0, but EVT2, EVT2.1, EVT3 and DAT are known"),
    "histograms": (header("", "format HISTO3D;height=320;width=320") + b"1234", "states HISTO3D, but"),
    "big endian": (header("", "format EVT2;endianness=big") + evt2(ROWS), "states the endianness big, but little"),
    "EVT2 legacy": (
        header("", "format EVT2;endianness=legacy") + evt2(ROWS),
        "states the endianness legacy, but little",
    ),
    "size 0": (header("2.0", size=(0, 480)) + evt2(ROWS), "states a sensor of 0 x 480, but whole pixels"),
    "size no number": (header("2.0", "geometry wide", size=None) + evt2(ROWS), "states a sensor of wide x , but whole"),
    "only a header": (header("2.0"), "holds no events"),
    "only times": (header("2.0") + struct.pack("<I", 0x80000001), "holds no events"),
    "EVT2 cut off": (header("2.0") + evt2(ROWS)[:-1], "ends in the middle of a word of EVT2, which has 4 bytes"),
    "EVT2.1 cut off": (header("2.1") + evt21(ROWS, True)[:-4], "ends in the middle of a word of EVT2.1"),
    "DAT cut off": (dat_header() + dat(ROWS)[:-3], "ends in the middle of a word of DAT, which has 8 bytes"),
    "EVT3 as EVT2": (
        header("2.0") + evt3(ROWS, False).ljust(len(evt3(ROWS, False)) // 4 * 4 + 4, b"\0"),
        "which EVT2 has",
    ),
    "no order": (header("2.1") + struct.pack("<Q", 1), "does not state the endianness of its EVT2.1 words"),
    "DAT of triggers": (
        dat_header() + dat(ROWS, kind=14),
        "a DAT file of version 2 with events of type 14 and 8 bytes",
    ),
    "DAT without events": (dat_header()[:-1], "a DAT file of version 2 with events of type"),
    "DAT of version 1": (dat_header().replace(b"Version 2", b"Version 1") + dat(ROWS), "a DAT file of version 1"),
}
BAD_EVT3: dict[str, tuple[bytes, str]] = {
    "EVT3 cut off": (header("3.0") + evt3(ROWS)[:-1], "ends in the middle of a word of EVT3, which has 2 bytes"),
    "EVT3 unknown word": (header("3.0") + evt3(ROWS) + b"\0\x90", "holds a word of type 0x9, which EVT3 has not"),
}
BAD_AEDAT4: dict[str, tuple[bytes, str]] = {
    "AEDAT4 header alone": (aedat4(ROWS)[:14], "is damaged"),
    "AEDAT4 header cut off": (aedat4(ROWS)[:200], "is damaged"),
    "AEDAT4 cut off": (aedat4(ROWS)[:-1], "is damaged (it is cut off); copy it again"),
    "AEDAT4 cut off between packets": (aedat4(ROWS) + b"\0\0", "is damaged"),
    "AEDAT4 without packets": (aedat4(ROWS[:0]), "holds no events"),
    "AEDAT4 without events": (aedat4(ROWS[:0], kind="IMUS"), "holds 0 streams of events, but one was expected"),
    "AEDAT4 of two cameras": (aedat4(ROWS, streams=2), "holds 2 streams of events, but one was expected"),
    "AEDAT4 with another XML": (aedat4(ROWS).replace(b"</dv>", b"</vd>"), "is damaged"),
}


def refused(path: Path, content: bytes, message: str) -> None:
    path.write_bytes(content)
    with pytest.raises(RecordingError) as caught:
        for _ in open_event_file(path).stream():
            pass
    assert message in str(caught.value) and str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("content", "message"), BAD.values(), ids=BAD.keys())
def test_bad_files(tmp_path: Path, content: bytes, message: str):
    refused(tmp_path / "recording.raw", content, message)


@pytest.mark.parametrize(("content", "message"), BAD_EVT3.values(), ids=BAD_EVT3.keys())
def test_bad_evt3(tmp_path: Path, content: bytes, message: str):
    pytest.importorskip("evt3")
    refused(tmp_path / "recording.raw", content, message)


@pytest.mark.parametrize(("content", "message"), BAD_AEDAT4.values(), ids=BAD_AEDAT4.keys())
def test_bad_aedat4(tmp_path: Path, content: bytes, message: str):
    pytest.importorskip("aedat")
    refused(tmp_path / "recording.aedat4", content, message)


def test_missing_file(tmp_path: Path):
    with pytest.raises(RecordingError, match="is missing"):
        open_event_file(tmp_path / "nothing.raw")


def test_a_file_that_does_not_state_its_size(tmp_path: Path):
    (tmp_path / "a.raw").write_bytes(header("2.0", size=None) + evt2(ROWS))
    assert open_event_file(tmp_path / "a.raw").size is None


@pytest.mark.parametrize(("name", "library"), [("EVT3", "evt3"), ("AEDAT4", "aedat")])
def test_missing_library(tmp_path: Path, name: str, library: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, library, None)  # as Python does where a package is not installed
    (tmp_path / "recording").write_bytes(FORMATS[name][1](ROWS))
    with pytest.raises(RecordingError) as caught:
        open_event_file(tmp_path / "recording")
    assert str(caught.value).endswith("run: pip install 'enerf-ns[event-files]'")
    assert f"the package {library}, which is not installed" in str(caught.value)


def test_a_damaged_packet_is_told_in_one_sentence_and_nothing_else(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    pytest.importorskip("aedat")
    content = bytearray(aedat4(ROWS))
    text = content.index(b"<dv")
    content[text - 4 : text] = struct.pack("<I", 2**31)  # bytes of text that the header says it holds
    refused(tmp_path / "recording.aedat4", bytes(content), "is damaged (range end index ")
    assert capfd.readouterr() == ("", "")


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files_are_refused_or_read(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject):
    names = [name for name in FORMATS if name != "EVT3" or event_files_available("evt3")]
    names = [name for name in names if name != "AEDAT4" or event_files_available("aedat")]
    content = bytearray(FORMATS[data.draw(st.sampled_from(names))][1](ROWS))
    for _ in range(data.draw(st.integers(1, 5))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content)))]
    path = tmp_path_factory.getbasetemp() / "mutated"
    path.write_bytes(content)
    try:
        with within_limits():
            for piece in open_event_file(path).stream():
                assert len(piece.x) == len(piece.y) == len(piece.t) == len(piece.p)
    except RecordingError as error:
        assert str(path) in str(error)


def event_files_available(library: str) -> bool:
    try:
        __import__(library)
    except ImportError:
        return False
    return True
