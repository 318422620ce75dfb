import numpy as np
import pytest

from ljn.system.readers import open_recording
from ljn.system.readers.live import Replay
from tests.system.readers.conftest import DEPTH_CAMERA


class Clock:
    def __init__(self):
        self.now, self.slept = 1000.0, []

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.slept.append(seconds)
        self.now += seconds


def test_a_replay_keeps_the_recording_s_time(walk, frames):
    clock = Clock()
    replay = Replay(open_recording(walk), clock, clock.sleep)
    found = []
    for frame in replay.frames():
        found.append((frame.number, round(clock.now - 1000, 3)))
        np.testing.assert_array_equal(frame.rgb, frames[1][frame.number])
        clock.now += 0.02
    assert found == [(i, i / 10) for i in range(6)]
    np.testing.assert_allclose(clock.slept, 0.08, atol=1e-6)
    assert replay.facts["late_frames"] == 0
    assert replay.facts["ended"] == "the recording is over"


def test_a_replay_leaves_out_what_comes_too_late(walk):
    clock = Clock()
    replay = Replay(open_recording(walk), clock, clock.sleep)
    found = []
    for frame in replay.frames():
        found.append(frame.number)
        clock.now += 0.23  # so long takes who works on it
    assert found == [0, 2, 4, 5]
    assert replay.facts["late_frames"] == 2
    assert [frame.number for frame in Replay(open_recording(walk), clock, clock.sleep).frames(3)] == [3, 4, 5]


def test_a_replay_is_opened_like_a_sensor(walk):
    recording = open_recording(f"live:replay:{walk}")
    assert recording.num_frames is None
    assert recording.fps == 10
    assert recording.camera == DEPTH_CAMERA
    with pytest.raises(FileNotFoundError, match="no folder"):
        open_recording("live:replay:nowhere")
