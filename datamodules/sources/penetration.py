"""How deep a pose's body parts reach into each other, measured on capsules fitted to a body's mesh."""

from collections.abc import Container, Iterable
from itertools import combinations
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ljn.body import BodyModel
from ljn.body.kinematics import SIDES, joint_positions
from ljn.body.skeleton import JOINT_INDEX


class _Part(NamedTuple):
    """A stretch of the body for one capsule."""

    joint: str  # the joint that moves it
    vertices_of: tuple[str, ...]  # joints whose vertices (by their largest blend weight) it covers
    towards: str  # the joint that its axis points to, or a coordinate axis of the rest frame
    begins_at: float = 0.0  # which share of its length, from the end at the joint, is left out


# The trunk is wider than deep: three capsules across, one above the other, fill it. An upper arm begins in the chest;
# only its lower half can be detected in a wrong place.
_PARTS = {
    "pelvis": _Part("pelvis", ("pelvis",), "x"),
    "waist": _Part("spine1", ("spine1",), "x"),
    "ribs": _Part("spine2", ("spine2",), "x"),
    "chest": _Part("spine3", ("spine3",), "x"),
    "head": _Part("head", ("head",), "y"),
}
for _s in SIDES:
    _PARTS |= {
        f"{_s}_upper_arm": _Part(f"{_s}_shoulder", (f"{_s}_shoulder",), f"{_s}_elbow", 0.5),
        f"{_s}_forearm": _Part(f"{_s}_elbow", (f"{_s}_elbow",), f"{_s}_wrist"),
        f"{_s}_hand": _Part(f"{_s}_wrist", (f"{_s}_wrist", f"{_s}_hand"), f"{_s}_hand"),
        f"{_s}_thigh": _Part(f"{_s}_hip", (f"{_s}_hip",), f"{_s}_knee"),
        f"{_s}_shin": _Part(f"{_s}_knee", (f"{_s}_knee",), f"{_s}_ankle"),
        f"{_s}_foot": _Part(f"{_s}_ankle", (f"{_s}_ankle", f"{_s}_foot"), f"{_s}_foot"),
    }

_MAY_TOUCH = (
    set(combinations(("pelvis", "waist", "ribs", "chest"), 2))
    | {("chest", "head")}
    | {
        (f"{side}{one}", f"{side}{other}")
        for one, other in (("upper_arm", "forearm"), ("forearm", "hand"), ("thigh", "shin"), ("shin", "foot"))
        for side in ("l_", "r_")
    }
)
_MAY_TOUCH |= {("pelvis", f"{side}_thigh") for side in SIDES}
_MAY_TOUCH |= {("ribs", f"{side}_upper_arm") for side in SIDES}  # a hanging arm presses into the flank


class Capsules(NamedTuple):
    """Capsules that move with joints."""

    names: tuple[str, ...]  # `(P,)`
    joints: Tensor  # `(P, 2)` long, the joints that move the two ends of each axis
    ends: Tensor  # `(P, 2, 3)`, metres, the ends relative to these joints, rest frame
    radii: Tensor  # `(P,)`, metres
    pairs: Tensor  # `(2, Q)` long, the pairs of capsules that should not meet


def fit_capsules(body: BodyModel) -> Capsules:
    """Capsules of a body's mean shape.

    A capsule's axis runs through the middle of its vertices; its radius is their median distance from it, and its
    caps end where they end.
    """
    joints = body.J_regressor.astype(np.float64) @ body.v_template.astype(np.float64)
    owner = body.weights.argmax(1)
    ends, radii = [], []
    for part in _PARTS.values():
        origin = joints[JOINT_INDEX[part.joint]]
        if part.towards in ("x", "y", "z"):
            axis = np.eye(3)["xyz".index(part.towards)]
        else:
            axis = joints[JOINT_INDEX[part.towards]] - origin
            axis = axis / np.linalg.norm(axis)
        is_part = np.isin(owner, [JOINT_INDEX[name] for name in part.vertices_of])
        vertices = body.v_template[is_part].astype(np.float64) - origin
        along = vertices @ axis
        along_from = along.min() + part.begins_at * np.ptp(along)
        vertices, along = vertices[along >= along_from], along[along >= along_from]
        around = vertices - along[:, None] * axis
        centre = (around.min(0) + around.max(0)) / 2
        radius = np.median(np.linalg.norm(around - centre, axis=1))
        middle = (along.min() + along.max()) / 2
        half = max(np.ptp(along) / 2 - radius, 0.0)
        ends.append([centre + (middle - half) * axis, centre + (middle + half) * axis])
        radii.append(radius)

    moved_by = [[JOINT_INDEX[part.joint]] * 2 for part in _PARTS.values()]
    return Capsules(
        names=tuple(_PARTS),
        joints=torch.tensor(moved_by),
        ends=torch.from_numpy(np.array(ends)),
        radii=torch.tensor(radii, dtype=torch.float64),
        pairs=tested_pairs(_PARTS, _MAY_TOUCH),
    )


def tested_pairs(names: Iterable[str], may_touch: Container[tuple[str, str]]) -> Tensor:
    """All pairs of capsules but those that `may_touch` names, earlier one first: `(2, Q)` long."""
    pairs = combinations(enumerate(names), 2)
    return torch.tensor([(i, j) for (i, one), (j, other) in pairs if (one, other) not in may_touch]).T


def penetration(world: Tensor, offsets: Tensor, capsules: Capsules) -> Tensor:
    """How far the two capsules of each pair reach into each other.

    Args:
        world: `(n, 24, 3, 3)`; see `world_rotations`.
        offsets: `(24, 3)`, metres, the skeleton; see `joint_offsets`.
        capsules: Capsules on that skeleton.

    Returns:
        `(n, Q)`, metres; below zero they are apart.
    """
    moved = (world[:, capsules.joints] * capsules.ends[..., None, :]).sum(-1)  # (n, P, 2, 3)
    ends = joint_positions(world, offsets)[:, capsules.joints] + moved
    start, end = ends.permute(2, 3, 0, 1)  # (3, n, P) each: coordinates outermost take half the time
    one, other = capsules.pairs
    distance = segment_distance(start[..., one], end[..., one], start[..., other], end[..., other])
    return capsules.radii[capsules.pairs].sum(0) - distance


def segment_distance(start: Tensor, end: Tensor, other_start: Tensor, other_end: Tensor) -> Tensor:
    """Distances `(...)` between segments with the given ends, `(3, ...)` each.

    Ericson, *Real-Time Collision Detection* (2005), section 5.1.9, in a form that a segment of length zero or a pair
    of parallel ones does not break.
    """
    tiny = 1e-12  # square metres: far below any capsule's length
    one, other, between = end - start, other_end - other_start, start - other_start
    a, e, b = _dot(one, one), _dot(other, other), _dot(one, other)
    c, f = _dot(one, between), _dot(other, between)
    s = ((b * f - c * e) / (a * e - b * b).clamp(min=tiny)).clamp(0, 1)
    t = ((b * s + f) / e.clamp(min=tiny)).clamp(0, 1)
    s = ((b * t - c) / a.clamp(min=tiny)).clamp(0, 1)
    across = between + s * one - t * other
    return _dot(across, across).sqrt()


def _dot(one: Tensor, other: Tensor) -> Tensor:
    """Dot products of vectors `(3, ...)`; much faster than a sum over the short dimension."""
    return torch.addcmul(torch.addcmul(one[0] * other[0], one[1], other[1]), one[2], other[2])
