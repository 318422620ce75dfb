"""Passes over the part of a depth image around a body, compiled by numba.

All take `depth` `(H, W)` float32, metres, 0 in the background and in its outermost pixels, and `spans` `(H, 2)` int64,
the first and the last column of each row that may show something; a pass that adds pixels widens them. Random numbers
are hashes of a seed and the pixel's place.
"""

from statistics import NormalDist

import numba
import numpy as np

_LEVELS = 4096
_NORMAL = np.array([NormalDist().inv_cdf((k + 0.5) / _LEVELS) for k in range(_LEVELS)], np.float32)
"""Equally likely numbers of a normal distribution, up to +-3.7."""
STEEPEST = np.radians(80)
"""The largest angle that the noise models count; they were measured up to 60 or 70 degrees."""
_BINS = 2048
_BIN = np.tan(STEEPEST) / (_BINS - 1)
_THETA = np.arctan(_BIN * np.arange(_BINS))
_GRAZING = (_THETA / (np.pi / 2 - _THETA)) ** 2
"""theta^2 / (pi / 2 - theta)^2 at multiples of `_BIN` of theta's tangent."""

_jit = numba.njit(cache=True, nogil=True)
_fast = numba.njit(cache=True, nogil=True, error_model="numpy")
_inline = numba.njit(cache=True, nogil=True, inline="always")


@_inline
def _bits(seed: np.uint64, place: int) -> np.uint64:
    """64 random bits (SplitMix64)."""
    x = seed + np.uint64(place + 1) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@_inline
def _uniform(bits: np.uint64) -> float:
    """A number in [0, 1), of the upper 32 bits."""
    return float(bits >> np.uint64(32)) * 2.0**-32


@_inline
def _normal(bits: np.uint64) -> float:
    """A number of a normal distribution of mean 0 and variance 1, of the lowest 12 bits."""
    return _NORMAL[bits & np.uint64(_LEVELS - 1)]


@_inline
def _half_power(z: float, halves: int) -> float:
    """Z to the power of a number of halves."""
    root, power = np.sqrt(z), 1.0
    for _ in range(abs(halves)):
        power *= root
    return power if halves >= 0 else 1.0 / power


@_fast
def _tangents(
    above: np.ndarray,
    here: np.ndarray,
    below: np.ndarray,
    left: int,
    right: int,
    fx: float,
    fy: float,
    out: np.ndarray,
) -> None:
    """Tangents of the angles between the surface's normal and the ray along a row, from the neighbours' depth.

    Of two neighbours across a pixel the nearer in depth counts, so that a jump is no slope. Without a jump in the code,
    some pixels at once.
    """
    none = np.float32(1e9)
    for u in range(left, right + 1):
        z = here[u]
        before = abs(here[u - 1] - z) if here[u - 1] > 0 else none
        after = abs(here[u + 1] - z) if here[u + 1] > 0 else none
        over = abs(above[u] - z) if above[u] > 0 else none
        under = abs(below[u] - z) if below[u] > 0 else none
        along_u, along_v = min(before, after), min(over, under)
        along_u = along_u * fx if along_u < none else np.float32(0)
        along_v = along_v * fy if along_v < none else np.float32(0)
        out[u] = np.sqrt(along_u * along_u + along_v * along_v) / z


@_jit
def row_spans(depth: np.ndarray, spans: np.ndarray) -> int:
    """Write the first and the last column of each row that show something, the last before the first without one.

    Returns how many pixels show something.
    """
    height, width = depth.shape
    number = 0
    for v in range(height):
        spans[v, 0], spans[v, 1] = width, -1
        for u in range(width):
            if depth[v, u] > 0.0:
                spans[v, 0] = u
                break
        for u in range(width - 1, spans[v, 0] - 1, -1):
            if depth[v, u] > 0.0:
                spans[v, 1] = u
                break
        for u in range(spans[v, 0], spans[v, 1] + 1):
            number += depth[v, u] > 0.0
    return number


@_inline
def _widen(spans: np.ndarray, v: int, u: int) -> None:
    spans[v, 0], spans[v, 1] = min(spans[v, 0], u), max(spans[v, 1], u)


