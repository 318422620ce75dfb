"""The same normals for batches of torch tensors, on any device that knows float64."""

import math

import torch
from torch import Tensor


@torch.no_grad()
def knn_normals(points: Tensor, num_neighbours: int = 30, max_pairs: int = 2**22) -> Tensor:
    """Normals of planes fitted to the nearest neighbours among the points of each cloud.

    Equal to `ljn.cloud.normals.neighbours.knn_normals` to within rounding: distances are compared in the points'
    dtype, planes are fitted in float64.

    Args:
        points: `(B, N, 3)`, metres, camera frame; each counts as its own neighbour.
        num_neighbours: Neighbours of a point, itself included; all points where there are fewer. Of points that
            are equally far any may be taken.
        max_pairs: Pairs of points that are looked at at a time; each takes some 100 bytes at most.

    Returns:
        `(B, N, 3)` unit normals in the points' dtype, towards the camera. Where the neighbours are one place or
        a line: straight at the camera.

    Raises:
        ValueError: Not `(B, N, 3)`, or fewer than three neighbours are asked for.
    """
    if points.ndim != 3 or points.shape[-1] != 3:
        raise ValueError(f"points: expected (B, N, 3), got {tuple(points.shape)}")
    if num_neighbours < 3:
        raise ValueError(f"num_neighbours: expected at least 3, got {num_neighbours}")
    num_points = points.shape[1]
    nearest = _nearest(points, min(num_neighbours, num_points), max_pairs)  # (B, N, K)
    coordinates = points.mT.double().contiguous().unbind(1)  # three of (B, N)
    normals = torch.empty_like(points)
    num_queries = _portion(max_pairs, nearest[:, :1].numel())
    for start in range(0, num_points, num_queries):
        part = slice(start, start + num_queries)
        chosen = nearest[:, part]
        offsets = [x.gather(1, chosen.flatten(1)).view(chosen.shape) - x[:, part, None] for x in coordinates]
        count = torch.full(chosen.shape[:-1], chosen.shape[-1], dtype=torch.float64, device=points.device)
        normals[:, part] = _plane_normals(offsets, count, points[:, part].double())
    return normals


def _nearest(points: Tensor, k: int, max_pairs: int) -> Tensor:
    """Numbers `(B, N, k)` of the points that are nearest to each of `points` `(B, N, 3)`, in no order."""
    coordinates = points.mT.contiguous().unbind(1)  # three of (B, N)
    num_clouds, num_points, _ = points.shape
    nearest = torch.empty(num_clouds, num_points, k, dtype=torch.int64, device=points.device)
    num_queries = _portion(max_pairs, num_clouds * num_points)
    for start in range(0, num_points, num_queries):
        part = slice(start, start + num_queries)
        # Differences, as |p|^2 + |q|^2 - 2 p.q loses the digits that tell neighbours apart.
        dx, dy, dz = ((x[:, part, None] - x[:, None]).square_() for x in coordinates)  # (B, Q, N)
        squared = dx.add_(dy).add_(dz)
        nearest[:, part] = squared.topk(k, largest=False, sorted=False).indices
    return nearest


