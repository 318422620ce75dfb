import math

import pytest
import torch

from ljn.body.skeleton import HEAD_BONE, JOINT_INDEX, MIRROR
from ljn.metrics import KeypointMetrics, SampleAP, exchanged_2d, object_keypoint_similarity, pckh_2d


def keypoints(size=6):
    return 200 * torch.rand(size, 24, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_oks_is_coco_s_formula():
    target = torch.zeros(24, 2, dtype=torch.float64)
    target[0], target[1] = torch.tensor([100.0, 0]), torch.tensor([0.0, 50])
    pred = target.clone()
    pred[JOINT_INDEX["l_knee"], 0] += 7
    area = 0.53 * 100 * 50
    expected = (23 + math.exp(-(7**2) / (2 * area * (2 * 0.087) ** 2))) / 24
    assert object_keypoint_similarity(pred, target).item() == pytest.approx(expected, abs=1e-12)
    assert object_keypoint_similarity(target, target) == 1


def test_pckh_counts_what_is_nearer_than_half_a_head_bone_at_its_depth():
    joints = torch.zeros(1, 24, 3)
    joints[..., 2] = 2.0
    joints[0, HEAD_BONE[1], 1] = 0.2  # 0.1 m at 2 m with 500 px: 25 px
    target, focal = keypoints(1), torch.tensor([500.0])
    pred = target + torch.tensor([24.9, 0])
    assert pckh_2d(pred, target, joints, focal) == 100
    pred[0, :6, 0] += 0.2
    assert pckh_2d(pred, target, joints, focal).item() == pytest.approx(75)
    pred[0, 0] = torch.nan
    assert pckh_2d(pred, target, joints, focal).isnan()


def test_a_flip_is_what_fits_better_with_left_and_right_exchanged():
    target = keypoints()
    pred = target + torch.randn(target.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    pred[::2] = pred[::2][:, list(MIRROR)]
    assert exchanged_2d(pred, target).tolist() == [100, 0] * 3


def average_precision(similarities, scores):
    """COCOeval's loop over thresholds and recalls."""
    order = sorted(range(len(scores)), key=lambda i: -scores[i])
    precisions = []
    for threshold in [0.5 + 0.05 * i for i in range(10)]:
        hits, recall, precision = 0, [], []
        for place, i in enumerate(order, start=1):
            hits += similarities[i] >= threshold - 1e-9
            recall.append(hits / len(scores))
            precision.append(hits / place)
        for i in range(len(precision) - 1, 0, -1):
            precision[i - 1] = max(precision[i - 1], precision[i])
        for wanted in range(101):
            reached = [p for r, p in zip(recall, precision) if r >= wanted / 100 - 1e-12]
            precisions.append(reached[0] if reached else 0.0)
    return 100 * sum(precisions) / len(precisions)


def test_average_precision_is_coco_s_whatever_the_batches():
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(57, 2, generator=generator, dtype=torch.float64)
    expected = average_precision(*(column.tolist() for column in values.T))
    for size in (1, 10, 57):
        metric = SampleAP("%")
        for part in values.split(size):
            metric.update(part)
        assert metric.compute().item() == pytest.approx(expected)
    assert SampleAP("%").compute().isnan()
    perfect = SampleAP("%")
    perfect.update(torch.ones(3, 2, dtype=torch.float64))
    assert perfect.compute() == 100
    assert perfect.each(torch.tensor([[0.72, 0.1]], dtype=torch.float64)).tolist() == [50]


def test_every_metric_is_gathered():
    metrics, target = KeypointMetrics("val/"), keypoints()
    joints = torch.rand(6, 24, 3) + 1
    samples = metrics.update(
        pred_keypoints=target + 3, keypoints=target, pred_in_crop=target + 1, in_crop=target,
        confidences=torch.ones(6, 24), joints=joints, focal_px=torch.full((6,), 365.0),
    )  # fmt: skip
    assert samples.keys() == KeypointMetrics.table.keys()
    values = metrics.compute()
    assert values["val/keypoint_error_px"].item() == pytest.approx(3 * 2**0.5)
    assert values["val/crop_error_px"].item() == pytest.approx(2**0.5)
    assert values["val/exchanged"] == 0
