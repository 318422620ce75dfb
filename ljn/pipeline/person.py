"""The person's own pixels in a depth image: what hangs together in space, without what masks and sensors add."""

from typing import NamedTuple

import numba
import numpy as np
from scipy.spatial import cKDTree

from ljn.geometry.camera import Camera

JUMP_M, JUMP_SHARE = 0.05, 0.02
"""Neighbours whose depth differs by more than the first, and this share of it (a structured-light sensor's steps),
belong to different pieces."""
NEAR_M = 0.8
"""A piece this near to the person belongs to it: a limb before or behind the trunk."""
APART_M = 0.2
"""No gap is so wide between the parts of a person whom nothing hides."""
RIM_M, THIN_M, LONG_M, BESIDE = 0.25, 0.12, 1.0, 0.45
"""A rim of the background, left by a mask too wide: pieces behind what is beside them, nowhere thicker than the second,
together longer than the third, and each by itself half as long or farther than the first from the person. Of their
outline more than the last is beside other pieces, as half of a rim's is: a limb, which is long and thin, too, is beside
them only where it begins."""
SPECK_M2, STRAY_M = 0.0005, 0.2
"""A piece smaller than the first and farther than the second from the person is a flying pixel.

All of these are chosen so that rendered bodies, behind any sensor, lose nothing that a detector would miss."""
_SAMPLE, _OF_PIECE = 1500, 12


class Pieces(NamedTuple):
    """The pieces of a depth image: pixels that hang together.

    Attributes:
        labels: `(H, W)` int32, the piece of each pixel from 0; -1 where nothing is measured.
        area_m2: `(P,)`, seen area across the line of sight, square metres.
        pixels: `(P,)`, number of pixels.
        thickness_m: `(P,)`, the greatest thickness in the image, at its depth.
        is_behind: `(P,)`, share of the pixels at its rim, beside other pieces, that are behind those.
        is_beside: `(P,)`, share of its rim that is beside other pieces, and not beside nothing.
    """

    labels: np.ndarray
    area_m2: np.ndarray
    pixels: np.ndarray
    thickness_m: np.ndarray
    is_behind: np.ndarray
    is_beside: np.ndarray


def pieces_of(metres: np.ndarray, camera: Camera) -> Pieces:
    """The pieces of a depth image `(H, W)` float32, metres; 0 is nothing."""
    labels, number = _label(metres, JUMP_M, JUMP_SHARE)
    pixels, z, area, thickness, *shares = _measure(metres, labels, number)
    return Pieces(labels, area / (camera.fx * camera.fy), pixels, thickness * z / pixels / camera.fx, *shares)


def jumps_share(metres: np.ndarray) -> float:
    """The share of a depth image's neighbours, one beside the other, whose depth jumps; 0 of fewer than 50 pairs."""
    left, right = metres[:, :-1], metres[:, 1:]
    is_pair = (left > 0) & (right > 0)
    number = np.count_nonzero(is_pair)
    jumps = is_pair & (np.abs(right - left) > JUMP_M + JUMP_SHARE * left)
    return np.count_nonzero(jumps) / number if number >= 50 else 0.0


class Person(NamedTuple):
    """The person in a depth image.

    Attributes:
        depth: `(H, W)` float32, metres; 0 is background.
        area_m2: Its area, seen across the line of sight.
        apart_m2: Area of the largest piece of it that is apart from the rest by more than `APART_M`; 0 without one.
        foreign_m2: Area of what is too far from it in space to be a part.
        beside_m2: Of that, the area that is nearer to it than twice the distance within which pieces belong together.
        num_foreign: Pixels of what is too far.
        num_rim: Pixels of a rim of the background, left by a mask too wide.
        num_flying: Flying pixels.
    """

    depth: np.ndarray
    area_m2: float
    apart_m2: float
    foreign_m2: float
    beside_m2: float
    num_foreign: int
    num_rim: int
    num_flying: int


