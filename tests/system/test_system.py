from dataclasses import replace

import numpy as np
import pytest
import torch

from ljn.body.skeleton import MIRROR
from ljn.demo import FRAMES
from ljn.pipeline.pipeline import Pipeline
from ljn.pipeline.prediction import Prediction
from ljn.pipeline.samples import find_samples
from ljn.system.depth_only import DepthOnly, background_plate
from ljn.system.flips import FlipJudge
from ljn.system.overlay import draw_overlay
from ljn.system.recording import RgbdFrame
from ljn.system.smoothing import SmoothingSettings
from ljn.system.system import ArSystem
from tests.system.test_segmentation import CAMERA, room


@pytest.fixture(scope="module")
def frame():
    """A person, `(depth, camera)`."""
    sample = find_samples(FRAMES)[0]
    depth = sample.frames[0].read().depth
    return (depth / 1000).astype(np.float32), sample.camera


def sequence(depth, number, fps=30):
    rng = np.random.default_rng(0)
    for i in range(number):
        noisy = np.where(depth > 0, depth + 0.004 * rng.standard_normal(depth.shape), 0).astype(np.float32)
        yield RgbdFrame(i, f"{i:06d}", noisy, timestamp_s=i / fps)


def test_a_frame_that_fails_is_marked_and_the_others_go_on(shipped, frame):
    depth, camera = frame
    system = ArSystem(shipped, camera)
    frames = list(sequence(depth, 3))
    frames[1] = RgbdFrame(1, "000001", None, error="the file is cut off")
    results = [system(each) for each in frames]
    assert [result.error for result in results] == [None, "the file is cut off", None]
    assert results[1].prediction is None
    expected = shipped(frames[2].depth, camera)
    np.testing.assert_array_equal(results[2].prediction.vertices, expected.vertices)
    np.testing.assert_array_equal(results[2].mask, frames[2].depth > 0)
    assert set(results[0].seconds) == {"2D joints", "flips", "joints and mesh", "segmentation", "smoothing"}
    for result in results:
        assert draw_overlay(result, camera).shape == (camera.height, camera.width, 3)


def test_the_segmenter_s_mask_is_the_person(shipped, frame):
    depth, camera = frame
    scene = np.where(depth > 0, depth, 3.5).astype(np.float32)
    seen = RgbdFrame(0, "a", scene)
    found = ArSystem(shipped, camera, lambda frame, _: frame.depth < 3.4)(seen)
    np.testing.assert_allclose(found.prediction.joints, shipped(depth, camera).joints, atol=0.01)

    def nobody(frame, camera):
        raise ValueError("there is no person before the curtain")

    assert ArSystem(shipped, camera, nobody)(seen).error == "there is no person before the curtain"


def test_smoothing_takes_jitter_away_and_the_mesh_is_the_smoothed_parameters(shipped, frame):
    depth, camera = frame
    systems = [ArSystem(shipped, camera, smoothing=of) for of in (None, SmoothingSettings())]
    raw, smooth = ([system(each).prediction for each in sequence(depth, 12)] for system in systems)

    def jitter(predictions, name):
        values = np.stack([getattr(each, name) for each in predictions[4:]])
        return np.linalg.norm(np.diff(values, 2, axis=0), axis=-1).mean()

    assert jitter(smooth, "joints") < 0.5 * jitter(raw, "joints")
    assert jitter(smooth, "vertices") < 0.5 * jitter(raw, "vertices")
    last = smooth[-1]
    pose = torch.from_numpy(np.concatenate([last.global_orient, last.pose[3:]]))
    made = shipped.regressor.module.body(pose[None], torch.from_numpy(last.betas)[None])
    np.testing.assert_allclose(made.vertices[0].numpy() + last.transl, last.vertices, atol=1e-4)


def prediction(joints):
    return Prediction(joints.astype(np.float32), np.zeros((1, 6), np.float32))


def standing(seed=0):
    return np.random.default_rng(seed).normal([0, 0, 2], 0.3, (24, 3))


