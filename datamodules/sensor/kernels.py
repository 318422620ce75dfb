"""Passes over a depth image, compiled by numba. Random numbers are hashes of a seed and the pixel's place."""

import numba
import numpy as np

_jit = numba.njit(cache=True, nogil=True)
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
    """A number of mean 0 and variance 1, close to normal: the sum of four uniform ones, within +-3.5."""
    mask = np.uint64(0xFFFF)
    total = (
        float(bits & mask)
        + float((bits >> np.uint64(16)) & mask)
        + float((bits >> np.uint64(32)) & mask)
        + float(bits >> np.uint64(48))
    )
    return (total * 2.0**-16 - 2.0 + 2.0**-15) * np.sqrt(3.0)


@_inline
def _tangent(depth: np.ndarray, v: int, u: int, fx: float, fy: float) -> float:
    """Tangent of the angle between the surface's normal and the ray at a pixel, from its neighbours' depth.

    Of two neighbours across a pixel the nearer in depth counts, so that a jump is no slope.
    """
    height, width = depth.shape
    z = depth[v, u]
    left = depth[v, u - 1] if u > 0 else np.float32(0)
    right = depth[v, u + 1] if u < width - 1 else np.float32(0)
    up = depth[v - 1, u] if v > 0 else np.float32(0)
    down = depth[v + 1, u] if v < height - 1 else np.float32(0)
    along_u = min(abs(left - z) if left > 0 else 1e9, abs(right - z) if right > 0 else 1e9)
    along_v = min(abs(up - z) if up > 0 else 1e9, abs(down - z) if down > 0 else 1e9)
    along_u = 0.0 if along_u == 1e9 else along_u * fx / z
    along_v = 0.0 if along_v == 1e9 else along_v * fy / z
    return np.sqrt(along_u * along_u + along_v * along_v)


@_jit
def axial_noise(
    depth: np.ndarray, fx: float, fy: float, terms: np.ndarray, strength: float, seed: np.uint64
) -> None:
    """Add noise of the standard deviation `AxialNoise.sigma_m` to every pixel of the body."""
    height, width = depth.shape
    clean = depth.copy()
    for v in range(height):
        for u in range(width):
            z = float(clean[v, u])
            if z <= 0.0:
                continue
            theta = min(np.arctan(_tangent(clean, v, u, fx, fy)), terms[5])
            grazing = theta * theta / (np.pi / 2 - theta) ** 2
            sigma = terms[0] + terms[1] * z + terms[2] * z * z + terms[3] * z ** terms[4] * grazing
            depth[v, u] = z + strength * sigma * _normal(_bits(seed, v * width + u))


@_jit
def grazing(
    depth: np.ndarray, fx: float, fy: float, tangent: float, share: float, seed: np.uint64
) -> None:
    """Lose a share of the pixels whose surface is seen at more than an angle."""
    height, width = depth.shape
    clean = depth.copy()
    for v in range(height):
        for u in range(width):
            if (
                clean[v, u] > 0.0
                and _tangent(clean, v, u, fx, fy) > tangent
                and _uniform(_bits(seed, v * width + u)) < share
            ):
                depth[v, u] = 0.0


@_jit
def lateral(depth: np.ndarray, sigma_px: float, seed: np.uint64) -> None:
    """Give every pixel the depth at a place displaced at random: edges become ragged."""
    height, width = depth.shape
    clean = depth.copy()
    for v in range(height):
        for u in range(width):
            # Away from the edges it is the same surface, whose depth hardly differs.
            bits = _bits(seed, v * width + u)
            row = v + int(np.rint(sigma_px * _normal(bits)))
            column = u + int(np.rint(sigma_px * _normal(_bits(bits, 0))))
            if 0 <= row < height and 0 <= column < width:
                other = clean[row, column]
                if (other > 0.0) != (clean[v, u] > 0.0) or abs(other - clean[v, u]) > 0.02:
                    depth[v, u] = other


