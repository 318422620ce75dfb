import numpy as np
import pytest

from ljn.benchmark.conditions import BASE
from ljn.benchmark.predictors import LiftedKeypoints, PipelinePredictor, entrant
from ljn.cloud.lifting import lift_keypoints


class Answers:
    """Gives what it was built with."""

    def __init__(self, answer):
        self.answer = answer

    def __call__(self, frames):
        return self.answer(frames)


def entered(answer):
    return entrant(Answers(answer), "mine", {"_target_": "tests.Answers"})


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda frames: 1 / 0, "ZeroDivisionError: division by zero"),
        (lambda frames: np.zeros((len(frames), 17, 3)), r"joints: expected an array of \(1, 24, 3\).*got \(1, 17, 3\)"),
        (lambda frames: np.full((len(frames), 24, 3), np.nan), "joints: 72 values are NaN or infinite"),
        (lambda frames: None, "joints: (expected an array|1 values are NaN)"),
        (lambda frames: (np.zeros((len(frames), 24, 3)), np.zeros((2, 3))), r"vertices: expected an array of \(1, V"),
        (lambda frames: {"joints": 0}, "joints: expected an array of numbers, got dict"),
    ],
)  # fmt: skip
def test_what_a_predictor_gets_wrong_is_named_with_its_sample(answer, message, samples):
    with pytest.raises(ValueError, match=rf"predictor 'mine', sample 3: {message}"):
        entered(answer)(samples.frames([3, 4], BASE), [3, 4])


def test_the_sample_at_fault_is_found(samples):
    def answer(frames):
        joints = np.zeros((len(frames), 24, 3))
        joints[[frame.camera == samples.camera(5) for frame in frames]] = np.inf
        return joints

    with pytest.raises(ValueError, match="predictor 'mine', sample 5: joints: 72 values are NaN"):
        entered(answer)(samples.frames(range(8), BASE), range(8))


def test_a_batch_that_fails_only_as_a_batch_is_named(samples):
    def answer(frames):
        if len(frames) > 1:
            raise RuntimeError("too many")
        return np.zeros((1, 24, 3))

    with pytest.raises(
        ValueError, match=r"samples 0 to 1, as a batch though not one by one: RuntimeError: too many"
    ):
        entered(answer)(samples.frames(range(2), BASE), range(2))


def test_a_predictor_that_says_nothing_of_itself_reads_depth_alone():
    made = entered(lambda frames: None)
    assert made.name == "mine"
    assert made.reads == frozenset()
    assert made.skips("", has_keypoints=True) == "not read"
    assert made.skips("", has_keypoints=False) == ""
    assert made.skips("points", has_keypoints=False) == "not read"
    other = entrant(Answers(None), "mine", {"_target_": "tests.Answers", "size": 3})
    assert other.fingerprint != made.fingerprint


def test_what_is_no_predictor_is_refused():
    with pytest.raises(
        ValueError, match=r"predictors\.x: expected an object that is called with frames, got a int"
    ):
        entrant(3, "x", {})
    answers = Answers(None)
    answers.reads = ("colours",)
    with pytest.raises(
        ValueError, match=r"predictors\.x: reads: expected some of keypoints, .*, got colours"
    ):
        entrant(answers, "x", {})


def test_lifted_keypoints_lie_where_the_depth_is(samples):
    [frame] = samples.frames([0], BASE)
    expected = lift_keypoints(frame.keypoints[:, :2], frame.depth, frame.camera)
    np.testing.assert_array_equal(LiftedKeypoints()([frame])[0], expected)


def test_the_pipeline_takes_a_batch_of_frames_with_keypoints_and_without(samples):
    predictor = PipelinePredictor(weights="small")
    assert predictor.name == "small"
    assert predictor.reads == {"keypoints", "joints"}
    given, none = samples.frames([0, 1], BASE), samples.frames([0, 1], BASE.without_keypoints)
    joints, vertices = predictor([given[0], none[1]])
    assert vertices.shape == (2, 6890, 3)
    for row, frame in enumerate((given[0], none[1])):
        alone_joints, alone_vertices = predictor([frame])
        np.testing.assert_allclose(joints[row], alone_joints[0], atol=1e-4)
        np.testing.assert_allclose(vertices[row], alone_vertices[0], atol=1e-4)


def test_a_pipeline_is_given_by_weights_or_by_a_checkpoint():
    with pytest.raises(ValueError, match="weights, ckpt_path: expected one of them, got None and None"):
        PipelinePredictor()
