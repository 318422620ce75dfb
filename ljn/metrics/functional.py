"""Functional forms of the metrics: one value for each sample, in float64.

Joints come in metres and errors go out in millimetres, percentages in 0-100. NaN in gives NaN out for that
sample, in PCKh too, where a comparison with NaN would count as an ordinary miss.
"""

import torch
from torch import Tensor

from ljn.body.skeleton import HEAD_BONE, JOINT_NAMES, MIRROR, NUM_JOINTS, ROOT
from ljn.geometry.alignment import procrustes_align, root_align

MM_PER_METRE = 1000.0
_OKS_SIGMAS = {
    "pelvis": 0.107, "hip": 0.107, "spine1": 0.107, "spine2": 0.107, "spine3": 0.107, "neck": 0.079, "collar": 0.079,
    "shoulder": 0.079, "head": 0.079, "elbow": 0.072, "wrist": 0.062, "hand": 0.062, "knee": 0.087, "ankle": 0.089,
    "foot": 0.089,
}  # fmt: skip
"""COCO's constants; of the joints that COCO does not know, those of the nearest joint."""
_OKS_AREA = 0.53  # of a person, as a share of the box, as COCO's tools take it where there is no outline


def joint_errors_mm(pred: Tensor, target: Tensor) -> Tensor:
    """Return the distance of each predicted joint from the true one.

    Args:
        pred: `(..., K, 3)`, metres.
        target: `(..., K, 3)`, metres, the same frame.

    Returns:
        `(..., K)`, mm, float64.
    """
    return _distances(pred, target, size=3) * MM_PER_METRE


def mpjpe(pred: Tensor, target: Tensor) -> Tensor:
    """Return the mean error over all K joints, the root among them (Eq. 3.8 leaves it out: `mpjpe_eq38`).

    Args:
        pred: `(..., K, 3)`, metres.
        target: `(..., K, 3)`, metres, the same frame.

    Returns:
        `(...)`, mm, float64.
    """
    return joint_errors_mm(pred, target).mean(-1)


def mpjpe_eq38(pred: Tensor, target: Tensor) -> Tensor:
    """Return Eq. 3.8 to the letter: the sum over joints 2..K (all but the root), divided by K.

    Args:
        pred: `(..., K, 3)`, metres.
        target: `(..., K, 3)`, metres, the same frame.

    Returns:
        `(...)`, mm, float64.
    """
    errors = joint_errors_mm(pred, target)
    # A difference, not a slice: a root that is NaN must show.
    return (errors.sum(-1) - errors[..., ROOT]) / errors.shape[-1]


def mpjpe_root_aligned(pred: Tensor, target: Tensor) -> Tensor:
    """Return the mean error over all K joints after moving both roots to the origin (the root's error is 0).

    Args:
        pred: `(..., K, 3)`, metres.
        target: `(..., K, 3)`, metres, the same axes.

    Returns:
        `(...)`, mm, float64.
    """
    return mpjpe(root_align(pred.double(), ROOT), root_align(target.double(), ROOT))


def mpjpe_procrustes(pred: Tensor, target: Tensor) -> Tensor:
    """Return the mean error over all K joints after the best rotation, scale and translation of `pred`.

    Args:
        pred: `(..., K, 3)`, metres.
        target: `(..., K, 3)`, metres.

    Returns:
        `(...)`, mm, float64.
    """
    return mpjpe(procrustes_align(pred.double(), target), target)


def pckh_threshold_mm(target: Tensor) -> Tensor:
    """Return half the length of the true head bone, PCKh@0.5's threshold (section 3.7.1).

    Args:
        target: `(..., 24, 3)`, metres, any frame.

    Returns:
        `(...)`, mm, float64.
    """
    if target.shape[-2:] != (NUM_JOINTS, 3):
        raise ValueError(f"target must be SMPL joints (..., {NUM_JOINTS}, 3), got {tuple(target.shape)}")
    neck, head = HEAD_BONE
    return 0.5 * _distances(target[..., head, :], target[..., neck, :], size=3) * MM_PER_METRE


def pckh(pred: Tensor, target: Tensor) -> Tensor:
    """Return PCKh@0.5: the share of joints whose error is strictly less than half the true head bone.

    Args:
        pred: `(..., 24, 3)`, metres.
        target: `(..., 24, 3)`, metres, the same frame.

    Returns:
        `(...)`, %, float64.
    """
    errors = joint_errors_mm(pred, target)
    correct = (errors < pckh_threshold_mm(target)[..., None]).to(errors.dtype)
    return 100.0 * correct.where(~errors.isnan(), errors).mean(-1)


def pckh_root_aligned(pred: Tensor, target: Tensor) -> Tensor:
    """Return PCKh@0.5 after moving both roots to the origin (the root is always correct).

    Args:
        pred: `(..., 24, 3)`, metres.
        target: `(..., 24, 3)`, metres, the same axes.

    Returns:
        `(...)`, %, float64.
    """
    return pckh(root_align(pred.double(), ROOT), root_align(target.double(), ROOT))


def exchanged(pred: Tensor, target: Tensor) -> Tensor:
    """Return whether the prediction fits better with left and right exchanged: a body seen from the wrong side.

    Args:
        pred: `(..., 24, 3)`, metres.
        target: `(..., 24, 3)`, metres, the same frame.

    Returns:
        `(...)`, 100 or 0 (%), float64.
    """
    errors, others = mpjpe(pred, target), mpjpe(pred[..., list(MIRROR), :], target)
    return (100.0 * (others < errors)).to(errors.dtype).where(~errors.isnan(), errors)