def test_exchanged_sides_are_mended_by_the_frame_before():
    judge, joints = FlipJudge(), standing()
    asked = []

    def again(begin):
        asked.append(begin)
        return prediction(begin)

    assert judge(prediction(joints), 0.0, again).flip == ""
    asked.clear()
    exchanged = joints[list(MIRROR)] + 0.01
    judged = judge(prediction(exchanged), 0.033, again)
    assert judged.flip == "corrected"
    np.testing.assert_allclose(judged.prediction.joints, joints + 0.01, atol=1e-6)
    assert len(asked) == 1
    # Nothing is asked where nothing is wrong.
    assert judge(prediction(joints + 0.02), 0.066, again).flip == ""
    assert len(asked) == 1
    # What stays as it is when begun the other way round is left, and said.
    assert judge(prediction(exchanged), 0.1, lambda _: prediction(exchanged)).flip == "unclear"


def test_the_frames_before_may_have_been_wrong_and_a_gap_begins_anew():
    judge, joints = FlipJudge(), standing()
    judge(prediction(joints), 0.0, prediction)
    exchanged = joints[list(MIRROR)]
    flips = [judge(prediction(exchanged), 0.033 * (i + 1), prediction).flip for i in range(8)]
    assert flips == ["corrected"] * 5 + ["unclear"] + [""] * 2
    judge = FlipJudge()
    judge(prediction(joints), 0.0, prediction)
    assert judge(prediction(exchanged), 2.0, prediction).flip == ""


def test_sides_of_the_first_frame_are_judged_by_the_depth(shipped, frame):
    depth, camera = frame
    right = shipped(depth, camera)
    wrong = replace(right, joints=right.joints[list(MIRROR)], vertices=right.vertices + 0.1)
    judged = FlipJudge()(wrong, 0.0, lambda _: right)
    assert judged.flip == "corrected"
    assert judged.prediction is right
    assert FlipJudge()(right, 0.0, lambda _: wrong).prediction is right


def test_sides_that_were_wrong_for_long_are_found_by_the_depth(shipped, frame):
    depth, camera = frame
    right = shipped(depth, camera)
    wrong = replace(right, joints=right.joints[list(MIRROR)], vertices=right.vertices + 0.1)
    judge = FlipJudge(joints=wrong.joints, seconds=0.0, compared_s=0.0)
    flips = [judge(wrong, 0.2 * i, lambda _: right).flip for i in range(1, 6)]
    assert flips == ["", "", "corrected", "corrected", "corrected"]
    judge = FlipJudge(joints=right.joints, seconds=0.0, compared_s=0.0)
    assert [judge(right, 0.2 * i, lambda _: wrong).flip for i in range(1, 6)] == [""] * 5


def test_a_pipeline_without_a_mesh_has_joints_alone(shipped, frame):
    depth, camera = frame
    system = ArSystem(Pipeline(shipped.detector), camera, smoothing=SmoothingSettings())
    result = [system(each) for each in sequence(depth, 2)][-1]
    assert result.error is None
    assert result.prediction.vertices is None


def test_a_state_holds_where_the_person_was(shipped):
    plate = background_plate(room(seed, people=())[0] for seed in range(5))
    alone, crowd = room(9)[0], room(10, people=(-0.3, 0.9))[0]._replace(number=1, timestamp_s=0.03)
    whole = ArSystem(shipped, CAMERA, DepthOnly(plate))
    whole(alone)
    state = whole.state
    expected = whole(crowd)
    assert expected.error is None
    resumed = ArSystem(shipped, CAMERA, DepthOnly(plate))
    resumed.state = state
    np.testing.assert_array_equal(resumed(crowd).mask, expected.mask)
    # One that has forgotten the seed has no state that brings it back.
    seeded = ArSystem(shipped, CAMERA, DepthOnly(plate, seed=(1.0, 0.0, 2.0)))
    seeded.state = ArSystem(shipped, CAMERA, DepthOnly(plate)).state
    assert "several persons" in seeded(crowd).error


def test_a_frame_without_a_time_comes_after_the_one_before(shipped, frame):
    depth, camera = frame
    seen = []

    def segmenter(frame, camera):
        seen.append(frame.timestamp_s)
        return frame.depth > 0

    system = ArSystem(shipped, camera, segmenter, fps=10)
    for number, seconds in enumerate([None, 7.0, None, None, 7.4]):
        system(RgbdFrame(number, "a", depth, timestamp_s=seconds))
        if number == 2:  # as if it went on in another process
            state, system = system.state, ArSystem(shipped, camera, segmenter, fps=10)
            system.state = state
    np.testing.assert_allclose(seen, [0, 7.0, 7.1, 7.2, 7.4])
