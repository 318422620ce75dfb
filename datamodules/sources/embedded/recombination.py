"""New poses from given ones: frames jittered, or legs, trunk and arms of different donors put together."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ljn.body.kinematics import SIDES, mirror, without_heading
from ljn.body.skeleton import JOINT_INDEX, NUM_JOINTS, ROOT
from ljn.geometry.rotations import interpolate_rotmat, rotvec_to_rotmat

TRUNK = tuple(JOINT_INDEX[name] for name in ("spine1", "spine2", "spine3", "neck", "head"))
LEFT_ARM, RIGHT_ARM = (
    tuple(JOINT_INDEX[f"{side}_{name}"] for name in ("collar", "shoulder", "elbow", "wrist", "hand"))
    for side in SIDES
)
"""The parts that are exchanged: trunk with the head, arms with the collars; what is left are the legs."""


class Donors(NamedTuple):
    """Poses to take from."""

    rotmat: Tensor  # `(M, 24, 3, 3)`, headings dropped
    name: np.ndarray  # `(M,)` str, where each comes from
    frame: np.ndarray  # `(M,)` int64, its frame there, -1 where there are no frames
    weight: np.ndarray  # `(M,)`, how often each is taken, summing to 1

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """`n` rows by their weights."""
        edges = np.cumsum(self.weight)
        return np.searchsorted(edges[:-1], rng.random(n), side="right")


class Made(NamedTuple):
    """Poses made from donors."""

    rotmat: Tensor  # `(n, 24, 3, 3)`
    name: np.ndarray  # `(n,)` str, the donors' names
    frame: np.ndarray  # `(n,)` int64, frame of the legs' donor


def clip_donors(rotmat: Tensor, clip: np.ndarray) -> Donors:
    """The frames of clips and their mirror images as donors.

    A clip comes with the square root of its length as its weight: a long clip has more to show, but not in proportion.

    Args:
        rotmat: `(M, 24, 3, 3)`.
        clip: `(M,)` str, each frame's clip, frames in order.
    """
    names, number, counts = np.unique(clip, return_inverse=True, return_counts=True)
    frame = np.empty(len(clip), np.int64)
    for index in range(len(names)):
        frame[number == index] = np.arange(counts[index])
    weight = 1 / np.sqrt(counts[number])
    both = torch.cat([rotmat, mirror(rotmat)])
    both[:, ROOT] = without_heading(both[:, ROOT])
    return Donors(both, np.tile(clip, 2), np.tile(frame, 2), np.tile(weight, 2) / (2 * weight.sum()))


def whole_poses(donors: Donors, rng: np.random.Generator, n: int) -> Made:
    """Donors' poses as they are."""
    rows = donors.draw(rng, n)
    return Made(donors.rotmat[rows], donors.name[rows], donors.frame[rows])


def swapped_poses(
    donors: tuple[Donors, ...], blend_share: float, apart_share: float, rng: np.random.Generator, n: int
) -> Made:
    """Poses whose legs, trunk and arms come from different donors; the pelvis' pitch and roll come with the legs.

    Each part's donor comes from a random one of the tables. A share of the trunks and of the arms is blended: one
    random amount leads every joint from the first donor's rotation to the second's. A share of the poses has arms that
    are apart, of a donor each. Names are "legs|trunk|arms" or "legs|trunk|left arm|right arm", with "first+second" for
    a blended part.
    """
    legs, trunk, left, right = (_draw_from(donors, rng, n) for _ in range(4))
    left, trunk = (_blended(part, _draw_from(donors, rng, n), blend_share, rng) for part in (left, trunk))
    is_apart = rng.random(n) < apart_share
    rotmat = legs.rotmat.clone()
    rotmat[:, list(TRUNK)] = trunk.rotmat[:, list(TRUNK)]
    rotmat[:, list(LEFT_ARM)] = left.rotmat[:, list(LEFT_ARM)]
    arms = torch.where(torch.from_numpy(is_apart)[:, None, None, None], right.rotmat, left.rotmat)
    rotmat[:, list(RIGHT_ARM)] = arms[:, list(RIGHT_ARM)]
    parts = zip(legs.name, trunk.name, left.name, right.name)
    names = ["|".join(names if apart else names[:3]) for names, apart in zip(parts, is_apart)]
    return Made(rotmat, np.array(names), legs.frame)


def _blended(one: Made, other: Made, share: float, rng: np.random.Generator) -> Made:
    """Poses of which a `share` is interpolated, by a random amount, towards others."""
    rows = np.flatnonzero(rng.random(len(one.name)) < share)
    amount = torch.from_numpy(rng.random(len(rows)))[:, None]
    rotmat, name = one.rotmat.clone(), one.name.astype(object)
    rotmat[rows] = interpolate_rotmat(one.rotmat[rows], other.rotmat[rows], amount)
    name[rows] += "+" + other.name[rows].astype(object)
    return Made(rotmat, name, one.frame)


def _draw_from(tables: tuple[Donors, ...], rng: np.random.Generator, n: int) -> Made:
    """`n` donors, each from a random table."""
    which = rng.integers(len(tables), size=n)
    result = whole_poses(tables[0], rng, n)
    for index, table in enumerate(tables[1:], 1):
        made, is_from = whole_poses(table, rng, n), which == index
        rotmat = torch.where(torch.from_numpy(is_from)[:, None, None, None], made.rotmat, result.rotmat)
        name, frame = np.where(is_from, made.name, result.name), np.where(is_from, made.frame, result.frame)
        result = Made(rotmat, name, frame)
    return result


# Jitter about each axis relative to the setting: little about a hinge's other axes, none on the root.
_JITTER = np.ones((NUM_JOINTS, 3))
_JITTER[ROOT] = 0.0
for _side in SIDES:
    _JITTER[JOINT_INDEX[f"{_side}_knee"]] = (1.0, 0.4, 0.4)
    _JITTER[JOINT_INDEX[f"{_side}_elbow"]] = (0.5, 1.0, 0.5)


def jittered(rotmat: Tensor, jitter_deg: float, rng: np.random.Generator) -> Tensor:
    """Poses `(n, 24, 3, 3)` with every joint but the root turned by a standard deviation about each axis, degrees.

    By half of that and less about the axes that a knee or an elbow does not bend about.
    """
    turn = np.deg2rad(jitter_deg) * _JITTER * rng.standard_normal((len(rotmat), NUM_JOINTS, 3))
    return rotmat @ rotvec_to_rotmat(torch.from_numpy(turn))
