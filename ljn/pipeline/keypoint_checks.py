"""Whether 2D keypoints and the body in a depth image belong together, and which other reading of them would.

Everything is measured in the plane that is parallel to the image, at the body's depth, in metres. The misfit is the
mean distance of the keypoints to the body's pixels, plus the mean distance of those to the bones between the
keypoints: the first grows where keypoints are off the body, the second where the body reaches out of them. The oddness
is how unlike a body the keypoints are by themselves, from the covariance of joints: some 1, whatever the pose.

`python -m tests.benchmarks.input_checks --keypoints` measures how often right keypoints are refused and wrong ones
found. Thresholds are chosen on training poses. Of 20,000 test samples (`--samples 20000`: all sensors and orders, 10
px of noise, 30 % missing), 1 in 4,000 is refused and 1 in 500 doubted, most of them hidden in part. Of those that a
mistake moves by more than 150 mm, it finds 99 % with u and v swapped, 94 % upside down, 97 % shifted by 80 px, 99 and
97 % scaled by 1.25 and 0.8, 99 % at one pixel and over 99 % in another order of 17 or 25. A check takes 0.9 ms.
"""

import math
from collections.abc import Iterator
from functools import cache
from typing import NamedTuple

import numba
import numpy as np

from ljn.body.skeleton import BONES, JOINT_NAMES, NUM_JOINTS
from ljn.cloud.observation import body_box
from ljn.geometry.camera import Camera
from ljn.pipeline.filling import conditional_misfit, fill_missing, joint_covariance, log_likelihood
from ljn.pipeline.keypoint_orders import middles_of, taken_by

MISFIT_M = 0.22
"""Keypoints of a higher misfit are refused."""
DOUBTFUL_MISFIT_M = 0.16
"""Keypoints of a higher misfit are doubted."""
ODDNESS = 1.95
"""Keypoints of a higher oddness are refused."""
DOUBTFUL_ODDNESS = 1.65
"""Keypoints of a higher oddness are doubted."""
BETTER_M = 0.03
"""Keypoints are refused, too, where another reading's misfit is less by this."""
EXPLAINED_M, EXPLAINED_SHARE = 0.06, 0.35
"""A body with less that is bare of bones, and so much of the keypoints on or near it, is cut off or hidden in part:
keypoints are doubted at the most."""
WILD = 4.5
"""A keypoint is mistrusted from this many standard deviations away from where the others expect it."""
WILD_OFF = 3.5
"""The same for one that is off the body by more than `OFF_M`."""
OFF_M = 0.3
"""See `WILD_OFF`."""
MIN_SKELETON = 8
"""With fewer known joints the others cannot be filled in well, and most is not checked."""
FEW_OFF_M = 0.3
"""Fewer than `MIN_SKELETON` keypoints are refused where they lie farther off the body, on average, ..."""
FEW_MISFIT_M = 0.28
"""... or are of a higher misfit, which is not measured of less than 4."""

_MIN_ANY_SKELETON = 4  # with fewer, nothing is measured but places on the body
_NOISE = 10 / 366.458  # of keypoints, radians: that of the training
_MISMATCH_M = 0.02  # how far the joints of an order lie from SMPL's
_BESIDE_M = 0.08  # how far keypoints lie from the joints that they are beside
_FAR_M = 0.5  # distances count up to here
_NEAR_M = 0.1  # on the body or near it, for messages
_SUSPICIOUS_M = 0.1  # with less misfit no other reading is tried
_CELLS = 64  # along the body's longer side
_MOST_WILD = 0.25  # of the known keypoints
_MARGIN_M = 0.01  # a reading that comes later has to be better by this
_FIRST_STEP_M, _NUM_STEPS = 0.15, 4  # in the search for a shift
_FACTORS = (1.25, 0.8, 2.0, 0.5, 1.5, 2 / 3, 3.0, 1 / 3, 4 / 3, 0.75, 4.0, 0.25)
_BONES = np.array(BONES)


class Body(NamedTuple):
    """What is checked against.

    Attributes:
        cells: `(M, 2)` float64, body pixels of a coarse grid, in the plane at the body's depth, metres.
        depth_m: The body's median depth.
        camera: The camera.
    """

    cells: np.ndarray
    depth_m: float
    camera: Camera

    def places(self, pixels: np.ndarray) -> np.ndarray:
        """Pixels `(..., 2)` as places in the plane, metres."""
        camera = self.camera
        return (pixels - [camera.cx, camera.cy]) * (self.depth_m / np.array([camera.fx, camera.fy]))