def apve(pred: Tensor, target: Tensor) -> Tensor:
    """Return Eq. 3.9, the mean distance of the predicted vertices from the true ones (also called PVE).

    Args:
        pred: `(..., V, 3)`, metres.
        target: `(..., V, 3)`, metres, the same frame.

    Returns:
        `(...)`, mm, float64.
    """
    return joint_errors_mm(pred, target).mean(-1)


def apve_root_aligned(pred: Tensor, target: Tensor, pred_root: Tensor, target_root: Tensor) -> Tensor:
    """Return the mean error over all vertices after moving both root joints to the origin.

    Args:
        pred: `(..., V, 3)`, metres.
        target: `(..., V, 3)`, metres, the same axes.
        pred_root: `(..., 3)`, metres, of the predicted body.
        target_root: `(..., 3)`, metres, of the true one.

    Returns:
        `(...)`, mm, float64.
    """
    return apve(pred.double() - pred_root[..., None, :], target.double() - target_root[..., None, :])


def apve_procrustes(pred: Tensor, target: Tensor) -> Tensor:
    """Return the mean error over all vertices after the best rotation, scale and translation of `pred`.

    Args:
        pred: `(..., V, 3)`, metres.
        target: `(..., V, 3)`, metres.

    Returns:
        `(...)`, mm, float64.
    """
    return apve(procrustes_align(pred.double(), target), target)


def harmed(raw: Tensor, refined: Tensor, target: Tensor, limit_mm: float = 5.0) -> Tensor:
    """Return whether the refined mesh is worse than the raw one, by more than a limit of the mean vertex error.

    Args:
        raw: `(B, V, 3)`, metres, in the target's frame.
        refined: `(B, V, 3)`.
        target: `(B, V, 3)`.
        limit_mm: Millimetres.

    Returns:
        `(B,)` float64: 100 where it is, 0 elsewhere; the mean over samples is a percentage.
    """
    worse = apve(refined, target) > apve(raw, target) + limit_mm
    return 100 * worse.double()


def keypoint_distances_px(noisy: Tensor, clean: Tensor) -> Tensor:
    """Return how far each 2D keypoint lies from the true one.

    Args:
        noisy: `(..., K, 2)`, pixels, with noise or predicted.
        clean: `(..., K, 2)`, pixels.

    Returns:
        `(..., K)`, pixels, float64.
    """
    return _distances(noisy, clean, size=2)


def pckh_2d(pred: Tensor, target: Tensor, joints: Tensor, focal_px: Tensor) -> Tensor:
    """Return PCKh@0.5 in the image: half the true head bone, turned across the view at its depth, is the threshold.

    The head bone's own length in the image, which other data sets take, goes to zero where a person looks at the camera
    from below.

    Args:
        pred: `(B, 24, 2)`, pixels.
        target: `(B, 24, 2)`, pixels.
        joints: `(B, 24, 3)`, the true joints, metres, camera frame.
        focal_px: `(B,)`, pixels.

    Returns:
        `(B,)`, %, float64.
    """
    depth = joints[:, list(HEAD_BONE), 2].double().mean(-1)
    threshold = pckh_threshold_mm(joints) / MM_PER_METRE * focal_px / depth
    errors = keypoint_distances_px(pred, target)
    correct = (errors < threshold[:, None]).to(errors.dtype)
    return 100.0 * correct.where(~errors.isnan(), errors).mean(-1)


def object_keypoint_similarity(pred: Tensor, target: Tensor) -> Tensor:
    """Return COCO's OKS: the mean over the joints of exp(-d^2 / (2 A k^2)), A 0.53 of the true keypoints' box.

    Args:
        pred: `(..., 24, 2)`, pixels.
        target: `(..., 24, 2)`, pixels.

    Returns:
        `(...)`, 0 to 1, float64.
    """
    sigmas = [_OKS_SIGMAS[name.rpartition("_")[2]] for name in JOINT_NAMES]
    variances = (2 * torch.tensor(sigmas, dtype=torch.float64, device=target.device)).square()
    box = target.double().amax(-2) - target.double().amin(-2)
    area = _OKS_AREA * box.prod(-1)
    errors = keypoint_distances_px(pred, target)
    return torch.exp(-errors.square() / (2 * area[..., None] * variances)).mean(-1)


def scored_similarity(pred: Tensor, target: Tensor, confidences: Tensor) -> Tensor:
    """Return OKS and the score by which predictions are ranked, the mean confidence: `(B, 2)`, float64.

    Args:
        pred: `(B, 24, 2)`, pixels.
        target: `(B, 24, 2)`, pixels.
        confidences: `(B, 24)`.
    """
    return torch.stack([object_keypoint_similarity(pred, target), confidences.double().mean(-1)], -1)


def exchanged_2d(pred: Tensor, target: Tensor) -> Tensor:
    """Return whether keypoints fit better with left and right exchanged: a left-right flip.

    Args:
        pred: `(..., 24, 2)`, pixels.
        target: `(..., 24, 2)`, pixels.

    Returns:
        `(...)`, 100 or 0 (%), float64.
    """
    errors, others = (
        keypoint_distances_px(each, target).mean(-1) for each in (pred, pred[..., list(MIRROR), :])
    )
    return (100.0 * (others < errors)).to(errors.dtype).where(~errors.isnan(), errors)


def _distances(first: Tensor, second: Tensor, size: int) -> Tensor:
    # Broadcasting would turn a forgotten dimension into a plausible number.
    if first.shape != second.shape or first.shape[-1:] != (size,):
        raise ValueError(
            f"expected two tensors of the same shape (..., {size}), "
            f"got {tuple(first.shape)} and {tuple(second.shape)}"
        )
    return (first.double() - second.double()).norm(dim=-1)
