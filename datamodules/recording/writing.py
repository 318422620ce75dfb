"""A rendered recording as files."""

from pathlib import Path

import numpy as np

from datamodules.recording.synthetic import SyntheticRecording
from ljn.system.readers.recorder import Recorder


def write_recording(recording: SyntheticRecording, folder: str | Path, num_frames: int | None = None) -> None:
    """Write a recording as a folder that `open_recording` reads, with the truth in `truth.npz`.

    Args:
        recording: It.
        folder: A new or empty folder.
        num_frames: The first ones alone; None for all.

    `truth.npz` holds what `Truth` has, each of all frames: `(T, ...)`.

    Raises:
        FileExistsError: The folder is not empty.
    """
    number = recording.num_frames if num_frames is None else min(num_frames, recording.num_frames)
    with Recorder(folder, recording.camera) as recorder:
        for index in range(number):
            recorder.write(recording.frame(index))
    truths = [recording.truth(index) for index in range(number)]
    arrays = {name: np.stack([getattr(truth, name) for truth in truths]) for name in truths[0]._fields}
    np.savez_compressed(Path(folder) / "truth.npz", **arrays)  # type: ignore[arg-type]
