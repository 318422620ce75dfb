"""The person in a depth image of a whole room: floor, walls and other large planes are taken away."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation

from ljn.cloud.normals.window import window_normals
from ljn.cloud.sampling import Cloud
from ljn.geometry.camera import Camera
from ljn.pipeline.person import Person, find_person
from ljn.pipeline.report import Report

_SIDE_PX = 240
"""Planes are looked for in an image of about this size."""
_HYPOTHESES, _POINTS, _REACH = 400, 2500, 0.2
"""Planes that are tried, through three pixels each, the last two no farther from the first than this share of the
image; and the points that they are tried on."""
_COSINE = np.cos(np.deg2rad(30))
"""Between the normal of a plane and that of a point on it, at least."""
_PLANE_M2, _MOST_PLANES = (0.35, 0.2), 12
"""Hardly a part of a person as large as this is plane; the second where the first leaves things too large."""
_FACET_M2 = 0.02
"""The least plane that counts in a figure's shape."""
_NEAR_M = (0.2, 0.1)
"""In a room, pieces nearer than this belong together; on those of up to twice as far see `Person.beside_m2`."""
_LARGE = np.array([0.95, 2.4, 1.6, 1.2, np.inf, np.inf])
"""Of a figure's shape: more than this is no single person."""
_BESIDE_M2 = 0.02
"""So much that may belong to the person, or not, is worth a warning."""
_CUT_M = 1.5
"""Two feet, or a hand and two feet, touch floor and walls along less than this."""
_LEAST_M2, _MOST_FIGURES = 0.07, 8
_TYPICAL = np.array([[0.43, 0.14], [1.45, 0.28], [0.65, 0.17], [0.38, 0.12], [0.50, 0.17], [0.22, 0.09]])
"""Mean and standard deviation of what `_Figure.shape` holds, of rendered persons in rooms."""
_UNUSUAL, _AS_LIKELY, _STRANGE, _STRANGEST = 24.0, 28.0, 40.0, 70.0
"""Sums of squared deviations from these: what is more than the first is doubted; another figure of less than the second
may be the person; what is more than the third, or with a misfit to decide the fourth, is none."""
_MISFITS_M = (0.055, 0.08, 0.15)
"""The same of a misfit."""
_MOST_JUDGED = 5
_NO_MASK = "; give a mask of the person alone"


class Planes(NamedTuple):
    """Planes of a room.

    Attributes:
        normals: `(P, 3)`, towards the camera.
        offsets: `(P,)`, metres: a point p is on a plane where normal p = offset.
        areas_m2: `(P,)`, area seen across the line of sight.
        is_on: `(H, W)` bool, the pixels on any of them.
    """

    normals: np.ndarray
    offsets: np.ndarray
    areas_m2: np.ndarray
    is_on: np.ndarray


def tolerance_m(z: np.ndarray) -> np.ndarray:
    """How far from a plane a pixel of depth `z` may lie, metres: sensors' noise and steps grow with depth."""
    return 0.012 + 0.0025 * z**2


Misfit = Callable[[np.ndarray], float]
"""How far a depth image `(H, W)` lies from the body that is found in it, metres."""


def find_in_scene(metres: np.ndarray, camera: Camera, report: Report, misfit: Misfit | None = None) -> Person:
    """The person in a room: of what is left once all planes are gone, the figure that is most like a person.

    Args:
        metres: `(H, W)` float32, metres; 0 is nothing; something is there.
        camera: The camera of this image.
        report: Gets what was taken away, and a doubt where the choice is not clear.
        misfit: Decides between figures whose size and shape are a person's; None: these alone do.

    Raises:
        ValueError: Nothing is like a person.
    """
    planes = find_planes(metres, camera)
    figures = _figures(metres, planes.is_on, camera)
    report.note(
        planes=len(planes.offsets), on_planes=int(np.count_nonzero(planes.is_on)), figures=len(figures)
    )
    figures = [
        figure for figure in figures if figure.strangeness < (_STRANGE if misfit is None else _STRANGEST)
    ]
    figures = sorted(figures, key=lambda figure: figure.strangeness)[:_MOST_JUDGED]
    if misfit is None:
        scores, limits = [figure.strangeness for figure in figures], (_UNUSUAL, _AS_LIKELY, _STRANGE)
    else:
        scores, limits = [misfit(figure.person.depth) for figure in figures], _MISFITS_M
    best = int(np.argmin(scores)) if scores else -1
    if best < 0 or scores[best] > limits[2]:
        raise ValueError(
            f"depth: without a mask, no person was found: {len(planes.offsets)} planes (floor, walls, furniture) were "
            f"taken away, and nothing else has a person's size and shape{_NO_MASK}"
        )
    found = figures[best].person
    if misfit is not None:
        report.note(misfit_mm=round(1000 * scores[best], 1))
    v, u = np.nonzero(found.depth)
    place = f"at u = {np.median(u):.0f}, v = {np.median(v):.0f}, {np.median(found.depth[v, u]):.1f} m"
    if num_rivals := sum(score < limits[1] for score in scores) - (scores[best] < limits[1]):
        report.doubt(
            f"depth: without a mask, {1 + num_rivals} things have a person's size and shape; the likeliest was taken, "
            f"{place}{_NO_MASK}"
        )
    elif scores[best] > limits[0]:
        report.doubt(f"depth: without a mask, what was taken, {place}, is hardly like a person{_NO_MASK}")
    if figures[best].cut_m > _CUT_M:
        report.doubt(
            f"depth: without a mask, the person, {place}, had to be cut out of what it touches, and a part of it may "
            f"be lost{_NO_MASK}"
        )
    elif found.beside_m2 > _BESIDE_M2:
        report.doubt(
            f"depth: without a mask, {found.beside_m2:.2f} square metres beside the person may be a part of it and "
            f"were left out{_NO_MASK}"
        )
    return found