def find_person(metres: np.ndarray, camera: Camera, near_m: float = NEAR_M) -> Person:
    """The largest piece of a depth image and all that is near it in space, without rims and flying pixels.

    Args:
        metres: `(H, W)` float32, metres; 0 is nothing; something is there.
        camera: The camera of this image.
        near_m: Pieces nearer than this belong together.
    """
    pieces = pieces_of(metres, camera)
    number = len(pieces.pixels)
    # A wide rim of a background far behind may have a larger area.
    first = int((pieces.area_m2 * np.minimum(pieces.thickness_m, 0.15) * (1.05 - pieces.is_behind)).argmax())
    v, u = np.nonzero(metres)
    z = metres[v, u].astype(np.float64)
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], -1)
    of = pieces.labels[v, u]
    order = np.argsort(of, kind="stable")
    ends = np.cumsum(pieces.pixels)
    samples = [
        order[start:stop][:: max(1, (stop - start) // _OF_PIECE)]
        for start, stop in zip(ends - pieces.pixels, ends)
    ]
    is_person = np.zeros(number, bool)
    is_person[first] = True
    distance = np.full(number, np.inf)
    is_rim, is_flying = np.zeros(number, bool), np.zeros(number, bool)
    is_like_rim = (pieces.thickness_m < THIN_M) & (pieces.is_behind > 0.5) & (pieces.is_beside > BESIDE)
    length_m = pieces.area_m2 / pieces.thickness_m
    fresh = [first]
    while fresh:
        chosen = np.concatenate([order[ends[i] - pieces.pixels[i] : ends[i]] for i in fresh])
        tree = cKDTree(points[chosen[:: max(1, len(chosen) // _SAMPLE)]])
        others = np.flatnonzero(~is_person)
        if not len(others):
            break
        rows = np.concatenate([samples[i] for i in others])
        nearest = tree.query(points[rows])[0]
        starts = np.cumsum([0, *(len(samples[i]) for i in others[:-1])])
        distance[others] = np.minimum(distance[others], np.minimum.reduceat(nearest, starts))
        is_rim = ~is_person & is_like_rim & ((distance > RIM_M) | (length_m > LONG_M / 2))
        is_rim &= length_m[is_rim].sum() > LONG_M
        is_flying = (pieces.area_m2 < SPECK_M2) & (distance > STRAY_M)
        joins = ~is_person & (distance < near_m) & ~is_rim & ~is_flying
        fresh = np.flatnonzero(joins).tolist()
        is_person |= joins
    depth = np.where(np.append(is_person, False)[pieces.labels], metres, np.float32(0))
    is_foreign = ~is_person & ~is_rim & ~is_flying
    return Person(
        depth,
        float(pieces.area_m2[is_person].sum()),
        float(pieces.area_m2[is_person & np.isfinite(distance) & (distance > APART_M)].max(initial=0)),
        float(pieces.area_m2[is_foreign].sum()),
        float(pieces.area_m2[is_foreign & (distance < 2 * near_m)].sum()),
        int(pieces.pixels[is_foreign].sum()),
        int(pieces.pixels[~is_person & is_rim].sum()),
        int(pieces.pixels[~is_person & is_flying & ~is_rim].sum()),
    )


@numba.njit(cache=True, nogil=True)
def _find(parents: np.ndarray, i: int) -> int:
    while parents[i] != i:
        parents[i] = parents[parents[i]]
        i = parents[i]
    return i


@numba.njit(cache=True, nogil=True)
def _label(metres: np.ndarray, jump: float, share: float) -> tuple[np.ndarray, int]:
    """Pieces by their numbers, `(H, W)`, and how many; of eight neighbours."""
    height, width = metres.shape
    labels = np.full((height, width), -1, np.int32)
    parents = np.empty(height * width, np.int32)  # in noise every pixel may begin a piece
    number = 0
    for v in range(height):
        for u in range(width):
            z = metres[v, u]
            if z <= 0.0:
                continue
            limit = jump + share * z
            label = -1
            for dv, du in ((0, -1), (-1, -1), (-1, 0), (-1, 1)):
                row, column = v + dv, u + du
                if row < 0 or column < 0 or column >= width:
                    continue
                other = labels[row, column]
                if other >= 0 and abs(metres[row, column] - z) <= limit:
                    root = _find(parents, other)
                    if label < 0:
                        label = root
                    elif root != label:
                        low, high = min(root, label), max(root, label)
                        parents[high] = low
                        label = low
            if label < 0:
                label = number
                parents[number] = number
                number += 1
            labels[v, u] = label
    names = np.full(number, -1, np.int32)
    count = 0
    for i in range(number):
        if parents[i] == i:
            names[i] = count
            count += 1
    for v in range(height):
        for u in range(width):
            if labels[v, u] >= 0:
                labels[v, u] = names[_find(parents, labels[v, u])]
    return labels, count


@numba.njit(cache=True, nogil=True)
def _measure(
    metres: np.ndarray, labels: np.ndarray, number: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of each piece: pixels, sums of depth and of its square, thickness in pixels, shares: see `Pieces`."""
    height, width = metres.shape
    pixels, z_sum, area = np.zeros(number, np.int64), np.zeros(number), np.zeros(number)
    thickness, rim, behind, bare = np.zeros(number), np.zeros(number), np.zeros(number), np.zeros(number)
    # Steps to the nearest pixel of another piece or of nothing, by two passes over the eight neighbours.
    inside = np.zeros((height + 2, width + 2), np.int32)
    for v in range(height):
        for u in range(width):
            label = labels[v, u]
            if label < 0:
                continue
            z = float(metres[v, u])
            pixels[label] += 1
            z_sum[label] += z
            area[label] += z * z
            nearest = 1 << 20
            for dv, du in ((0, -1), (-1, -1), (-1, 0), (-1, 1)):
                row, column = v + dv, u + du
                is_seen = row >= 0 and 0 <= column < width
                is_same = is_seen and labels[row, column] == label
                nearest = min(nearest, inside[row + 1, column + 1] if is_same else 0)
                if is_seen and labels[row, column] < 0:
                    bare[label] += 1
            inside[v + 1, u + 1] = nearest + 1
    for v in range(height - 1, -1, -1):
        for u in range(width - 1, -1, -1):
            label = labels[v, u]
            if label < 0:
                continue
            nearest = inside[v + 1, u + 1] - 1
            for dv, du in ((0, 1), (1, -1), (1, 0), (1, 1)):
                row, column = v + dv, u + du
                is_seen = row < height and 0 <= column < width
                is_same = is_seen and labels[row, column] == label
                nearest = min(nearest, inside[row + 1, column + 1] if is_same else 0)
                if is_seen and labels[row, column] < 0:
                    bare[label] += 1
                elif is_seen and not is_same:
                    other = labels[row, column]
                    rim[label] += 1
                    rim[other] += 1
                    if metres[v, u] > metres[row, column]:
                        behind[label] += 1
                    else:
                        behind[other] += 1
            inside[v + 1, u + 1] = nearest + 1
            thickness[label] = max(thickness[label], 2.0 * nearest + 1.0)
    for label in range(number):
        if rim[label] > 0:
            behind[label] /= rim[label]
            rim[label] /= rim[label] + bare[label]
    return pixels, z_sum, area, thickness, behind, rim
