"""Loops over pixels and vertices, compiled by numba: the body's surface painted and lit, pictures composed."""

import numba
import numpy as np

from datamodules.rgb.look import CHECKS, CLOUDS, CUT, DOTS, MATERIAL, PLAIN, PRINT, STRIPES
from datamodules.rgb.surface import ARM, HEAD, TRUNK

_LAST = 31  # one less than a power of 2
_NOISE = np.random.default_rng(0).random((_LAST + 1,) * 3, dtype=np.float32)
"""The same for all; a sample draws its place in it."""

_SKIN, _HAIR, _SHIRT, _TROUSERS = MATERIAL["skin"], MATERIAL["hair"], MATERIAL["shirt"], MATERIAL["trousers"]
_SHOES, _GLOVES, _SOCKS, _INNER = MATERIAL["shoes"], MATERIAL["gloves"], MATERIAL["socks"], MATERIAL["inner"]
_BELT, _LIPS, _EYES, _BEARD = MATERIAL["belt"], MATERIAL["lips"], MATERIAL["eyes"], MATERIAL["beard"]
_HAIR_TOP, _HAIR_BACK, _HAIR_NAPE = CUT["hair_top"], CUT["hair_back"], CUT["hair_nape"]
_BEARD_TOP, _COLLAR, _V_NECK, _HEM, _WAIST = (
    CUT["beard"],
    CUT["collar"],
    CUT["v_neck"],
    CUT["hem"],
    CUT["waist"],
)
_SLEEVE, _GLOVE, _SKIRT, _TROUSER = CUT["sleeve"], CUT["glove"], CUT["skirt"], CUT["trousers"]
_SOCK, _SHOE, _OPENING, _BELT_HALF = CUT["sock"], CUT["shoe"], CUT["opening"], CUT["belt"]


@numba.njit(cache=True, nogil=True)
def image_box(vertices: np.ndarray, intrinsics: np.ndarray) -> tuple[float, float, float, float]:
    """First and last column, first and last row of the pixels that a mesh `(V, 3)`, camera frame, can cover."""
    left = top = np.inf
    right = bottom = -np.inf
    for i in range(len(vertices)):
        u = vertices[i, 0] / vertices[i, 2] * intrinsics[0] + intrinsics[2]
        v = vertices[i, 1] / vertices[i, 2] * intrinsics[1] + intrinsics[3]
        left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
    return np.ceil(left), np.floor(right), np.ceil(top), np.floor(bottom)


@numba.njit(cache=True, nogil=True)
def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals `(V, 3)` float32, outward, of a length of no meaning: the sums of the faces' around each vertex."""
    normals = np.zeros((len(vertices), 3), np.float32)
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = (
            vertices[j, 0] - vertices[i, 0],
            vertices[j, 1] - vertices[i, 1],
            vertices[j, 2] - vertices[i, 2],
        )
        bx, by, bz = (
            vertices[k, 0] - vertices[i, 0],
            vertices[k, 1] - vertices[i, 1],
            vertices[k, 2] - vertices[i, 2],
        )
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        for corner in (i, j, k):
            normals[corner, 0] += nx
            normals[corner, 1] += ny
            normals[corner, 2] += nz
    return normals


@numba.njit(cache=True, nogil=True)
def _noise(x: float, y: float, z: float) -> float:
    """Smooth noise in 0-1, a new number at every whole one."""
    x0, y0, z0 = np.floor(x), np.floor(y), np.floor(z)
    u, v, w = x - x0, y - y0, z - z0
    i, j, k = int(x0) & _LAST, int(y0) & _LAST, int(z0) & _LAST
    i1, j1, k1 = (i + 1) & _LAST, (j + 1) & _LAST, (k + 1) & _LAST
    u, v, w = u * u * (3 - 2 * u), v * v * (3 - 2 * v), w * w * (3 - 2 * w)
    a = (_NOISE[i, j, k] * (1 - u) + _NOISE[i1, j, k] * u) * (1 - v)
    a += (_NOISE[i, j1, k] * (1 - u) + _NOISE[i1, j1, k] * u) * v
    b = (_NOISE[i, j, k1] * (1 - u) + _NOISE[i1, j, k1] * u) * (1 - v)
    b += (_NOISE[i, j1, k1] * (1 - u) + _NOISE[i1, j1, k1] * u) * v
    return a * (1 - w) + b * w


