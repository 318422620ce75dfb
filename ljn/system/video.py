"""Pictures as a video, and some of them on a sheet."""

from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np

_QUALITY = "20"  # x264's constant rate factor; lower is better


def write_video(path: Path, pictures: Iterable[np.ndarray], fps: float) -> int:
    """Write an `.mp4` (H.264), whole or not at all, one picture in memory at a time.

    Args:
        path: The file.
        pictures: `(H, W, 3)` uint8 each, all of the first one's size; an odd last row or column is left out, which
            the format cannot hold.
        fps: Pictures a second.

    Returns:
        How many there were; of none, no file is written.

    Raises:
        ValueError: A picture of another size, or no rate.
    """
    import av  # takes half a second

    if not 0 < fps < 1000:
        raise ValueError(f"fps: expected pictures a second, more than 0, got {fps}")
    draft = path.with_name(f".{path.name}")
    count, stream, size = 0, None, (0, 0)
    try:
        with av.open(str(draft), "w", format="mp4", options={"movflags": "faststart"}) as container:
            for picture in pictures:
                even = picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]
                if stream is None:
                    size = even.shape[:2]
                    stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000))
                    stream.height, stream.width = size
                    stream.pix_fmt = "yuv420p"
                    stream.options = {"crf": _QUALITY, "preset": "veryfast"}
                if even.shape[:2] != size:
                    raise ValueError(
                        f"pictures: expected {size[1]} x {size[0]} (width x height), as the first, got "
                        f"{even.shape[1]} x {even.shape[0]} as number {count}"
                    )
                for packet in stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(even), "rgb24")):
                    container.mux(packet)
                count += 1
            if stream is not None:
                for packet in stream.encode():
                    container.mux(packet)
        if count:
            draft.replace(path)
        return count
    finally:
        draft.unlink(missing_ok=True)


def contact_sheet(pictures: Sequence[np.ndarray], num_columns: int) -> np.ndarray:
    """Pictures `(H, W, 3)` uint8 of one size side by side, in reading order: `(R * H, C * W, 3)`."""
    height, width, _ = pictures[0].shape
    num_rows = -(-len(pictures) // num_columns)
    sheet = np.full((num_rows * height, min(num_columns, len(pictures)) * width, 3), 255, np.uint8)
    for number, picture in enumerate(pictures):
        row, column = divmod(number, num_columns)
        sheet[row * height : (row + 1) * height, column * width : (column + 1) * width] = picture
    return sheet
