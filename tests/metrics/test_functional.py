import math

import numpy as np
import pytest
import torch

from ljn.body.skeleton import HEAD_BONE, MIRROR, NUM_JOINTS, ROOT
from ljn.metrics import functional

NAMES = ("mpjpe", "mpjpe_eq38", "mpjpe_root_aligned", "mpjpe_procrustes", "pckh")
JOINT_METRICS = [getattr(functional, name) for name in NAMES]
NUM_SAMPLES = 6


def joints_pair(seed=0):
    """True joints of a body's size, and predictions whose errors lie on both sides of PCKh's threshold."""
    generator = torch.Generator().manual_seed(seed)
    target = 0.4 * torch.randn(NUM_SAMPLES, NUM_JOINTS, 3, generator=generator) + torch.tensor([0.0, 0, 2])
    neck, head = HEAD_BONE
    target[:, head] = target[:, neck] + torch.tensor([0.02, -0.09, 0.03])
    return target + 0.03 * torch.randn(target.shape, generator=generator), target


def test_a_body_with_its_sides_exchanged_is_one_and_a_noisy_one_is_not():
    pred, target = joints_pair()
    wrong = pred.clone()
    wrong[:2] = pred[:2][:, list(MIRROR)]
    wrong[2, 0] = torch.nan
    expected = torch.tensor([100.0, 100, torch.nan, 0, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(functional.exchanged(wrong, target), expected, equal_nan=True)


def distance(a, b):
    return math.sqrt(sum((float(p) - float(q)) ** 2 for p, q in zip(a, b)))


def loop(pred, target, per_joint, divisor=NUM_JOINTS, skip=()):
    """Mean over joints by a plain double loop over samples and joints."""
    result = np.zeros(len(target))
    for sample in range(len(target)):
        for joint in range(NUM_JOINTS):
            if joint not in skip:
                result[sample] += per_joint(pred[sample], target[sample], joint) / divisor
    return result


def error_mm(pred, target, joint):
    return 1000 * distance(pred[joint], target[joint])


def test_mpjpe_agrees_with_a_loop():
    pred, target = joints_pair()
    expected = loop(pred.numpy(), target.numpy(), error_mm)
    np.testing.assert_allclose(functional.mpjpe(pred, target), expected, rtol=1e-12)


def test_mpjpe_eq38_skips_the_root_but_divides_by_all_joints():
    pred, target = joints_pair()
    expected = loop(pred.numpy(), target.numpy(), error_mm, skip=(ROOT,))
    np.testing.assert_allclose(functional.mpjpe_eq38(pred, target), expected, rtol=1e-12)


def test_mpjpe_root_aligned_agrees_with_a_loop():
    pred, target = joints_pair()

    def root_aligned_error(pred, target, joint):
        pred, target = pred.astype(np.float64), target.astype(np.float64)
        return 1000 * distance(pred[joint] - pred[ROOT], target[joint] - target[ROOT])

    expected = loop(pred.numpy(), target.numpy(), root_aligned_error)
    np.testing.assert_allclose(functional.mpjpe_root_aligned(pred, target), expected, rtol=1e-9)


def test_mpjpe_procrustes_agrees_with_a_loop():
    pred, target = joints_pair()

    def aligned(pred, target):
        x, y = pred - pred.mean(0), target - target.mean(0)
        u, singular, vh = np.linalg.svd(x.T @ y)
        signs = np.array([1, 1, np.sign(np.linalg.det(u @ vh))])
        scale = (singular * signs).sum() / (x**2).sum()
        return scale * x @ (u * signs @ vh) + target.mean(0)

    pairs = list(zip(pred.numpy().astype(np.float64), target.numpy().astype(np.float64)))
    expected = loop([aligned(p, t) for p, t in pairs], target.numpy(), error_mm)
    np.testing.assert_allclose(functional.mpjpe_procrustes(pred, target), expected, rtol=1e-9)


def test_pckh_agrees_with_a_loop():
    pred, target = joints_pair()

    def percentage(pred, target, joint):
        neck, head = HEAD_BONE
        return 100 * (error_mm(pred, target, joint) < 500 * distance(target[head], target[neck]))

    expected = loop(pred.numpy(), target.numpy(), percentage)
    assert 0 < expected.min() < expected.max() < 100
    np.testing.assert_allclose(functional.pckh(pred, target), expected, rtol=1e-12)


def test_pckh_threshold_is_half_the_true_head_bone():
    _, target = joints_pair()
    neck, head = HEAD_BONE
    expected = [500 * distance(sample[head], sample[neck]) for sample in target.numpy()]
    np.testing.assert_allclose(functional.pckh_threshold_mm(target), expected, rtol=1e-12)


def test_an_error_equal_to_the_threshold_is_not_correct():
    target = torch.zeros(NUM_JOINTS, 3)
    target[HEAD_BONE[1], 1] = 0.25
    pred = target.clone()
    pred[0, 0] = 0.125
    assert functional.pckh(pred, target) == pytest.approx(100 * (NUM_JOINTS - 1) / NUM_JOINTS)


def test_keypoint_distances_agree_with_a_loop():
    noisy, clean = (x[..., :2] for x in joints_pair())
    distances = functional.keypoint_distances_px(noisy, clean)
    for sample in range(NUM_SAMPLES):
        for joint in range(NUM_JOINTS):
            expected = distance(noisy[sample, joint], clean[sample, joint])
            assert distances[sample, joint] == pytest.approx(expected)


@pytest.mark.parametrize("metric", JOINT_METRICS)
def test_a_perfect_prediction_scores_perfectly(metric):
    _, target = joints_pair()
    perfect = 100.0 if metric is functional.pckh else 0.0
    np.testing.assert_allclose(metric(target, target), perfect, atol=1e-9)


@pytest.mark.parametrize("joint", [ROOT, HEAD_BONE[1]])
@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("metric", JOINT_METRICS)
def test_nan_in_a_sample_gives_nan_for_that_sample_only(metric, which, joint):
    pair = joints_pair()
    pair[which][2, joint, 1] = torch.nan
    assert metric(*pair).isnan().tolist() == [sample == 2 for sample in range(NUM_SAMPLES)]


@pytest.mark.parametrize("metric", JOINT_METRICS)
def test_an_infinite_prediction_is_never_perfect(metric):
    _, target = joints_pair()
    value = metric(torch.full_like(target, torch.inf), target)
    assert (value == 0).all() if metric is functional.pckh else not value.isfinite().any()


@pytest.mark.parametrize("metric", [*JOINT_METRICS, functional.joint_errors_mm])
@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_values_are_float64_whatever_comes_in(metric, dtype):
    pred, target = (x.to(dtype) for x in joints_pair())
    value = metric(pred, target)
    assert value.dtype == torch.float64
    torch.testing.assert_close(value, metric(pred.double(), target.double()), rtol=1e-12, atol=0)


@pytest.mark.parametrize("metric", JOINT_METRICS)
def test_leading_dimensions_are_samples(metric):
    pred, target = joints_pair()
    expected = metric(pred, target)
    reshaped = metric(pred.view(2, 3, NUM_JOINTS, 3), target.view(2, 3, NUM_JOINTS, 3))
    torch.testing.assert_close(reshaped, expected.view(2, 3), rtol=1e-12, atol=0)
    assert metric(pred[0], target[0]).shape == ()


@pytest.mark.parametrize("metric", [*JOINT_METRICS, functional.joint_errors_mm])
def test_shapes_that_would_broadcast_are_rejected(metric):
    pred, target = joints_pair()
    with pytest.raises(ValueError, match="same shape"):
        metric(pred, target[:1])


def test_joints_of_another_skeleton_have_no_head_bone():
    joints = torch.zeros(2, 17, 3)
    for measure in (lambda: functional.pckh(joints, joints), lambda: functional.pckh_threshold_mm(joints)):
        with pytest.raises(ValueError, match=r"\(\.\.\., 24, 3\), got \(2, 17, 3\)"):
            measure()


def test_keypoints_must_be_two_dimensional_and_match():
    with pytest.raises(ValueError, match="same shape"):
        functional.keypoint_distances_px(torch.zeros(2, 24, 3), torch.zeros(2, 24, 3))
    with pytest.raises(ValueError, match="same shape"):
        functional.keypoint_distances_px(torch.zeros(2, 24, 2), torch.zeros(24, 2))


def test_root_aligned_pckh_forgives_a_common_shift_and_nothing_else():
    generator = torch.Generator().manual_seed(3)
    target = torch.randn(5, 24, 3, generator=generator, dtype=torch.float64)
    pred = target + 0.5 * torch.randn(5, 24, 3, generator=generator, dtype=torch.float64)
    shifted = pred + torch.tensor([0.7, -3.0, 0.2], dtype=torch.float64)
    expected = functional.pckh(pred - pred[:, :1] + target[:, :1], target)
    torch.testing.assert_close(functional.pckh_root_aligned(shifted, target), expected)
    assert expected.min() < 100


def test_a_mesh_is_harmed_beyond_the_limit_alone():
    target = torch.zeros(3, 10, 3)
    raw, refined = target + 0.01, target + torch.tensor([0.012, 0.013, 0.005])[:, None, None]
    expected = [0.0, 100.0, 0.0]  # by 3.5, 5.2 and -8.7 mm
    assert functional.harmed(raw, refined, target).tolist() == expected
    assert functional.harmed(raw, refined, target, limit_mm=3).tolist() == [100.0, 100.0, 0.0]