class Fit(NamedTuple):
    """How well keypoints fit a body; see the module.

    Attributes:
        off_m: Mean distance of the known keypoints to the body, each up to 0.5 m.
        bare_m: Mean distance of the body's pixels to the bones, likewise; 0 where too few keypoints are known.
        oddness: How unlike a body they are by themselves; 0 where too few are known.
        share: Of the known keypoints, on the body or within 0.1 m.
        is_few: Whether fewer than `MIN_SKELETON` are known.
    """

    off_m: float
    bare_m: float
    oddness: float
    share: float
    is_few: bool

    @property
    def misfit_m(self) -> float:
        """Off the body and bare of bones together."""
        return self.off_m + self.bare_m

    @property
    def is_impossible(self) -> bool:
        """Whether keypoints are refused for it."""
        if self.is_few:
            return self.off_m > FEW_OFF_M or self.misfit_m > FEW_MISFIT_M
        return (self.misfit_m > MISFIT_M and not self.is_explained) or self.oddness > ODDNESS

    @property
    def is_explained(self) -> bool:
        """Whether what does not fit are keypoints of parts that are not seen."""
        return not self.is_few and self.bare_m < EXPLAINED_M and self.share >= EXPLAINED_SHARE

    @property
    def is_doubtful(self) -> bool:
        """Whether keypoints are doubted for it."""
        if self.is_few:
            return self.off_m > FEW_OFF_M / 2
        return self.misfit_m > DOUBTFUL_MISFIT_M or self.oddness > DOUBTFUL_ODDNESS

    def __str__(self) -> str:
        words = (
            f"{100 * self.share:.0f} % of them on the body or within 0.1 m, {self.off_m:.2f} m off on average"
        )
        return f"{words}, the body {self.bare_m:.2f} m from their bones, {self.oddness:.1f} times as odd as a body's"