@_jit
def axial_noise(
    depth: np.ndarray,
    spans: np.ndarray,
    fx: float,
    fy: float,
    terms: np.ndarray,
    halves: int,
    strength: float,
    seed: np.uint64,
) -> None:
    """Add noise of the standard deviation `AxialNoise.sigma_m` to every pixel of the body."""
    height, width = depth.shape
    c0, c1, c2, c3 = terms
    above, here, tangents = depth[0].copy(), depth[0].copy(), np.zeros(width, np.float32)
    for v in range(1, height - 1):
        here[:] = depth[v]
        left, right = spans[v, 0], spans[v, 1]
        if c3 != 0.0:
            _tangents(above, here, depth[v + 1], left, right, fx, fy, tangents)
        for u in range(left, right + 1):
            z = float(here[u])
            if z <= 0.0:
                continue
            sigma = c0 + z * (c1 + c2 * z)
            if c3 != 0.0:
                place = min(tangents[u] / _BIN, _BINS - 1.001)
                k = int(place)
                sigma += (
                    c3
                    * _half_power(z, halves)
                    * (_GRAZING[k] + (place - k) * (_GRAZING[k + 1] - _GRAZING[k]))
                )
            depth[v, u] = z + strength * sigma * _normal(_bits(seed, v * width + u))
        above, here = here, above


@_jit
def grazing(
    depth: np.ndarray, spans: np.ndarray, fx: float, fy: float, tangent: float, share: float, seed: np.uint64
) -> None:
    """Lose a share of the pixels whose surface is seen at more than an angle."""
    height, width = depth.shape
    above, here, tangents = depth[0].copy(), depth[0].copy(), np.zeros(width, np.float32)
    for v in range(1, height - 1):
        here[:] = depth[v]
        left, right = spans[v, 0], spans[v, 1]
        _tangents(above, here, depth[v + 1], left, right, fx, fy, tangents)
        for u in range(left, right + 1):
            if tangents[u] > tangent and here[u] > 0.0 and _uniform(_bits(seed, v * width + u)) < share:
                depth[v, u] = 0.0
        above, here = here, above


@_jit
def lateral(depth: np.ndarray, spans: np.ndarray, sigma_px: float, seed: np.uint64) -> None:
    """Give every pixel the depth at a place displaced at random: edges become ragged."""
    height, width = depth.shape
    clean, before = depth.copy(), spans.copy()
    reach = int(np.ceil(sigma_px * _NORMAL[_LEVELS - 1]))
    for v in range(height):
        left, right = width, -1
        for row in range(max(0, v - reach), min(height, v + reach + 1)):
            left, right = min(left, before[row, 0]), max(right, before[row, 1])
        for u in range(max(1, left - reach), min(width - 1, right + reach + 1)):
            bits = _bits(seed, v * width + u)
            row = v + int(np.rint(sigma_px * _normal(bits)))
            column = u + int(np.rint(sigma_px * _normal(bits >> np.uint64(12))))
            if 0 < row < height - 1 and 0 < column < width - 1 and 0 < v < height - 1:
                other = clean[row, column]
                # Away from the edges it is the same surface, whose depth hardly differs.
                if (other > 0.0) != (clean[v, u] > 0.0) or abs(other - clean[v, u]) > 0.02:
                    depth[v, u] = other
                    _widen(spans, v, u)


@_jit
def flying_pixels(
    depth: np.ndarray, spans: np.ndarray, jump_m: float, share: float, behind_m: float, seed: np.uint64
) -> None:
    """Move a share of the pixels beside a jump of depth some way towards the other surface, or what is behind."""
    height, width = depth.shape
    above, here = depth[0].copy(), depth[0].copy()
    for v in range(1, height - 1):
        here[:] = depth[v]
        below = depth[v + 1]
        for u in range(spans[v, 0], spans[v, 1] + 1):
            z = here[u]
            if z <= 0.0:
                continue
            farthest = max(max(here[u - 1], here[u + 1]), max(above[u], below[u]))
            if farthest < z + jump_m:
                if min(min(here[u - 1], here[u + 1]), min(above[u], below[u])) > 0.0:
                    continue
                farthest = z + np.float32(behind_m)
            bits = _bits(seed, v * width + u)
            if _uniform(bits) < share:
                along = _uniform(_bits(bits, 0))
                depth[v, u] = z + (farthest - z) * np.float32(along * along)
        above, here = here, above