@_jit
def flying_pixels(
    depth: np.ndarray, jump_m: float, share: float, behind_m: float, seed: np.uint64
) -> None:
    """Move a share of the pixels beside a jump of depth some way towards the other surface, or what is behind."""
    height, width = depth.shape
    clean = depth.copy()
    for v in range(height):
        for u in range(width):
            z = clean[v, u]
            if z <= 0.0:
                continue
            farthest, is_border = z, False
            for dv, du in ((0, -1), (0, 1), (-1, 0), (1, 0)):
                if 0 <= v + dv < height and 0 <= u + du < width:
                    other = clean[v + dv, u + du]
                    is_border |= other <= 0.0
                    farthest = max(farthest, other)
            if farthest < z + jump_m:
                if not is_border:
                    continue
                farthest = z + np.float32(behind_m)
            bits = _bits(seed, v * width + u)
            if _uniform(bits) < share:
                along = _uniform(_bits(bits, 0))
                depth[v, u] = z + (farthest - z) * np.float32(along * along)


@_jit
def disparity(
    depth: np.ndarray, focal_baseline: float, step_px: float, noise_px: float, seed: np.uint64
) -> None:
    """Round depth as a sensor does that measures disparity in steps."""
    height, width = depth.shape
    for v in range(height):
        for u in range(width):
            z = depth[v, u]
            if z > 0.0:
                noisy = focal_baseline / z + noise_px * _normal(_bits(seed, v * width + u))
                steps = max(1.0, np.rint(noisy / step_px))
                depth[v, u] = focal_baseline / (steps * step_px)


@_jit
def shadow(depth: np.ndarray, focal_baseline: float, margin_px: float) -> None:
    """Lose what the projector, a baseline to the right, does not reach past what is nearer, row by row.

    A pixel at column u is lit from the projector's column u - f b / z; what lies to its right in the image and nearer
    covers smaller columns there.
    """
    height, width = depth.shape
    for v in range(height):
        least = 1e9
        for u in range(width - 1, -1, -1):
            z = depth[v, u]
            if z <= 0.0:
                continue
            column = u - focal_baseline / z
            if column > least + margin_px:
                depth[v, u] = 0.0
            least = min(least, column)


@_jit
def smooth_bias(depth: np.ndarray, grid: np.ndarray) -> None:
    """Add a field that is bilinear between the numbers of a grid, metres, to the body."""
    height, width = depth.shape
    rows, columns = grid.shape
    for v in range(height):
        y = v * (rows - 1) / max(1, height - 1)
        i = min(int(y), rows - 2)
        y -= i
        for u in range(width):
            if depth[v, u] <= 0.0:
                continue
            x = u * (columns - 1) / max(1, width - 1)
            j = min(int(x), columns - 2)
            x -= j
            depth[v, u] += (1 - y) * ((1 - x) * grid[i, j] + x * grid[i, j + 1]) + y * (
                (1 - x) * grid[i + 1, j] + x * grid[i + 1, j + 1]
            )


@_jit
def clear_shape(
    depth: np.ndarray, u0: float, v0: float, half_u: float, half_v: float, angle: float, power: float
) -> None:
    """Lose what lies in a turned superellipse: 2 is an ellipse, 8 nearly a rectangle."""
    height, width = depth.shape
    c, s = np.cos(angle), np.sin(angle)
    reach = np.sqrt(half_u * half_u + half_v * half_v)
    for v in range(max(0, int(v0 - reach)), min(height, int(v0 + reach) + 2)):
        for u in range(max(0, int(u0 - reach)), min(width, int(u0 + reach) + 2)):
            a = abs(c * (u - u0) + s * (v - v0)) / half_u
            b = abs(c * (v - v0) - s * (u - u0)) / half_v
            if a <= 1.0 and b <= 1.0 and a**power + b**power <= 1.0:
                depth[v, u] = 0.0


