"""Operations on sets of points: distance matrices, gathering, farthest point sampling and ball grouping."""

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
        group_size: Number of points in each group, at least 1; may exceed N, then points repeat.

    Returns:
        `(B, M, group_size)`, int64 indices into the N points.

    Raises:
        ValueError: `group_size` is less than 1, or there is not one radius for each centre.
    """
    if group_size < 1:
        raise ValueError(f"group_size: expected at least 1, got {group_size}")
    if radii.shape != centres.shape[1:2]:
        raise ValueError(
            f"radii: expected one for each of {centres.shape[1]} centres, got {tuple(radii.shape)}"
        )
    form = _ball_group_on_cpu if points.is_cpu else _ball_group_as_tensors
    return form(points, centres, radii, group_size)


def _ball_group_as_tensors(points: Tensor, centres: Tensor, radii: Tensor, group_size: int) -> Tensor:
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
        group[is_empty] = _nearest(squared[is_empty], group_size)
    return group


def _nearest(squared: Tensor, group_size: int) -> Tensor:
    """Indices `(E, group_size)` of the smallest of `squared` `(E, N)`, repeated where N is smaller."""
    nearest = squared.topk(min(group_size, squared.shape[-1]), largest=False).indices
    return nearest[:, torch.arange(group_size, device=squared.device) % nearest.shape[-1]]


def _ball_group_on_cpu(points: Tensor, centres: Tensor, radii: Tensor, group_size: int) -> Tensor:
    from ljn.geometry import kernels  # numba takes its time to import

    group = torch.empty(*centres.shape[:2], group_size, dtype=torch.int64)
    columns = (points.detach(), centres.detach().to(points), radii.detach().to(points).square())
    arrays = [column.contiguous().numpy() for column in columns]
    kernels.ball_group(arrays[0], arrays[1], arrays[2], group.numpy())
    is_empty = group[..., 0] < 0
    if is_empty.any():
        sample, centre = is_empty.nonzero(as_tuple=True)
        squared = squared_distances(centres[sample, centre][:, None], points[sample])[:, 0]
        group[is_empty] = _nearest(squared, group_size)
    return group


@torch.no_grad()
def farthest_point_sampling(points: Tensor, num_samples: int) -> Tensor:
    """Indices of points that are spread over the cloud: each is the farthest from those before it.

    The first is the point farthest from the cloud's mean, not a random one: the sample is the same in every
    run and, but for ties, whatever the order of the points.

    Args:
        points: `(B, N, 3)`, metres.
        num_samples: Number of points to take; beyond the number of distinct points, points repeat.

    Returns:
        `(B, num_samples)`, int64 indices into the N points.

    Raises:
        ValueError: `num_samples` exceeds N.
    """
    if not 1 <= num_samples <= points.shape[1]:
        raise ValueError(
            f"num_samples: expected 1 to {points.shape[1]}, the number of points, got {num_samples}"
        )
    # In float64: the mean's rounding, and with it the first point, does not depend on the points' order.
    centres = points.double().mean(1).to(points)
    form = _farthest_points_on_cpu if points.is_cpu else _farthest_points_as_tensors
    return form(points, centres, num_samples)


def _farthest_points_on_cpu(points: Tensor, centres: Tensor, num_samples: int) -> Tensor:
    from ljn.geometry import kernels

    index = torch.empty(len(points), num_samples, dtype=torch.int64)
    kernels.farthest_points(points.detach().contiguous().numpy(), centres.numpy(), index.numpy())
    return index


def _farthest_points_as_tensors(points: Tensor, centres: Tensor, num_samples: int) -> Tensor:
    index = torch.empty(len(points), num_samples, dtype=torch.int64, device=points.device)
    index[:, 0] = squared_distances(centres[:, None], points)[:, 0].argmax(-1)
    distance = torch.full(points.shape[:2], torch.inf, dtype=points.dtype, device=points.device)
    for number in range(1, num_samples):
        last = gather_points(points, index[:, number - 1 : number])  # (B, 1, 3)
        distance = torch.minimum(distance, squared_distances(last, points)[:, 0])
        index[:, number] = distance.argmax(-1)
    return index
