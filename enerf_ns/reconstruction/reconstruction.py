"""Writes a recording with frames reconstructed from its events, for training in place of frames of a camera."""

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
from enerf_ns.dataparsers.formats.event_recording import rest_poses
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
"""Frame rate for a recording without frames, frames per second."""

DEFAULT_CUTOFF_FREQUENCY = 0.5
"""Cut-off frequency of the complementary filter, Hz. Among 0, 0.05, 0.1, 0.2, 0.5, 1 and 2 Hz, 0.5 Hz gives the highest
correlation with the true frames of slider_depth (0.62; 1 Hz: 0.56) and nearly the highest with those of a simulated
shake (0.85; 1 Hz: 0.86)."""

HIGHEST_CUTOFF_FREQUENCY = 1000.0
"""Highest cut-off frequency of the complementary filter, Hz."""

MOST_FRAMES = 100_000
"""Most frames that are reconstructed for one recording."""

RANGE_PERCENTILES = (1.0, 99.0)
"""Percentiles of the brightness of all frames that become black and white. All frames share one range, since a field
has one brightness. With a range for each frame, the mean grey value of FireNet's frames of slider_depth varies more
(5.7 grey levels instead of 4.1; true frames: 1.6), at the same correlation (0.69)."""

SAMPLED_PIXELS = 10_000_000
"""Most pixels, spread evenly over all frames, from which the percentiles are computed."""


def reconstruct(
    source: Path,
    output_dir: Path,
    weights: Path | None = None,
    frames_per_second: float | None = None,
    cutoff_frequency: float | None = None,
    **options: object,
) -> list[str]:
    """Writes a recording in the layout event_recording, with frames reconstructed from its events.

    The reconstructed frames are written as blurred frames, at the times of the sharp frames: training learns from the
    blurred frames, and evaluation uses the sharp frames. All reconstructed frames are scaled to 8 bits alike.

    A recording of the layout event_recording may lack poses.txt, since no pose is looked at. The new one then lacks it,
    too: structure from motion can find poses of its frames.

    Args:
        source: Folder of a recording in any registered format; it is only read.
        output_dir: New or empty folder. After an error it is not there.
        weights: Checkpoint of E2VID or FireNet. Default: a complementary filter.
        frames_per_second: Frame rate for a recording without frames. Default: `DEFAULT_FRAMES_PER_SECOND`.
        cutoff_frequency: Cut-off frequency of the complementary filter, Hz. Default: `DEFAULT_CUTOFF_FREQUENCY`.
        options: Options of the format, by name.

    Returns:
        Sentences about what was found and what was left out.

    Raises:
        RecordingError: The recording or the weights cannot be used.
        FlagError: The format lacks an option, or an argument changes nothing or is out of range.
        OutputError: The folder is not empty, lies in the recording, or cannot be written.
    """
    if weights is not None and cutoff_frequency is not None:
        raise FlagError("--cutoff-frequency is for the complementary filter, but --weights were given; leave one out.")
    if cutoff_frequency is None:
        cutoff_frequency = DEFAULT_CUTOFF_FREQUENCY
    if not 0 <= cutoff_frequency <= HIGHEST_CUTOFF_FREQUENCY:
        raise FlagError(
            f"--cutoff-frequency is {cutoff_frequency:g}, but must be from 0 to {HIGHEST_CUTOFF_FREQUENCY:g} (Hz)."
        )
    with new_folder(source, output_dir) as folder:
        recording = read_recording(source, poses=rest_poses(source), **options)  # type: ignore[arg-type]
        if recording.bayer_pattern is not None:
            raise RecordingError(
                f"{source} was recorded by a sensor with the colour filter {recording.bayer_pattern}, but frames are "
                "reconstructed for grey sensors only."
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
    """Times (ns) and numbers of the frames to reconstruct: those of the recording's frames, or evenly spaced ones."""
    frames = recording.frames or recording.blurred_frames
    if frames is not None:
        if frames_per_second is not None:
            raise FlagError(
                f"--frames-per-second is for recordings without frames, but {recording.path} has {len(frames.times)}, "
                "at whose times frames are reconstructed; leave it out."
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
    """Writes frames as 8-bit PNG files, all scaled alike; holds one frame in memory at a time.

    Args:
        frames: Brightness, on any scale.
        size: Width and height, pixels.
        folder: An empty folder.

    Returns:
        The files.

    Raises:
        ValueError: All frames have one brightness; the message continues "RECORDING holds".
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
        raise ValueError("only frames of one uniform brightness, since hardly any events come before them")
    files = tuple(folder / f"{number:05d}.png" for number in range(len(brightness)))
    for file, frame in zip(files, brightness, strict=True):
        shades = 255.0 * ((frame - black) / (white - black)).clip(0.0, 1.0)
        Image.fromarray(shades.round().astype(np.uint8)).save(file)
    stored.unlink()
    return files