def _portion(max_values: int, values_each: int) -> int:
    """How many there may be at a time, if `max_values` are not to be exceeded."""
    return max(1, max_values // max(1, values_each))


@torch.no_grad()
def window_normals(
    depth: Tensor,
    pixel_ids: Tensor,
    intrinsics: Tensor,
    radius_px: int = 2,
    max_jump_m: float = 0.05,
    max_values: int = 2**21,
) -> Tensor:
    """Normals of planes fitted to the depth images around given pixels.

    Equal to `ljn.cloud.normals.window.window_normals` to within rounding: computed in float64.

    Args:
        depth: `(B, H, W)`, metres, with the noise that the points carry; 0 is background.
        pixel_ids: `(B, N)` int64, `v * W + u` of pixels of the body.
        intrinsics: `(B, 4)`: fx, fy, cx, cy, pixels.
        radius_px: Half width of the square window.
        max_jump_m: Neighbours whose depth differs by more belong to another surface.
        max_values: Pixels of windows that are looked at at a time; each takes some 100 bytes.

    Returns:
        `(B, N, 3)` unit normals in the depth's dtype, camera frame, towards the camera. Where fewer than three
        pixels, or a line of them, remain: straight at the camera.
    """
    num_images, height, width = depth.shape
    device = depth.device
    step = torch.arange(-radius_px, radius_px + 1, device=device)
    dv, du = (x.flatten() for x in torch.meshgrid(step, step, indexing="ij"))  # (P,)
    flat = depth.detach().flatten(1)
    fx, fy, cx, cy = (x[:, None, None] for x in intrinsics.double().unbind(-1))  # (B, 1, 1)
    num_pixels = _portion(max_values, num_images * len(du))
    normals = depth.new_empty(*pixel_ids.shape, 3)
    for start in range(0, pixel_ids.shape[1], num_pixels):
        part = slice(start, start + num_pixels)
        centre = pixel_ids[:, part, None]  # (B, Q, 1)
        row, column = centre // width + dv, centre % width + du  # (B, Q, P)
        z0 = flat.gather(1, centre.squeeze(-1)).double()[..., None]
        x0, y0 = (centre % width - cx) / fx * z0, (centre // width - cy) / fy * z0
        is_inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        window = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
        z = flat.gather(1, window.flatten(1)).view(window.shape).double()
        takes_part = is_inside & (z > 0) & ((z - z0).abs() <= max_jump_m)
        offsets = [(column - cx) / fx * z - x0, (row - cy) / fy * z - y0, z - z0]
        offsets = [x.masked_fill_(~takes_part, 0.0) for x in offsets]
        # Exact, in integers: the rays of a line of pixels lie in one plane, and noise would fit just that plane.
        count, su, sv, suu, suv, svv = (
            (takes_part * term).sum(-1) for term in (torch.ones_like(du), du, dv, du * du, du * dv, dv * dv)
        )
        is_line = (count * suu - su * su) * (count * svv - sv * sv) == (count * suv - su * sv).square()
        place = torch.cat([x0, y0, z0], -1)  # (B, Q, 3)
        normals[:, part] = _plane_normals(offsets, count.double(), place, is_line)
    return normals


def _plane_normals(
    offsets: list[Tensor], count: Tensor, place: Tensor, is_line: Tensor | None = None
) -> Tensor:
    """Unit normals of the planes that fit best, towards the camera.

    Args:
        offsets: x, y and z of points relative to `place`, each `(..., P)` float64; zero where a point takes no part.
        count: `(...)` float64, how many points take part.
        place: `(..., 3)` float64, metres, camera frame.
        is_line: `(...)`, where the points span no plane, whatever their offsets say.

    Returns:
        `(..., 3)` float64. Where there is no single plane: straight at the camera.
    """
    x, y, z = offsets
    count = count.clamp(min=1)
    mx, my, mz = (a.sum(-1) / count for a in offsets)
    normals = smallest_eigenvectors(
        (x * x).sum(-1) / count - mx * mx,
        (x * y).sum(-1) / count - mx * my,
        (x * z).sum(-1) / count - mx * mz,
        (y * y).sum(-1) / count - my * my,
        (y * z).sum(-1) / count - my * mz,
        (z * z).sum(-1) / count - mz * mz,
    )
    looks_away = (normals * place).sum(-1, keepdim=True) > 0
    normals = torch.where(looks_away, -normals, normals)
    is_undefined = (normals == 0).all(-1)
    if is_line is not None:
        is_undefined |= is_line
    length = place.norm(dim=-1, keepdim=True)
    forward = place.new_tensor([0.0, 0.0, 1.0])
    ray = torch.where(length > 0, place / length, forward)
    return torch.where(is_undefined[..., None], -ray, normals)


def smallest_eigenvectors(xx: Tensor, xy: Tensor, xz: Tensor, yy: Tensor, yz: Tensor, zz: Tensor) -> Tensor:
    """Unit eigenvectors of the smallest eigenvalues of symmetric 3x3 matrices; zeros where it is not unique.

    The solution of `ljn.cloud.normals.eigenvector.smallest_eigenvector`, matrix by matrix: on a GPU,
    `torch.linalg.eigh` is slow for many small matrices.

    Args:
        xx: `(...)` float64, like the other elements.
        xy: See `xx`.
        xz: See `xx`.
        yy: See `xx`.
        yz: See `xx`.
        zz: See `xx`.

    Returns:
        `(..., 3)` float64.
    """
    trace = xx + yy + zz
    scale = torch.where(trace > 0, trace, 1.0)
    xx, xy, xz, yy, yz, zz = (element / scale for element in (xx, xy, xz, yy, yz, zz))
    mean = 1.0 / 3.0
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = ((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0).sqrt()
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    # A spread of 0 has no directions; the clamp keeps the quotient finite.
    ratio = determinant / (2.0 * spread.clamp(min=1e-12) ** 3)
    angle = ratio.clamp(-1.0, 1.0).acos() / 3.0
    smallest = mean + 2.0 * spread * (angle + 2.0 * math.pi / 3.0).cos()
    a, b, c = xx - smallest, yy - smallest, zz - smallest
    products = torch.stack(
        [
            torch.stack([xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy], -1),
            torch.stack([xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz], -1),
            torch.stack([b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz], -1),
        ],
        -2,
    )  # (..., 3 pairs of rows, 3)
    best, pair = products.square().sum(-1).max(-1)
    vector = products.gather(-2, pair[..., None, None].expand(*pair.shape, 1, 3)).squeeze(-2)
    # See the scalar solution for the limits.
    is_unique = (trace > 0) & (spread >= 1e-12) & (best >= 1e-12)
    return torch.where(is_unique[..., None], vector / best.clamp(min=1e-12).sqrt()[..., None], 0.0)
