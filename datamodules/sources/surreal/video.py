"""SURREAL's colour frames, as they stand in a clip's video."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from datamodules.sources.surreal.files import IMAGE_SIZE
from ljn.reading import READ_ERRORS, reason


def read_video(path: Path, frames: Sequence[int], length: int) -> list[np.ndarray]:
    """The images `(240, 320, 3)`, uint8 RGB, of some frames, numbered from 0, of an `.mp4`.

    Args:
        path: The file.
        frames: The frames, in any order.
        length: How many frames the clip has.

    Raises:
        FileNotFoundError: No such file.
        ValueError: It is damaged up to the last of these frames, or has another number of frames or another size.
    """
    import av  # takes half a second

    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; copy it beside the clip's other files")
    wanted, found = set(frames), {}
    try:
        # The format and the protocol are named: a file that is none of these could make FFmpeg open others.
        with av.open(f"file:{path}", format="mp4", options={"protocol_whitelist": "file"}) as container:
            [stream] = container.streams.video
            if stream.frames != length:
                raise ValueError(f"expected the {length} frames of its _info.mat, got {stream.frames}")
            stream.codec_context.thread_count = 1
            rate = stream.average_rate or 0  # that of a single frame may be unknown
            for number, frame in enumerate(container.decode(stream)):
                if (frame.height, frame.width) != IMAGE_SIZE:
                    raise ValueError(
                        f"expected images of {IMAGE_SIZE} (height, width), got {(frame.height, frame.width)}"
                    )
                # Where a decoder notices damage, it paints it over and says so.
                if frame.is_corrupt or (number and round(frame.time * rate) != number):
                    raise ValueError(f"frame {number} (of 0 to {length - 1}) is damaged, or out of its place")
                if number in wanted:
                    found[number] = frame.to_ndarray(format="rgb24")
                if len(found) == len(wanted):
                    break
    except READ_ERRORS as error:
        raise ValueError(
            f"{path}: cannot be used as a clip's video ({reason(error)}); copy it again"
        ) from error
    if missing := wanted - found.keys():
        raise ValueError(f"{path}: frame {min(missing)} (of 0 to {length - 1}) is missing; copy it again")
    return [found[frame] for frame in frames]
