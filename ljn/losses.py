"""Training losses."""

from collections.abc import Sequence

from torch import Tensor

LOSSES = ("squared", "distance")
"""`squared` distances, Eq. 3.6 and 3.7, or the `distance` itself, which far-off joints and vertices govern less."""
_SMALL = 1e-8  # m^2, so that the distance has a gradient at 0


def check_loss(loss: str) -> str:
    """`loss`, if it is one of `LOSSES`; else a `ValueError`."""
    if loss not in LOSSES:
        raise ValueError(f"loss: expected one of {', '.join(LOSSES)}, got '{loss}'")
    return loss


def joint_loss(pred: Tensor, target: Tensor, loss: str = "squared") -> Tensor:
    """Return Eq. 3.6, the squared distances summed over a sample's joints, averaged over the batch; or the distances'.

    The average, and the sum over steps, are ours: the thesis writes the loss of one sample and one step.

    Args:
        pred: `(T, B, K, 3)`, metres: the joints after each of T steps.
        target: `(B, K, 3)`, metres, the same frame.
        loss: One of `LOSSES`.

    Returns:
        Scalar, square metres or metres.
    """
    if pred.ndim != 4 or pred.shape[1:] != target.shape:
        raise ValueError(
            f"expected pred (T, B, K, 3) and target (B, K, 3), got {tuple(pred.shape)} and {tuple(target.shape)}"
        )
    if loss == "squared":
        return (pred - target).square().sum((-2, -1)).mean(-1).sum()
    return _distances(pred - target).sum(-1).mean(-1).sum()


def _distances(offset: Tensor) -> Tensor:
    return (offset.square().sum(-1) + _SMALL).sqrt()


def mesh_loss(pred: Tensor, target: Tensor, loss: str = "squared") -> Tensor:
    """Return Eq. 3.7, the mean squared distance of the vertices, summed over iterations, averaged over the batch; or
    the mean distance.

    The average over the batch is ours: the thesis writes the loss of one sample.

    Args:
        pred: `(T, B, V, 3)`, metres, body frame: the mesh after each of T iterations.
        target: `(B, V, 3)`, metres, body frame.
        loss: One of `LOSSES`.

    Returns:
        Scalar, square metres or metres.
    """
    if pred.ndim != 4 or pred.shape[1:] != target.shape:
        raise ValueError(
            f"expected pred (T, B, V, 3) and target (B, V, 3), got {tuple(pred.shape)} and {tuple(target.shape)}"
        )
    offset = pred - target
    distances = offset.square().sum(-1) if loss == "squared" else _distances(offset)
    return distances.mean((1, 2)).sum()


def heatmap_loss(
    heatmaps: Sequence[Tensor], targets: Sequence[Tensor], is_seen: Tensor, hard_keypoints: int
) -> Tensor:
    """Return CPN's loss (Chen et al. 2018): half of the mean over GlobalNet's levels, plus RefineNet's hardest joints.

    A joint's loss is its map's mean squared difference; averages are over joints and samples. It is small on purpose:
    RAdam's first steps are as large as the gradient, and of sums over the cells they would be the last.

    Args:
        heatmaps: GlobalNet's, then RefineNet's as the last, `(B, K, h, w)` each.
        targets: The same shapes.
        is_seen: `(B, K)` bool: the joints that count.
        hard_keypoints: How many joints of a sample count for RefineNet, those with the largest loss.

    Returns:
        Scalar.
    """
    losses = [
        (maps - target).square().mean((-2, -1)) * is_seen
        for maps, target in zip(heatmaps, targets, strict=True)
    ]
    *levels, refined = losses
    hardest = refined.topk(hard_keypoints, -1).values
    return 0.5 * sum(level.mean() for level in levels) / len(levels) + hardest.mean()