@numba.njit(cache=True, nogil=True)
def _along(value: float, marks: np.ndarray) -> float:
    """Where a number lies among four rising marks: 0 at the first, 3 at the last."""
    if value < marks[0]:
        return (value - marks[0]) / (marks[1] - marks[0])
    for i in range(3):
        if value < marks[i + 1] or i == 2:
            return i + (value - marks[i]) / (marks[i + 1] - marks[i])
    return 3.0


@numba.njit(cache=True, nogil=True)
def _is_hair(x: float, height: float, back: float, cuts: np.ndarray) -> bool:
    """Whether a place of the head, or of the neck and back below it, is covered by hair."""
    if height + 0.35 * max(0.0, back - 0.3) > cuts[_HAIR_TOP]:
        return True
    return back > cuts[_HAIR_BACK] and height > cuts[_HAIR_NAPE]


@numba.njit(cache=True, nogil=True)
def material_at(
    region: int,
    x: float,
    y: float,
    z: float,
    cuts: np.ndarray,
    head: np.ndarray,
    trunk: np.ndarray,
    arm: np.ndarray,
    leg: np.ndarray,
) -> int:
    """The material of a place of the rest pose; see `Look.cuts` and `Surface`."""
    height, back = (y - head[0]) / (head[1] - head[0]), (head[3] - z) / (head[3] - head[2])
    up = (y - trunk[0]) / (trunk[1] - trunk[0])
    across = abs(x)
    if region == HEAD:
        if _is_hair(across, height, back, cuts):
            return _HAIR
        if back < 0.4 and height > 0.0:
            if (across / 0.026) ** 2 + ((height - 0.27) / 0.045) ** 2 < 1.0 and back < 0.25:
                return _LIPS
            if ((across - 0.034) / 0.015) ** 2 + ((height - 0.56) / 0.028) ** 2 < 1.0:
                return _EYES
            if abs(across - 0.034) < 0.02 and abs(height - 0.655) < 0.018:
                return _BEARD  # brows
        if height > 0.0 and height < cuts[_BEARD_TOP] and back < 0.55:
            return _BEARD
        return (
            _SHIRT
            if up < cuts[_COLLAR]
            and not (z > trunk[1] * 0 and back < 0.5 and up > cuts[_V_NECK] + 3 * across)
            else _SKIN
        )
    if region == TRUNK:
        if back > 0.55 and across < 0.13 and _is_hair(across, height, back, cuts):
            return _HAIR
        is_front = back < 0.6
        if is_front and up > cuts[_V_NECK] + 3.0 * across:
            return _SKIN
        if up > cuts[_COLLAR]:
            return _SKIN
        if abs(up - cuts[_HEM]) < cuts[_BELT_HALF] and cuts[_BELT_HALF] < 1.0:
            return _BELT
        if up > cuts[_HEM]:
            if is_front and across < cuts[_OPENING]:
                return _INNER
            return _SHIRT
        return _TROUSERS if up < cuts[_WAIST] else _SKIN
    if region == ARM:
        along = _along(across, arm)
        if along > cuts[_GLOVE]:
            return _GLOVES
        return _SHIRT if along < cuts[_SLEEVE] else _SKIN
    along = _along(-y, leg)
    if along > cuts[_SHOE]:
        return _SHOES
    if along < cuts[_SKIRT]:
        return _SHIRT
    if along < cuts[_TROUSER]:
        return _TROUSERS
    return _SOCKS if along > cuts[_SOCK] else _SKIN


