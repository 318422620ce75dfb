from dataclasses import replace

import numpy as np
import pytest
import torch

from datamodules.bench import BenchSamples
from datamodules.sensor import AxialNoise, Clothing, Sensor
from ljn.benchmark.conditions import AXES as ALL_AXES
from ljn.benchmark.conditions import BASE, REFERENCE_FOCAL_PX, steps_of
from ljn.geometry.camera import project

NUM = 8
DEPTH_HASH = "bad9a4ce82fb54c6b0d99111c6697199ae740e0ac9c5d529126ecbdadefc130b"
AXES = {axis.name: axis for axis in ALL_AXES}


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    return BenchSamples(tmp_path_factory.mktemp("bench"), num_samples=NUM)


def changed(name, value):
    return AXES[name].change(BASE, value)


@pytest.mark.parametrize("num_threads", [1, 2])
def test_the_depth_images_are_the_same_in_any_number_of_threads(num_threads, tmp_path):
    before = torch.get_num_threads()
    torch.set_num_threads(num_threads)
    try:
        assert BenchSamples(tmp_path, num_samples=NUM).depth_hash == DEPTH_HASH
    finally:
        torch.set_num_threads(before)


@pytest.mark.slow
def test_all_depth_images_are_those_of_the_version(tmp_path):
    expected = "5d09836adffcb043fc84b9e877ab4a5af705c08c365d1a1bcfdbb518a77cdcab"
    assert BenchSamples(tmp_path).depth_hash == expected


def test_what_is_kept_is_what_was_made(samples):
    again = BenchSamples(samples.cache_dir, num_samples=NUM)
    assert again.depth_hash == samples.depth_hash
    for index in range(NUM):
        assert (again.clean_depth(index) == samples.clean_depth(index)).all()


def test_a_frame_depends_on_its_sample_and_condition_alone(samples):
    for condition in (BASE, changed("occlusion", 20), changed("missing", 50), changed("joint_noise", 10)):
        together, alone = samples.frames(range(NUM), condition), samples.frames([5], condition)
        for first, second in zip(together[5], alone[0]):
            if isinstance(first, np.ndarray):
                np.testing.assert_array_equal(first, second)
            else:
                assert first == second


def test_the_first_samples_are_those_of_a_longer_set(samples):
    some = samples.first(3)
    assert len(some) == 3
    for first, second in zip(some.frames(range(3), BASE), samples.frames(range(3), BASE)):
        np.testing.assert_array_equal(first.depth, second.depth)
    with pytest.raises(ValueError, match=r"num_samples: .* has 2000 samples, got 2001"):
        _ = samples.first(2001).definition
    with pytest.raises(ValueError, match="num_samples: expected a whole number of 1 or more"):
        samples.first(0)


def test_the_clean_depth_shows_the_mesh_and_the_noise_is_of_one_millimetre(samples):
    [truth] = zip(*samples.truth([2]))
    depth, frame = samples.clean_depth(2), samples.frames([2], BASE)[0]
    seen = depth > 0
    assert truth[1][:, 2].min() - 2e-5 <= depth[seen].min()
    assert depth[seen].max() <= truth[1][:, 2].max() + 2e-5
    noise = (frame.depth - depth)[seen]
    assert (frame.depth[~seen] == 0).all()
    assert 0.0009 < noise.std() < 0.0011


def test_keypoints_without_noise_are_the_joints_projections(samples):
    frames = samples.frames(range(NUM), changed("keypoint_noise", 0))
    for joints, frame in zip(samples.truth(range(NUM)).joints, frames):
        expected = project(torch.from_numpy(joints), frame.camera.intrinsics()).numpy()
        np.testing.assert_allclose(frame.keypoints[:, :2], expected, atol=1e-3)
        assert (frame.keypoints[:, 2] == 1).all()


def test_the_draws_of_a_sample_stay_as_a_condition_grows(samples):
    clean, some, more = (samples.frames([1], changed("keypoint_noise", px))[0].keypoints for px in (0, 5, 10))
    inside = (more[:, :2] > 0).all(1) & (more[:, 0] < samples.camera(1).width - 1)
    np.testing.assert_allclose(2 * (some - clean)[inside], (more - clean)[inside], atol=1e-3)
    true = samples.truth([1]).joints[0]
    ten, twenty = (samples.frames([1], changed("joint_noise", mm))[0].joints for mm in (10, 20))
    np.testing.assert_allclose(2 * (ten - true), twenty - true, atol=1e-5)
    missing = [np.isnan(samples.frames([1], changed("missing", p))[0].keypoints[:, 0]) for p in (25, 50, 75)]
    assert [each.sum() for each in missing] == [6, 12, 18]
    assert (missing[0] <= missing[1]).all()
    assert (missing[1] <= missing[2]).all()


