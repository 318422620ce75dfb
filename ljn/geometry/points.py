"""Operations on sets of points: distance matrices, gathering and ball grouping."""

import torch
from torch import Tensor


def distance_matrix(points: Tensor) -> Tensor:
    """Euclidean distance matrix (EDM) of a set of points, unsquared.

    Its gradient at a zero distance (the diagonal, repeated points) is zero, not NaN.

    Args:
        points: `(..., K, 3)`, metres.

    Returns:
        `(..., K, K)`, metres.
    """
    squared = (points[..., :, None, :] - points[..., None, :, :]).square().sum(-1)
    is_zero = squared == 0
    return squared.masked_fill(is_zero, 1.0).sqrt().masked_fill(is_zero, 0.0)


def gather_points(features: Tensor, index: Tensor) -> Tensor:
    """Rows of `features` picked by `index`.

    Args:
        features: `(B, N, C)`.
        index: `(B, ...)`, integers in `[0, N)`.

    Returns:
        `(B, ..., C)`.
    """
    batch, num_points, channels = features.shape
    offset = torch.arange(batch, device=index.device) * num_points
    flat = (index.reshape(batch, -1) + offset[:, None]).reshape(-1)
    return features.reshape(-1, channels).index_select(0, flat).reshape(*index.shape, channels)


def squared_distances(centres: Tensor, points: Tensor) -> Tensor:
    """Squared distances from each centre to each point, `(B, M, 3)`, `(B, N, 3)` -> `(B, M, N)`, m^2.

    Summed over the three differences rather than expanded into a product: exact for close points far from
    the origin, where the expansion cancels.
    """
    total = (centres[..., :, None, 0] - points[..., None, :, 0]).square()
    for axis in (1, 2):
        difference = centres[..., :, None, axis] - points[..., None, :, axis]
        total = total + difference * difference
    return total


@torch.no_grad()
def ball_group(points: Tensor, centres: Tensor, radii: Tensor, group_size: int) -> Tensor:
    """Indices of `group_size` points within a radius of each centre (ball query).

    An overfull ball gives its first points in the cloud's order (a random subset, where the cloud is
    shuffled), an underfull one repeats its points in turn, an empty one takes the nearest points of all.

    Args:
        points: `(B, N, 3)`, metres, N at least 1.
        centres: `(B, M, 3)`, metres.
        radii: `(M,)`, metres.
        group_size: Number of points in each group; may exceed N, then points repeat.

    Returns:
        `(B, M, group_size)`, int64 indices into the N points.
    """
    num_points = points.shape[1]
    squared = squared_distances(centres, points)  # (B, M, N)
    inside = squared <= radii.square()[:, None]
    rank = inside.cumsum(-1, dtype=torch.int32)  # 1-based among the ball's points
    count = rank[..., -1:].long()  # (B, M, 1)
    slot = torch.where(inside & (rank <= group_size), rank - 1, group_size).long()
    order = torch.arange(num_points, device=points.device).expand_as(slot)
    # Slot `group_size` collects every point that was not taken; it is cut off.
    group = torch.zeros(*slot.shape[:-1], group_size + 1, dtype=torch.int64, device=points.device)
    group = group.scatter_(-1, slot, order)[..., :group_size]
    turn = torch.arange(group_size, device=points.device) % count.clamp(min=1)
    group = group.gather(-1, turn)

    is_empty = count[..., 0] == 0
    if is_empty.any():
        nearest = squared[is_empty].topk(min(group_size, num_points), largest=False).indices
        repeat = torch.arange(group_size, device=points.device) % nearest.shape[-1]
        group[is_empty] = nearest[:, repeat]
    return group