def seen_body(depth: np.ndarray, camera: Camera) -> Body:
    """The body of a depth image `(H, W)`, metres, 0 elsewhere, as keypoints are checked against it."""
    left, right, top, bottom = body_box(depth)
    size = max((right - left + 1) / camera.fx, (bottom - top + 1) / camera.fy)
    steps = [max(1, math.ceil(size / _CELLS * focal)) for focal in (camera.fx, camera.fy)]
    # Of a body of a few pixels, too, some are left.
    starts = [
        low + min(step // 2, (high - low) // 2)
        for low, high, step in ((left, right, steps[0]), (top, bottom, steps[1]))
    ]
    coarse = depth[starts[1] : bottom + 1 : steps[1], starts[0] : right + 1 : steps[0]]
    v, u = np.nonzero(coarse)
    if not len(u):
        coarse, starts, steps = depth[top : bottom + 1, left : right + 1], [left, top], [1, 1]
        v, u = np.nonzero(coarse)
    pixels = np.stack([starts[0] + steps[0] * u, starts[1] + steps[1] * v], -1).astype(np.float64)
    body = Body(pixels, float(np.median(coarse[v, u])), camera)
    return body._replace(cells=body.places(pixels))


def fit(positions: np.ndarray, body: Body) -> Fit:
    """How well keypoints `(24, 2)`, pixels, NaN where not known, fit a body."""
    return _fit(body.places(positions), body)[0]


def fit_without_wild(positions: np.ndarray, body: Body) -> tuple[Fit, np.ndarray]:
    """The fit of those keypoints that are to be trusted, and which are not, `(24,)`.

    They are wild: far from where all others expect them. At most a quarter of those known are; where more would be, it
    is not single keypoints that are wrong.
    """
    places, is_wild = body.places(positions), np.zeros(NUM_JOINTS, bool)
    found, off, deviations = _fit(places, body)
    for _ in range(int(_MOST_WILD * np.isfinite(places).all(1).sum())):
        excess = np.nan_to_num(deviations / np.where(off > OFF_M, WILD_OFF, WILD))
        worst = int(excess.argmax())
        if found.is_few or excess[worst] < 1:
            break
        is_wild[worst] = True
        places[worst] = np.nan
        found, off, deviations = _fit(places, body)
    return found, is_wild


def _fit(places: np.ndarray, body: Body) -> tuple[Fit, np.ndarray, np.ndarray]:
    """The fit; each place's distance to the body and deviation from where others expect it, `(24,)`, or NaN."""
    is_known = np.isfinite(places).all(1)
    distances = _to_points(places, body.cells)
    off = np.minimum(distances[is_known], _FAR_M)
    number = len(off)
    off_m, share = float(off.sum() / number), float(np.count_nonzero(off < _NEAR_M) / number)
    if number < _MIN_ANY_SKELETON:
        return Fit(off_m, 0.0, 0.0, share, True), distances, np.full(len(places), np.nan)
    filled = fill_missing(places)
    bare = np.minimum(_to_bones(body.cells, filled[_BONES[:, 0]], filled[_BONES[:, 1]]), _FAR_M)
    total, deviations = conditional_misfit(places, _noise_m(body))
    found = Fit(off_m, float(bare.mean()), math.sqrt(total), share, number < MIN_SKELETON)
    return found, distances, deviations


def likeness(table: np.ndarray, order: str, body: Body) -> float:
    """The log of how likely keypoints `(K, 2)`, pixels, NaN where not known, are in an order.

    Those that are off the body are left out, whatever the order.
    """
    known = np.flatnonzero(np.isfinite(table[:, 0]))
    places = body.places(table[known])
    is_near = _to_points(places, body.cells) < OFF_M
    known, places = known[is_near], places[is_near]
    if len(known) < 2:
        return 0.0
    is_taken = taken_by(order)[:, known].any(0)
    noise_m = np.hypot(np.where(is_taken, _MISMATCH_M, _BESIDE_M), _noise_m(body))
    return log_likelihood(places, _covariance_of(order)[np.ix_(known, known)] + np.diag(noise_m**2))


@cache
def _covariance_of(order: str) -> np.ndarray:
    middles = middles_of(order)
    return middles @ joint_covariance() @ middles.T


def is_suspicious(fit: Fit) -> bool:
    """Whether other readings are tried: none is where all is well, to save the time."""
    return fit.is_doubtful or (fit.misfit_m > _SUSPICIOUS_M and not fit.is_few)


def better_reading(positions: np.ndarray, body: Body, is_refused: bool) -> tuple[str, Fit] | None:
    """The other reading that fits best, in words and with its fit, if it fits well.

    Args:
        positions: `(24, 2)`, NaN where not known.
        body: The body.
        is_refused: Whether keypoints are refused in any case. Mirrored ones, and shifts and scales of any size, are
            then tried, too; these may fit right keypoints a little better as well.
    """
    best: tuple[str, Fit] | None = None
    for words, read in _readings(positions, body, is_refused):
        found = fit(read, body)
        if not found.is_doubtful and (best is None or found.misfit_m < best[1].misfit_m - _MARGIN_M):
            best = words, found
    return best


def _readings(p: np.ndarray, body: Body, with_any: bool) -> Iterator[tuple[str, np.ndarray]]:
    """Other readings of keypoints: words, and where they would be. The more likely mistakes come first."""
    camera = body.camera
    right, bottom = camera.width - 1, camera.height - 1
    yield "with u and v swapped", p[:, ::-1]
    yield f"with v counted from below ({bottom} - v)", np.stack([p[:, 0], bottom - p[:, 1]], 1)
    for factor in _FACTORS:
        yield f"multiplied by {factor:.3g} (as of an image of {1 / factor:.3g} times the size)", factor * p
    if not with_any:
        return
    yield f"with u counted from the right ({right} - u)", np.stack([right - p[:, 0], p[:, 1]], 1)
    corners = body.cells.min(0), body.cells.max(0)
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    low, high = (corner / body.depth_m * focal + centre for corner in corners)
    lowest, highest = np.nanmin(p, 0), np.nanmax(p, 0)
    shift = _best_shift(p, body, (low + high - lowest - highest) / 2)
    words = f"shifted by ({shift[0]:.0f}, {shift[1]:.0f}) pixels (as of a camera beside this one)"
    yield words, p + shift
    scale = (low + high) / np.maximum(lowest + highest, 1e-6)
    yield (
        f"with u and v multiplied by {scale[0]:.3g} and {scale[1]:.3g} (as of an image of another size)",
        p * scale,
    )


def _best_shift(positions: np.ndarray, body: Body, start: np.ndarray) -> np.ndarray:
    """The best shift near one, pixels, found by steps of less and less."""
    best, least = start, fit(positions + start, body).misfit_m
    step = _FIRST_STEP_M / body.depth_m * np.array([body.camera.fx, body.camera.fy])
    for _ in range(_NUM_STEPS):
        for direction in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            tried = best + step * direction
            if (misfit := fit(positions + tried, body).misfit_m) < least:
                best, least = tried, misfit
        step = step / 2
    return best


def _noise_m(body: Body) -> float:
    return math.hypot(_MISMATCH_M, _NOISE * body.depth_m)


def named(is_chosen: np.ndarray) -> list[str]:
    """The names of chosen joints `(24,)`."""
    return [JOINT_NAMES[joint] for joint in np.flatnonzero(is_chosen)]


@numba.njit(cache=True, nogil=True)
def _to_points(places: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distance of each place `(K, 2)` to the nearest of the points `(M, 2)`."""
    distances = np.empty(len(places))
    for k in range(len(places)):
        least = np.inf
        for m in range(len(points)):
            x, y = points[m, 0] - places[k, 0], points[m, 1] - places[k, 1]
            least = min(least, x * x + y * y)
        distances[k] = math.sqrt(least)
    return distances


@numba.njit(cache=True, nogil=True)
def _to_bones(points: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Distance of each point `(M, 2)` to the nearest of the bones from `starts` to `ends` `(B, 2)`."""
    distances = np.empty(len(points))
    for m in range(len(points)):
        least = np.inf
        for b in range(len(starts)):
            along_x, along_y = ends[b, 0] - starts[b, 0], ends[b, 1] - starts[b, 1]
            x, y = points[m, 0] - starts[b, 0], points[m, 1] - starts[b, 1]
            length = along_x * along_x + along_y * along_y
            share = min(1.0, max(0.0, (x * along_x + y * along_y) / length)) if length > 0 else 0.0
            x, y = x - share * along_x, y - share * along_y
            least = min(least, x * x + y * y)
        distances[m] = math.sqrt(least)
    return distances