@_jit
def add_object(
    depth: np.ndarray,
    u0: float,
    v0: float,
    half_u: float,
    half_v: float,
    angle: float,
    power: float,
    z0: float,
    thickness: float,
    slope_u: float,
    slope_v: float,
) -> None:
    """Put a rounded object before and around the body: seen where it is nearer than what is there."""
    height, width = depth.shape
    c, s = np.cos(angle), np.sin(angle)
    reach = np.sqrt(half_u * half_u + half_v * half_v)
    for v in range(max(0, int(v0 - reach)), min(height, int(v0 + reach) + 2)):
        for u in range(max(0, int(u0 - reach)), min(width, int(u0 + reach) + 2)):
            a = abs(c * (u - u0) + s * (v - v0)) / half_u
            b = abs(c * (v - v0) - s * (u - u0)) / half_v
            if a > 1.0 or b > 1.0:
                continue
            inside = 1.0 - a**power - b**power
            if inside < 0.0:
                continue
            z = z0 - thickness * np.sqrt(inside) + slope_u * (u - u0) + slope_v * (v - v0)
            if depth[v, u] <= 0.0 or z < depth[v, u]:
                depth[v, u] = z


@_jit
def add_plane(
    depth: np.ndarray,
    rays: np.ndarray,
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
    fx, fy, cx, cy = rays
    for v in range(max(0, int(v0 - reach_px)), min(height, int(v0 + reach_px) + 2)):
        for u in range(max(0, int(u0 - reach_px)), min(width, int(u0 + reach_px) + 2)):
            if depth[v, u] > 0.0 or (u - u0) ** 2 + (v - v0) ** 2 > reach_px * reach_px:
                continue
            along = normal[0] * (u - cx) / fx + normal[1] * (v - cy) / fy + normal[2]
            if abs(along) < 1e-6:
                continue
            z = offset / along
            if abs(z - z0) < most_m:
                depth[v, u] = z


@_jit
def lose_border(depth: np.ndarray, share: float, seed: np.uint64) -> None:
    """Lose a share of the pixels at the body's border, in patches of a few pixels."""
    height, width = depth.shape
    clean = depth.copy()
    for v in range(height):
        for u in range(width):
            if clean[v, u] <= 0.0:
                continue
            is_border = False
            for dv, du in ((0, -1), (0, 1), (-1, 0), (1, 0)):
                if 0 <= v + dv < height and 0 <= u + du < width:
                    is_border |= clean[v + dv, u + du] <= 0.0
            if is_border and _uniform(_bits(seed, (v // 4) * width + u // 4)) < share:
                depth[v, u] = 0.0


@_jit
def gain_border(
    depth: np.ndarray, share: float, behind_m: float, seed: np.uint64
) -> None:
    """Take a share of the pixels around the body for the body, in patches: what is behind it, or its own edge's depth."""
    height, width = depth.shape
    clean = depth.copy()
    for v in range(height):
        for u in range(width):
            if clean[v, u] > 0.0:
                continue
            nearest = np.float32(0.0)
            for dv, du in ((0, -1), (0, 1), (-1, 0), (1, 0)):
                if 0 <= v + dv < height and 0 <= u + du < width and clean[v + dv, u + du] > 0.0:
                    nearest = clean[v + dv, u + du]
            if nearest > 0.0:
                bits = _bits(seed, (v // 4) * width + u // 4)
                if _uniform(bits) < share:
                    along = _uniform(_bits(bits, v * width + u))
                    depth[v, u] = nearest + np.float32(behind_m * (1.0 if along < 0.7 else along * along))


@_jit
def lose_ball(depth: np.ndarray, rays: np.ndarray, x: float, y: float, z: float, radius: float) -> None:
    """Lose every point within a distance of a point, metres."""
    height, width = depth.shape
    fx, fy, cx, cy = rays
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
def clip_range(depth: np.ndarray, near_m: float, far_m: float) -> None:
    """Lose what is nearer or farther."""
    height, width = depth.shape
    for v in range(height):
        for u in range(width):
            if depth[v, u] < near_m or depth[v, u] > far_m:
                depth[v, u] = 0.0
