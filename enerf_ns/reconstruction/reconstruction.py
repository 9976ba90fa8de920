"""A recording with frames that are reconstructed from its events, to learn from in place of those of a camera."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64
from PIL import Image
from rich.progress import track

from enerf_ns.dataparsers.formats.conversion import new_folder, write_recording
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.formats.writer import GrowingArray
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.files import of_file
from enerf_ns.dataparsers.recording.recording import EventRecording, Frames
from enerf_ns.dataparsers.sensor_estimates.estimates import ASSUMED_THRESHOLD
from enerf_ns.reconstruction.complementary_filter import ComplementaryFilter
from enerf_ns.reconstruction.frames_of_events import NetworkReconstruction, reconstruct_frames
from enerf_ns.reconstruction.networks import load_network

DEFAULT_FRAMES_PER_SECOND = 30.0
"""Frames reconstructed per second of a recording that has none."""

DEFAULT_CUTOFF_FREQUENCY = 0.5
"""Of the complementary filter, Hz. Of 0, 0.05, 0.1, 0.2, 0.5, 1 and 2, its frames resemble the true ones of
slider_depth the most with this one, and those of a simulated shake nearly so (correlation 0.62 and 0.85; with 1: 0.56
and 0.86)."""

HIGHEST_CUTOFF_FREQUENCY = 1000.0
"""Highest of the complementary filter, Hz."""

MOST_FRAMES = 100_000
"""Most frames that are reconstructed of one recording."""

RANGE_PERCENTILES = (1.0, 99.0)
"""Percentiles of the brightness of all frames that become black and white; one range for all, since a field has one
brightness. With a range of its own for each, FireNet's frames of slider_depth vary more (their mean grey value by 5.7
against 4.1, that of the true ones by 1.6) at the same correlation (0.69)."""

SAMPLED_PIXELS = 10_000_000
"""Pixels of all frames, spread evenly, of which the percentiles are taken at most."""


def reconstruct(
    source: Path,
    output_dir: Path,
    weights: Path | None = None,
    frames_per_second: float | None = None,
    cutoff_frequency: float | None = None,
    **options: object,
) -> list[str]:
    """Writes a recording into a new folder of the layout event_recording, with frames reconstructed from its events.

    They stand as blurred frames beside the sharp ones, at the same instants, so that training learns from them and
    evaluation looks at the sharp ones. All of them are scaled to 8 bits alike.

    Args:
        source: Folder of a recording of any registered format; only read.
        output_dir: New or empty folder, which is whole afterwards or not there.
        weights: Checkpoint of E2VID or FireNet; None: a complementary filter.
        frames_per_second: For a recording without frames; None: `DEFAULT_FRAMES_PER_SECOND`.
        cutoff_frequency: Of the complementary filter, Hz; None: `DEFAULT_CUTOFF_FREQUENCY`.
        options: Of the format, by name.

    Returns:
        What was found, and what is left out, in sentences.

    Raises:
        RecordingError: The recording or the weights cannot be used.
        FlagError: The format lacks an option, or something is given that changes nothing or is out of range.
        OutputError: The folder holds something, lies in the recording, or cannot be written.
    """
    if weights is not None and cutoff_frequency is not None:
        raise FlagError("--cutoff-frequency is of the complementary filter, but --weights were given; leave one out.")
    if cutoff_frequency is None:
        cutoff_frequency = DEFAULT_CUTOFF_FREQUENCY
    if not 0 <= cutoff_frequency <= HIGHEST_CUTOFF_FREQUENCY:
        raise FlagError(
            f"--cutoff-frequency is {cutoff_frequency:g}, but must be from 0 to {HIGHEST_CUTOFF_FREQUENCY:g} (Hz)."
        )
    with new_folder(source, output_dir) as folder:
        recording = read_recording(source, **options)  # type: ignore[arg-type]
        if recording.bayer_pattern is not None:
            raise RecordingError(
                f"{source} is of a sensor with the colour filter {recording.bayer_pattern}, but frames are "
                "reconstructed of grey sensors alone."
            )
        camera = recording.camera
        if weights is not None:
            network = load_network(weights)
            name = f"{network.name} ({weights.name})"
            reconstruction = NetworkReconstruction(network, name, camera.width, camera.height)
        else:
            thresholds = recording.contrast_thresholds or (ASSUMED_THRESHOLD, ASSUMED_THRESHOLD)
            size, start = (camera.width, camera.height), recording.span[0]
            reconstruction = ComplementaryFilter(*size, thresholds, cutoff_frequency, start)
        times, numbers = _instants(recording, frames_per_second)
        made = folder / ".reconstructed"
        made.mkdir()
        brightness = reconstruct_frames(recording, reconstruction, times)
        shown = track(brightness, "Reconstructing frames", len(times), transient=True)
        with of_file(source):
            files = _write_frames(shown, (camera.width, camera.height), made)
        frames = Frames(files, times, camera, recording.trajectory, numbers=numbers)
        with_frames = replace(recording, blurred_frames=frames, reconstructed_by=reconstruction.name)
        sentences = write_recording(with_frames, folder)
        shutil.rmtree(made)
    if recording.blurred_frames is not None:
        sentences.insert(0, "The blurred frames of the recording are left out.")
    sentences.append(f"{len(times):,} frames are reconstructed by {reconstruction.name}.")
    return sentences


def _instants(
    recording: EventRecording, frames_per_second: float | None
) -> tuple[Int64[np.ndarray, " frames"], Int64[np.ndarray, " frames"]]:
    """Times (ns) of the frames, and their numbers: those of the recording's frames, or evenly spaced."""
    frames = recording.frames or recording.blurred_frames
    if frames is not None:
        if frames_per_second is not None:
            raise FlagError(
                f"--frames-per-second is for recordings without frames, but {recording.path} has {len(frames.times)}, "
                "at whose instants frames are reconstructed; leave it out."
            )
        return frames.times, frames.numbers
    rate = DEFAULT_FRAMES_PER_SECOND if frames_per_second is None else frames_per_second
    start, end = recording.span
    number = (end - start) * 1e-9 * rate
    if not 1 <= number <= MOST_FRAMES:
        raise FlagError(
            f"--frames-per-second {rate:g} makes {number:g} frames of the {(end - start) * 1e-9:g} s of "
            f"{recording.path}, but from 1 to {MOST_FRAMES:,} were expected."
        )
    times = start + (np.arange(1, int(number) + 1) * 1e9 / rate).astype(np.int64)
    return times, np.arange(len(times))