@_jit
def disparity(
    depth: np.ndarray,
    spans: np.ndarray,
    focal_baseline: float,
    step_px: float,
    noise_px: float,
    seed: np.uint64,
) -> None:
    """Round depth as a sensor does that measures disparity in steps."""
    height, width = depth.shape
    for v in range(height):
        for u in range(spans[v, 0], spans[v, 1] + 1):
            z = depth[v, u]
            if z > 0.0:
                noisy = focal_baseline / z + noise_px * _normal(_bits(seed, v * width + u))
                steps = max(1.0, np.rint(noisy / step_px))
                depth[v, u] = focal_baseline / (steps * step_px)


@_jit
def shadow(depth: np.ndarray, spans: np.ndarray, focal_baseline: float, is_right: bool) -> None:
    """Lose what the projector, a baseline to one side, does not reach past what is nearer, row by row.

    A projector to the right lights a pixel of column u and depth z from its own column u - f b / z; what lies to the
    right in the image, and nearer, covers smaller columns there.
    """
    for v in range(len(depth)):
        least = 1e9
        for k in range(spans[v, 1] + 1 - spans[v, 0]):
            u = spans[v, 1] - k if is_right else spans[v, 0] + k
            z = depth[v, u]
            if z > 0.0:
                column = (u if is_right else -u) - focal_baseline / z
                if column > least + 0.75:  # neighbours on a slope stay
                    depth[v, u] = 0.0
                least = min(least, column)


@_jit
def smooth_bias(depth: np.ndarray, spans: np.ndarray, scale: float, grid: np.ndarray) -> None:
    """Multiply by a scale and add a field that is bilinear between the numbers of a grid, metres."""
    height, width = depth.shape
    rows, columns = grid.shape
    along_row = np.empty(columns)
    for v in range(height):
        y = v * (rows - 1) / (height - 1)
        i = min(int(y), rows - 2)
        y -= i
        for j in range(columns):
            along_row[j] = (1 - y) * grid[i, j] + y * grid[i + 1, j]
        for u in range(spans[v, 0], spans[v, 1] + 1):
            if depth[v, u] > 0.0:
                x = u * (columns - 1) / (width - 1)
                j = min(int(x), columns - 2)
                x -= j
                depth[v, u] = depth[v, u] * scale + (1 - x) * along_row[j] + x * along_row[j + 1]


@_inline
def _from_middle(a: float, b: float, is_box: bool) -> float:
    """1 at the edge of an ellipse, or of a rectangle with rounded corners; less inside."""
    a, b = a * a, b * b
    if is_box:
        a, b = a * a, b * b
        a, b = a * a, b * b
    return a + b


@_jit
def clear_shape(
    depth: np.ndarray, u0: float, v0: float, half_u: float, half_v: float, angle: float, is_box: bool
) -> None:
    """Lose what lies in a turned ellipse or box."""
    height, width = depth.shape
    c, s = np.cos(angle), np.sin(angle)
    reach = np.sqrt(half_u * half_u + half_v * half_v)
    for v in range(max(0, int(v0 - reach)), min(height, int(v0 + reach) + 2)):
        for u in range(max(0, int(u0 - reach)), min(width, int(u0 + reach) + 2)):
            a, b = (c * (u - u0) + s * (v - v0)) / half_u, (c * (v - v0) - s * (u - u0)) / half_v
            if _from_middle(a, b, is_box) <= 1.0:
                depth[v, u] = 0.0


@_jit
def add_object(
    depth: np.ndarray,
    spans: np.ndarray,
    u0: float,
    v0: float,
    half_u: float,
    half_v: float,
    angle: float,
    is_box: bool,
    z0: float,
    thickness: float,
    slope_u: float,
    slope_v: float,
) -> None:
    """Put a rounded object before and around the body: seen where it is nearer than what is there."""
    height, width = depth.shape
    c, s = np.cos(angle), np.sin(angle)
    reach = np.sqrt(half_u * half_u + half_v * half_v)
    for v in range(max(1, int(v0 - reach)), min(height - 1, int(v0 + reach) + 2)):
        for u in range(max(1, int(u0 - reach)), min(width - 1, int(u0 + reach) + 2)):
            a, b = (c * (u - u0) + s * (v - v0)) / half_u, (c * (v - v0) - s * (u - u0)) / half_v
            inside = 1.0 - _from_middle(a, b, is_box)
            if inside < 0.0:
                continue
            z = z0 - thickness * np.sqrt(inside) + slope_u * (u - u0) + slope_v * (v - v0)
            if z > 0.1 and (depth[v, u] <= 0.0 or z < depth[v, u]):  # not through the lens
                depth[v, u] = z
                _widen(spans, v, u)