@numba.njit(cache=True, nogil=True)
def _pattern(x: float, y: float, z: float, pattern: np.ndarray, shift: np.ndarray) -> float:
    """How much of a material's second colour is at a place, 0-1."""
    kind, size, share = int(pattern[0]), pattern[1], pattern[2]
    if kind == PLAIN:
        return 0.0
    a = (x * pattern[3] + y * pattern[4] + z * pattern[5] + shift[0]) / size
    b = (x * pattern[6] + y * pattern[7] + z * pattern[8] + shift[1]) / size
    if kind == STRIPES:
        return 1.0 if a - np.floor(a) < share else 0.0
    if kind == CHECKS:
        one = 0.5 if a - np.floor(a) < share else 0.0
        return one + (0.5 if b - np.floor(b) < share else 0.0)
    if kind == DOTS:
        da, db = a - np.floor(a) - 0.5, b - np.floor(b) - 0.5
        return 1.0 if da * da + db * db < 0.16 * share else 0.0
    fine = _noise((x + shift[0]) / size, (y + shift[1]) / size, (z + shift[2]) / size)
    if kind == CLOUDS:
        return min(1.0, max(0.0, 3.0 * fine - 1.0))
    is_print = kind == PRINT
    if is_print and (z < 0.0 or abs(x) > 0.11 or y < -0.06 or y > 0.13):  # on the chest alone
        return 0.0
    return 1.0 if fine < 0.2 + 0.5 * share else 0.0


@numba.njit(cache=True, nogil=True)
def paint(
    face_ids: np.ndarray,
    barycentrics: np.ndarray,
    normals: np.ndarray,
    faces: np.ndarray,
    regions: np.ndarray,
    rest: np.ndarray,
    head: np.ndarray,
    trunk: np.ndarray,
    arm: np.ndarray,
    leg: np.ndarray,
    colours: np.ndarray,
    patterns: np.ndarray,
    wear: np.ndarray,
    gloss: np.ndarray,
    cuts: np.ndarray,
    lights: np.ndarray,
    ambient: np.ndarray,
    shift: np.ndarray,
) -> np.ndarray:
    """The picture `(H, W, 3)` float32, linear RGB, of what is seen; 0 in the background. See `Surface` and `Look`."""
    rows, columns = face_ids.shape
    image = np.zeros((rows, columns, 3), np.float32)
    for v in range(rows):
        for u in range(columns):
            f = face_ids[v, u]
            if f < 0:
                continue
            x = y = z = nx = ny = nz = 0.0
            for k in range(3):
                i, share = faces[f, k], barycentrics[v, u, k]
                x += share * rest[i, 0]
                y += share * rest[i, 1]
                z += share * rest[i, 2]
                nx += share * normals[i, 0]
                ny += share * normals[i, 1]
                nz += share * normals[i, 2]
            length = max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
            nx, ny, nz = nx / length, ny / length, nz / length
            m = material_at(regions[f], x, y, z, cuts, head, trunk, arm, leg)
            blend = _pattern(x, y, z, patterns[m], shift)
            tone = 1.0
            if wear[m] > 0.0:
                coarse = _noise((x + shift[1]) * 14, (y + shift[2]) * 14, (z + shift[0]) * 14)
                fine = _noise((x + shift[2]) * 55, (y + shift[0]) * 55, (z + shift[1]) * 55)
                tone = 1.0 + wear[m] * (coarse + 0.6 * fine - 0.8)
            above = 0.5 - 0.5 * ny
            red = ambient[0, 0] * above + ambient[1, 0] * (1 - above)
            green = ambient[0, 1] * above + ambient[1, 1] * (1 - above)
            blue = ambient[0, 2] * above + ambient[1, 2] * (1 - above)
            shine_r = shine_g = shine_b = 0.0
            for i in range(len(lights)):
                lx, ly, lz = lights[i, 0], lights[i, 1], lights[i, 2]
                facing = nx * lx + ny * ly + nz * lz
                if facing <= 0.0:
                    continue
                red += facing * lights[i, 3]
                green += facing * lights[i, 4]
                blue += facing * lights[i, 5]
                if gloss[m, 0] > 0.0:
                    hx, hy, hz = lx, ly, lz - 1.0  # half way to the camera
                    half = (nx * hx + ny * hy + nz * hz) / max(np.sqrt(hx * hx + hy * hy + hz * hz), 1e-6)
                    if half > 0.0:
                        shine = gloss[m, 0] * half ** gloss[m, 1]
                        shine_r += shine * lights[i, 3]
                        shine_g += shine * lights[i, 4]
                        shine_b += shine * lights[i, 5]
            first, second = colours[m, 0], colours[m, 1]
            image[v, u, 0] = tone * (first[0] + blend * (second[0] - first[0])) * red + shine_r
            image[v, u, 1] = tone * (first[1] + blend * (second[1] - first[1])) * green + shine_g
            image[v, u, 2] = tone * (first[2] + blend * (second[2] - first[2])) * blue + shine_b
    return image