def _write_frames(
    frames: Iterable[Float32[np.ndarray, "height width"]], size: tuple[int, int], folder: Path
) -> tuple[Path, ...]:
    """Writes frames as 8-bit PNG, all scaled alike, and holds one of them at a time.

    Args:
        frames: Brightness of any scale.
        size: Width and height, pixels.
        folder: Exists and is empty.

    Returns:
        The files.

    Raises:
        ValueError: All frames are of one brightness; a sentence that can follow "RECORDING holds".
        OSError: The disk is full.
    """
    stored, width, height = folder / "brightness.npy", *size
    with closing(GrowingArray(stored, np.float32, (height, width))) as file:
        for frame in frames:
            file.append(frame[None])
            file.commit(file.num_rows + 1)
    brightness = np.load(stored, mmap_mode="r")
    pixels = brightness.reshape(-1)
    black, white = np.percentile(pixels[:: len(pixels) // SAMPLED_PIXELS + 1], RANGE_PERCENTILES)
    if not white > black:
        raise ValueError("no frame that is not of one brightness, since hardly an event comes before one")
    files = tuple(folder / f"{number:05d}.png" for number in range(len(brightness)))
    for file, frame in zip(files, brightness, strict=True):
        shades = 255.0 * ((frame - black) / (white - black)).clip(0.0, 1.0)
        Image.fromarray(shades.round().astype(np.uint8)).save(file)
    stored.unlink()
    return files
