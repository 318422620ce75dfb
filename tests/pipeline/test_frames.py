from itertools import count, islice

import numpy as np
import pytest

from ljn.pipeline.frames import FrameImages, find_frames, predict_frames


def test_frames_of_a_camera_are_taken_as_they_come_and_one_that_fails_harms_no_other(pipeline, kinect, given):
    depth, keypoints = given
    taken = []

    def camera():
        for number in count():
            taken.append(number)
            yield number

    def read(number):
        if number == 1:
            raise ValueError("the cable is loose")
        return FrameImages(np.zeros_like(depth) if number == 2 else depth, keypoints, depth > 0)

    results = list(islice(predict_frames(pipeline, camera(), kinect, read, batch_size=3), 5))
    assert taken == [0, 1, 2, 3, 4, 5]
    assert [result.frame for result in results] == [0, 1, 2, 3, 4]
    assert [str(result.error).split(":")[0] for result in results[1:3]] == ["the cable is loose", "depth"]
    expected = pipeline(depth, kinect, keypoints)
    for result in (results[0], *results[3:]):
        assert result.error is None
        np.testing.assert_array_equal(result.depth, depth)
        np.testing.assert_allclose(result.prediction.joints, expected.joints, atol=1e-5)
    assert results[1].prediction is None
    assert list(predict_frames(pipeline, [], kinect, read)) == []


def test_a_batch_without_a_good_frame_gives_its_errors(pipeline, kinect):
    def read(frame):
        raise FileNotFoundError(frame)

    results = list(predict_frames(pipeline, "abc", kinect, read, batch_size=2))
    assert [str(result.error) for result in results] == ["a", "b", "c"]


@pytest.mark.parametrize(
    ("depth", "keypoints", "expected"),
    [
        (["a", "b"], ["a.json", "b.json"], ["a.json", "b.json"]),
        (["a", "b"], ["a_keypoints.json", "b_keypoints.json"], ["a_keypoints.json", "b_keypoints.json"]),
        (["a", "b"], ["a.json", "a_keypoints.json"], ["a.json", "b.json"]),
        (["a"], ["a_000000000012_keypoints.json"], ["a_000000000012_keypoints.json"]),
        (
            ["f_011", "f_012"],
            ["v_000000000012_keypoints.json", "v_000000000011_keypoints.json"],
            ["v_000000000011_keypoints.json", "v_000000000012_keypoints.json"],
        ),
        # From 0 or from 1, and two videos: which belongs to which is not known.
        (["f_1", "f_2"], ["v_000000000000_keypoints.json", "v_000000000001_keypoints.json"], ["f_1.json", "f_2.json"]),
        (["f_1"], ["v_000000000001_keypoints.json", "w_000000000001_keypoints.json"], ["f_1.json"]),
    ],
)  # fmt: skip
def test_keypoints_of_a_folder_are_found_by_the_names_that_openpose_gives(
    depth, keypoints, expected, tmp_path
):
    for folder, names in (("depth", [f"{name}.npy" for name in depth]), ("keypoints", keypoints)):
        (tmp_path / folder).mkdir()
        for name in names:
            (tmp_path / folder / name).touch()
    frames = find_frames(tmp_path / "depth", tmp_path / "keypoints")
    assert [frame.keypoints.name for frame in frames] == expected