class _Figure(NamedTuple):
    """Something in a room.

    Attributes:
        person: Its pixels.
        shape: `(6,)`: area, its three extents along its own axes, longest first (metres), the share of its area that is
            plane, and that of the largest of these planes.
        cut_m: Length of its outline where it was cut from a plane, and no jump of the depth parts them.
    """

    person: Person
    shape: np.ndarray
    cut_m: float

    @property
    def strangeness(self) -> float:
        """The sum of the squared deviations from a person's shape."""
        return float((((self.shape - _TYPICAL[:, 0]) / _TYPICAL[:, 1]) ** 2).sum())


def _figures(metres: np.ndarray, is_on: np.ndarray, camera: Camera, level: int = 0) -> list[_Figure]:
    """The larger things that are apart from each other, without planes `(H, W)`; what is too large is parted again."""
    figures = []
    left = np.where(is_on, np.float32(0), metres)
    for _ in range(_MOST_FIGURES):
        if not left.any():
            break
        found = find_person(left, camera, _NEAR_M[level])
        if found.area_m2 < _LEAST_M2:
            break
        is_found = found.depth > 0
        left = np.where(is_found, np.float32(0), left)
        shape = _shape(found, camera)
        if level + 1 < len(_NEAR_M) and (shape > _LARGE).any():
            facets = find_planes(found.depth, camera, _PLANE_M2[level + 1])
            around = np.where(is_found | is_on, metres, np.float32(0))
            figures += _figures(around, is_on | facets.is_on, camera, level + 1)
        else:
            figures.append(_Figure(found, shape, _cut_m(metres, is_found, is_on, camera)))
    return figures


def _cut_m(metres: np.ndarray, is_found: np.ndarray, is_on: np.ndarray, camera: Camera) -> float:
    length = 0.0
    for axis, focal in ((0, camera.fy), (1, camera.fx)):
        before, after = ([slice(None)] * 2 for _ in range(2))
        before[axis], after[axis] = slice(None, -1), slice(1, None)
        first, second = tuple(before), tuple(after)
        is_cut = (is_found[first] & is_on[second]) | (is_found[second] & is_on[first])
        z = metres[first]
        length += float(z[is_cut & (np.abs(metres[second] - z) < 0.03 + 0.01 * z)].sum()) / focal
    return length