@numba.njit(cache=True, nogil=True)
def facing(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The numbers of the faces that are turned towards the camera: of a closed surface, all that can be seen."""
    chosen = np.empty(len(faces), np.int64)
    number = 0
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        bx, by, bz = vertices[j, 0] - ax, vertices[j, 1] - ay, vertices[j, 2] - az
        cx, cy, cz = vertices[k, 0] - ax, vertices[k, 1] - ay, vertices[k, 2] - az
        if ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx) <= 0.0:
            chosen[number] = f
            number += 1
    return chosen[:number]


@numba.njit(cache=True, nogil=True)
def _share(mask: np.ndarray, v: int, u: int) -> float:
    """How many of the four pixels of a mask `(2 h, 2 w)`, 0 or 1, are set that one of half its size is made of."""
    count = int(mask[2 * v, 2 * u]) + int(mask[2 * v, 2 * u + 1])
    return 0.25 * (count + int(mask[2 * v + 1, 2 * u]) + int(mask[2 * v + 1, 2 * u + 1]))


@numba.njit(cache=True, nogil=True)
def composed(person: np.ndarray, mask: np.ndarray, behind: np.ndarray) -> np.ndarray:
    """The person before a background, as a screen shows it: the square root of linear light.

    Args:
        person: `(2 h, 2 w, 3)` float32, linear RGB, 0 where the mask is.
        mask: `(2 h, 2 w)` uint8, 1 on the person.
        behind: `(h, w, 3)` float32, as a screen shows it.

    Returns:
        `(h, w, 3)` float32 in 0-1.
    """
    picture = np.empty_like(behind)
    for v in range(behind.shape[0]):
        for u in range(behind.shape[1]):
            share = np.float32(_share(mask, v, u))
            for c in range(3):
                shown = (1 - share) * behind[v, u, c]
                if share > 0:
                    light = person[2 * v, 2 * u, c] + person[2 * v, 2 * u + 1, c]
                    light += person[2 * v + 1, 2 * u, c] + person[2 * v + 1, 2 * u + 1, c]
                    shown += share * np.sqrt(np.float32(0.25) * light / share)
                picture[v, u, c] = min(max(shown, np.float32(0)), np.float32(1))
    return picture


@numba.njit(cache=True, nogil=True)
def finished(picture: np.ndarray, mask: np.ndarray, is_black: bool) -> np.ndarray:
    """A picture `(h, w, 3)` in 0-1 as `(3, h, w)` uint8; black outside of the mask `(2 h, 2 w)`, if so wanted."""
    height, width = picture.shape[:2]
    crop = np.empty((3, height, width), np.uint8)
    for v in range(height):
        for u in range(width):
            share = _share(mask, v, u) if is_black else 1.0
            for c in range(3):
                crop[c, v, u] = np.uint8(255 * share * min(max(picture[v, u, c], 0.0), 1.0) + 0.5)
    return crop
