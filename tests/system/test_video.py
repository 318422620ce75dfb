import av
import numpy as np
import pytest

from ljn.system.video import write_video


def pictures(number, size=(50, 64)):
    for i in range(number):
        picture = np.zeros((*size, 3), np.uint8)
        picture[:, : 4 * i + 4] = [200, 60, 20]
        yield picture


def test_a_video_has_every_picture_in_order_and_its_colours(tmp_path):
    path = tmp_path / "a.mp4"
    assert write_video(path, pictures(10, (51, 65)), 12.5) == 10
    with av.open(str(path)) as video:
        stream = video.streams.video[0]
        assert (stream.width, stream.height, float(stream.average_rate)) == (64, 50, 12.5)
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(stream)]
    assert len(frames) == 10
    for read, made in zip(frames, pictures(10)):
        assert np.abs(read.astype(int) - made).mean() < 6


def test_nothing_half_is_left(tmp_path):
    def failing():
        yield from pictures(3)
        raise OSError("the disk is full")

    with pytest.raises(OSError, match="full"):
        write_video(tmp_path / "a.mp4", failing(), 30)
    assert write_video(tmp_path / "a.mp4", [], 30) == 0
    assert not list(tmp_path.iterdir())
    mixed = [*pictures(1), *pictures(1, (40, 40))]
    with pytest.raises(
        ValueError, match=r"expected 64 x 50 \(width x height\), as the first, got 40 x 40 as number 1"
    ):
        write_video(tmp_path / "a.mp4", mixed, 30)