def _shape(found: Person, camera: Camera) -> np.ndarray:
    v, u = np.nonzero(found.depth)
    points = _points(found.depth, camera, u, v)[:: max(1, len(u) // 4000)]
    weight = points[:, 2:] ** 2
    centred = points - (weight * points).sum(0) / weight.sum()
    axes = np.linalg.eigh((weight * centred).T @ centred)[1][:, ::-1]
    extents = np.ptp(np.percentile(centred @ axes, [2, 98], axis=0), axis=0)
    facets = find_planes(found.depth, camera, _FACET_M2).areas_m2 / found.area_m2
    return np.array([found.area_m2, *extents, facets.sum(), facets.max(initial=0)])


def find_planes(metres: np.ndarray, camera: Camera, least_m2: float = _PLANE_M2[0]) -> Planes:
    """The planes of a depth image that are large enough, the largest first.

    Args:
        metres: `(H, W)` float32, metres; 0 is nothing.
        camera: The camera of this image.
        least_m2: Area seen of a plane, across the line of sight.
    """
    step = max(1, round(max(metres.shape) / _SIDE_PX))
    small = np.ascontiguousarray(metres[::step, ::step])
    of_small = Camera(
        camera.fx / step, camera.fy / step, camera.cx / step, camera.cy / step, *small.shape[::-1]
    )
    v, u = np.nonzero(small)
    points, pixels = _points(small, of_small, u, v), np.stack([u, v], -1)
    cloud = Cloud(points.astype(np.float32), pixels)
    surface = _Surface(points, window_normals(cloud, small, of_small, 3, 0.25).astype(np.float64))
    area = points[:, 2] ** 2 / (of_small.fx * of_small.fy)
    rng = np.random.default_rng(0)  # equal images have equal planes
    tried = _hypotheses(points, pixels, small.shape, rng)
    chosen = rng.permutation(len(points))[:_POINTS]
    fits = _Surface(*(values[chosen] for values in surface)).is_on(*tried)
    is_left = np.ones(len(points), bool)
    normals: list[np.ndarray] = []
    offsets: list[float] = []
    areas: list[float] = []
    while len(areas) < _MOST_PLANES and len(tried[1]):
        scores = (area * is_left)[chosen] @ fits * (len(points) / len(chosen))
        best = int(scores.argmax())
        if scores[best] < 0.7 * least_m2:
            break
        fits[:, best] = False
        normal, offset = _fitted(surface, is_left, tried[0][best], tried[1][best])
        on = is_left & surface.is_on(normal[None], np.array([offset]))[:, 0]
        if (size := float(area[on].sum())) >= least_m2:
            is_left &= ~on
            normals.append(normal)
            offsets.append(offset)
            areas.append(size)
    found = np.reshape(normals, (-1, 3)), np.array(offsets)
    is_seed = np.zeros(small.shape, bool)
    is_seed[v[~is_left], u[~is_left]] = True
    # At edges normals are not known: there a plane goes on as far as depth says.
    is_near = binary_dilation(is_seed, np.ones((3, 3)), 2).repeat(step, 0).repeat(step, 1)
    rows, columns = np.nonzero((metres > 0) & is_near[: metres.shape[0], : metres.shape[1]])
    seen = _points(metres, camera, columns, rows)
    on = (np.abs(seen @ found[0].T - found[1]) < tolerance_m(seen[:, 2:])).any(1)
    is_on = np.zeros(metres.shape, bool)
    is_on[rows[on], columns[on]] = True
    return Planes(*found, np.array(areas), is_on)


class _Surface(NamedTuple):
    """Points `(N, 3)`, metres, with their normals `(N, 3)`."""

    points: np.ndarray
    normals: np.ndarray

    def is_on(self, normals: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        """Whether points lie on planes, and face as they do: `(N, P)` bool."""
        is_near = np.abs(self.points @ normals.T - offsets) < tolerance_m(self.points[:, 2:])
        return is_near & (np.abs(self.normals @ normals.T) > _COSINE)


def _points(metres: np.ndarray, camera: Camera, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    z = metres[v, u].astype(np.float64)
    return np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], -1)


def _hypotheses(
    points: np.ndarray, pixels: np.ndarray, size: tuple[int, ...], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Planes `(P, 3)`, `(P,)` through three pixels that are not far from each other in the image."""
    index = np.full(size, -1)
    index[pixels[:, 1], pixels[:, 0]] = np.arange(len(pixels))
    first = rng.integers(len(points), size=_HYPOTHESES)
    reach = max(2, int(_REACH * max(size)))
    corners, is_seen = [points[first]], np.ones(_HYPOTHESES, bool)
    for _ in range(2):
        u, v = (pixels[first] + rng.integers(-reach, reach + 1, (_HYPOTHESES, 2))).T
        is_inside = (u >= 0) & (u < size[1]) & (v >= 0) & (v < size[0])
        other = np.where(is_inside, index[v.clip(0, size[0] - 1), u.clip(0, size[1] - 1)], -1)
        is_seen &= other >= 0
        corners.append(points[other])
    normals = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    length = np.linalg.norm(normals, axis=-1)
    is_seen &= length > 1e-4
    normals = normals[is_seen] / length[is_seen, None]
    offsets = (normals * corners[0][is_seen]).sum(-1)
    sign = np.where(offsets > 0, -1.0, 1.0)
    return normals * sign[:, None], offsets * sign


def _fitted(
    surface: _Surface, is_left: np.ndarray, normal: np.ndarray, offset: float
) -> tuple[np.ndarray, float]:
    """A plane fitted anew to the points on it, thrice."""
    for _ in range(3):
        on = is_left & surface.is_on(normal[None], np.array([offset]))[:, 0]
        if np.count_nonzero(on) < 3:
            break
        points = surface.points[on]
        weight = 1 / points[:, 2:] ** 2  # noise grows with the square of depth, and so does a pixel's area
        middle = (weight * points).sum(0) / weight.sum()
        normal = np.linalg.eigh((weight * (points - middle)).T @ (points - middle))[1][:, 0]
        normal = normal if normal @ middle < 0 else -normal
        offset = float(normal @ middle)
    return normal, offset