@_jit
def add_plane(
    depth: np.ndarray,
    spans: np.ndarray,
    intrinsics: np.ndarray,
    normal: np.ndarray,
    offset: float,
    u0: float,
    v0: float,
    reach_px: float,
    z0: float,
    most_m: float,
) -> None:
    """Add a plane `normal . x = offset` around a pixel, where nothing of the body is, within `most_m` of a depth."""
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics
    for v in range(max(1, int(v0 - reach_px)), min(height - 1, int(v0 + reach_px) + 2)):
        for u in range(max(1, int(u0 - reach_px)), min(width - 1, int(u0 + reach_px) + 2)):
            if depth[v, u] > 0.0 or (u - u0) ** 2 + (v - v0) ** 2 > reach_px * reach_px:
                continue
            along = normal[0] * (u - cx) / fx + normal[1] * (v - cy) / fy + normal[2]
            if abs(along) > 1e-6 and abs(offset / along - z0) < most_m:
                depth[v, u] = offset / along
                _widen(spans, v, u)


@_jit
def lose_border(depth: np.ndarray, spans: np.ndarray, share: float, seed: np.uint64) -> None:
    """Lose a share of the pixels at the body's border, in patches of a few pixels."""
    height, width = depth.shape
    above, here = depth[0].copy(), depth[0].copy()
    for v in range(1, height - 1):
        here[:] = depth[v]
        below = depth[v + 1]
        for u in range(spans[v, 0], spans[v, 1] + 1):
            if (
                here[u] > 0.0
                and min(min(here[u - 1], here[u + 1]), min(above[u], below[u])) <= 0.0
                and _uniform(_bits(seed, (v // 4) * width + u // 4)) < share
            ):
                depth[v, u] = 0.0
        above, here = here, above


@_jit
def gain_border(depth: np.ndarray, spans: np.ndarray, share: float, behind_m: float, seed: np.uint64) -> None:
    """Take a share of the pixels around the body for the body, in patches: what is behind it, or in between."""
    height, width = depth.shape
    above, here = depth[0].copy(), depth[0].copy()
    before = spans.copy()
    for v in range(1, height - 1):
        here[:] = depth[v]
        below = depth[v + 1]
        left = min(before[v - 1, 0], min(before[v, 0], before[v + 1, 0])) - 1
        right = max(before[v - 1, 1], max(before[v, 1], before[v + 1, 1])) + 1
        for u in range(max(1, left), min(width - 2, right) + 1):
            beside = max(max(here[u - 1], here[u + 1]), max(above[u], below[u]))
            if here[u] <= 0.0 and beside > 0.0:
                bits = _bits(seed, (v // 4) * width + u // 4)
                if _uniform(bits) < share:
                    along = _uniform(_bits(bits, v * width + u))
                    depth[v, u] = beside + np.float32(behind_m * (1.0 if along < 0.7 else along * along))
                    _widen(spans, v, u)
        above, here = here, above


@_jit
def lose_ball(depth: np.ndarray, intrinsics: np.ndarray, x: float, y: float, z: float, radius: float) -> None:
    """Lose every point within a distance of a point, metres."""
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics
    half_u, half_v = 1.2 * radius * fx / z, 1.2 * radius * fy / z
    u0, v0 = x / z * fx + cx, y / z * fy + cy
    for v in range(max(0, int(v0 - half_v)), min(height, int(v0 + half_v) + 2)):
        for u in range(max(0, int(u0 - half_u)), min(width, int(u0 + half_u) + 2)):
            d = depth[v, u]
            if d > 0.0:
                away = ((u - cx) / fx * d - x) ** 2 + ((v - cy) / fy * d - y) ** 2 + (d - z) ** 2
                if away < radius * radius:
                    depth[v, u] = 0.0


@_jit
def clip_range(depth: np.ndarray, spans: np.ndarray, near_m: float, far_m: float) -> None:
    """Lose what is nearer or farther."""
    for v in range(len(depth)):
        for u in range(spans[v, 0], spans[v, 1] + 1):
            if depth[v, u] < near_m or depth[v, u] > far_m:
                depth[v, u] = 0.0
