"""Sides that a keypoint detector has exchanged, on the synthetic recording; the judge alone is in test_system.py."""

from copy import copy

import numpy as np
import pytest

from datamodules.recording import SyntheticRecording
from ljn.body.skeleton import MIRROR
from ljn.pipeline.keypoints import Keypoints
from ljn.system.system import ArSystem

NUM = 8


@pytest.fixture(scope="module")
def predict(shipped):
    """Run the system with a keypoint detector that takes left for right in some frames, and knows the truth else.

    Returns errors, metres, and flips of all frames but of those that are lost.
    """
    recording = SyntheticRecording(clip_frames=NUM)
    frames, truths = list(recording.frames()), [recording.truth(number) for number in range(NUM)]

    class Finder:
        sees, keypoints = "depth", None

        def __call__(self, depth, camera, rgb):
            return Keypoints(self.keypoints, np.ones(24, np.float32))

    def run(exchanged, lost, mends):
        pipeline = copy(shipped)
        pipeline.finder = Finder()
        system = ArSystem(
            pipeline, recording.camera, lambda frame, _: truths[frame.number].mask, mends_flips=mends
        )
        errors, flips = {}, {}
        for number, (frame, truth) in enumerate(zip(frames, truths)):
            if number in lost:
                system(frame._replace(depth=None, error="lost"))
                continue
            order = list(MIRROR) if number in exchanged else slice(None)
            pipeline.finder.keypoints = truth.keypoints[order]
            result = system(frame)
            errors[number] = np.linalg.norm(result.prediction.joints - truth.joints, axis=-1).mean()
            flips[number] = result.flip
        return errors, flips

    return run


@pytest.fixture(scope="module")
def right(predict):
    """Errors and flips where nothing is exchanged."""
    return predict([], [], True)


def test_where_nothing_is_exchanged_nothing_is_mended(predict, right):
    errors, flips = right
    assert set(flips.values()) == {""}
    assert predict([], [], False)[0] == errors


@pytest.mark.parametrize(
    ("exchanged", "lost"),
    [([3], []), ([2, 3, 4], []), ([0, 1, 2], []), ([5, 6], [2, 3, 4]), (list(range(1, NUM)), [])],
)
def test_exchanged_keypoints_are_found_and_mended(predict, right, exchanged, lost):
    wrong = {number for number, error in predict(exchanged, lost, False)[0].items() if error > 0.1}
    assert wrong >= set(exchanged) - {0}  # of the first frame the detector may find the way back by itself
    errors, flips = predict(exchanged, lost, True)
    assert {number for number, flip in flips.items() if flip == "corrected"} == wrong
    for number, error in errors.items():
        # A mended frame begins with exchanged joints, which are less exact than keypoints.
        assert error < right[0][number] + (0.03 if number in wrong else 0.005)