def test_the_noise_of_keypoints_is_in_units_of_the_reference_focal_length(samples):
    sizes = []
    for index in range(NUM):
        clean, noisy = (
            samples.frames([index], changed("keypoint_noise", px))[0].keypoints[:, :2] for px in (0, 5)
        )
        camera = samples.camera(index)
        inside = (noisy > 0).all(1) & (noisy < [camera.width - 1, camera.height - 1]).all(1)
        sizes.append((noisy - clean)[inside].std() / camera.fx * REFERENCE_FOCAL_PX)
    assert 4 < np.mean(sizes) < 6


def test_without_any_keypoint_none_is_given(samples):
    assert changed("missing", 100) == BASE.without_keypoints
    assert all(frame.keypoints is None for frame in samples.frames(range(NUM), BASE.without_keypoints))


@pytest.mark.parametrize("percent", [10, 40])
def test_a_box_hides_its_share_of_the_body(percent, samples):
    for index in range(NUM):
        [plain], [hidden] = (samples.frames([index], c) for c in (BASE, changed("occlusion", percent)))
        gone = (plain.depth > 0) & (hidden.depth == 0)
        assert gone.sum() == round(percent / 100 * (plain.depth > 0).sum())
        assert (plain.depth[~gone] == hidden.depth[~gone]).all()
        v, u = np.nonzero(gone)
        inside = plain.depth[v.min() + 1 : v.max(), u.min() + 1 : u.max()] > 0
        assert gone[v.min() + 1 : v.max(), u.min() + 1 : u.max()][inside].mean() > 0.97


def test_groups_and_visibility_tell_the_samples_apart(samples):
    groups = samples.groups()
    assert {name.split(",")[0] for name in groups} == {
        "distance",
        "heading",
        "height of the body",
        "pose",
    }
    assert all(names.shape == (NUM,) for names in groups.values())
    visible = samples.visible()
    assert visible.shape == (NUM, 24)
    assert 0.4 < visible.mean() < 1
    assert ((samples.facing() >= 0) & (samples.facing() <= 180)).all()


def test_an_identity_says_what_differs(samples):
    steps = [step for axis in ALL_AXES for step in steps_of(axis)]
    assert len({str(samples.identity(step.condition)) for step in steps}) == len(
        {step.condition for step in steps}
    )
    assert samples.identity(BASE) != samples.first(4).identity(BASE)


def test_a_sensor_that_there_is_not_is_refused(samples):
    with pytest.raises(ValueError, match="sensor: expected one of"):
        samples.frames([0], replace(BASE, sensor="lidar"))


def test_a_sensor_dresses_and_exposes_the_same_body_each_time(samples):
    sensors = {
        "dressed": Sensor({"clothing": Clothing()}),
        "noisy": {"sensor": Sensor({"axial": AxialNoise()}), "synthesis": {"pixel_factors": [0.3, 1]}},
    }
    seen = BenchSamples(samples.cache_dir, num_samples=NUM, sensors=sensors)
    assert seen.sensors == ("dressed", "noisy")
    assert seen.first(3).sensors == seen.sensors
    conditions = [replace(BASE, sensor=name) for name in seen.sensors]
    identities = [str(seen.identity(condition)) for condition in (BASE, *conditions)]
    assert len(set(identities)) == 3
    assert str(samples.identity(BASE)) == identities[0]
    for condition in conditions:
        [frame], again = seen.frames([5], condition), seen.frames(range(NUM), condition)[5]
        np.testing.assert_array_equal(frame.depth, again.depth)
    clean, (dressed, noisy) = samples.clean_depth(5), (seen.frames([5], each)[0].depth for each in conditions)
    assert (dressed > 0).sum() > (clean > 0).sum()
    assert ((noisy > 0) == (clean > 0)).all()
    assert 0.0005 < np.std((noisy - clean)[clean > 0]) < 0.02
