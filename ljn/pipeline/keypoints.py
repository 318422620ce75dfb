"""2D keypoints as detectors give them, turned into those of the 24 SMPL joints; those that are missing are filled in.

A joint that an order does not have, or that was not seen, is predicted from the known ones: the linear combination,
with weights that sum to one, whose expected error over the embedded training poses is least. It depends on the joints'
covariance alone, turns and scales with the body, and keeps left and right apart only as far as the known joints do.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ljn.body.skeleton import JOINT_INDEX, JOINT_NAMES, NUM_JOINTS
from ljn.geometry.camera import Camera
from ljn.reading import brief, reason, shown

MIN_CONFIDENCE = 0.2
"""Keypoints of a lower confidence count as missing."""
MIN_KNOWN = 8
"""Joints that must be known. From 8 of COCO's the others are filled in with a mean error of 15 px where the body is
some 300 px tall; `tests/benchmarks/keypoint_filling.py` measures this and makes the covariance."""
KEYPOINT_NOISE_M = 0.03
"""What is expected of the known keypoints' errors on the body, standard deviation: keeps the weights moderate."""
COVARIANCE_PATH = Path(__file__).parent / "data" / "joint_covariance.npz"

_OUTSIDE = 0.05  # how far beyond the image a keypoint may lie, of the image's longer side
_AROUND = 0.1  # the same around the body's box


class Order(NamedTuple):
    """A set of keypoints as detectors give it."""

    names: tuple[str, ...]  # its keypoints, in order
    # for each SMPL joint that can be taken from it, from which: the mean of those known. All others are filled in.
    joints: Mapping[str, tuple[str, ...]]


# The same places as SMPL's, but for hips, which are annotated near the skin, often higher and farther out than the
# joint's centre. Heads, between the ears, are some 3 cm higher than SMPL's joint, where the skull turns; feet, between
# big and small toe, some 4 cm before SMPL's, the ball of the foot.
_LIMBS = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")

ORDERS: Mapping[str, Order] = {
    "smpl24": Order(JOINT_NAMES, {name: (name,) for name in JOINT_NAMES}),
    "coco17": Order(
        (
            "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder",
            "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee",
            "right_knee", "left_ankle", "right_ankle",
        ),
        {
            "head": ("left_ear", "right_ear"),
            **{f"{side[0]}_{joint}": (f"{side}_{joint}",) for side in ("left", "right") for joint in _LIMBS},
        },
    ),
    # OpenPose's Neck and MidHip are means of its shoulders and hips, and add nothing to them.
    "body25": Order(
        (
            "Nose", "Neck", "RShoulder", "RElbow", "RWrist", "LShoulder", "LElbow", "LWrist", "MidHip", "RHip",
            "RKnee", "RAnkle", "LHip", "LKnee", "LAnkle", "REye", "LEye", "REar", "LEar", "LBigToe", "LSmallToe",
            "LHeel", "RBigToe", "RSmallToe", "RHeel",
        ),
        {
            "head": ("LEar", "REar"),
            "l_foot": ("LBigToe", "LSmallToe"),
            "r_foot": ("RBigToe", "RSmallToe"),
            **{f"{side.lower()}_{joint}": (f"{side}{joint.capitalize()}",) for side in "LR" for joint in _LIMBS},
        },
    ),
}  # fmt: skip
"""The orders by name: SMPL's 24 joints, COCO's 17 keypoints, OpenPose's BODY-25."""


class Keypoints(NamedTuple):
    """2D keypoints of the 24 SMPL joints.

    Attributes:
        positions: `(24, 2)` float32, u and v, pixels.
        confidences: `(24,)` float32 as they came, 1 where none came; 0 where a joint is filled in.
    """

    positions: np.ndarray
    confidences: np.ndarray


def smpl_keypoints(keypoints: Any, min_known: int = MIN_KNOWN) -> Keypoints:
    """The 24 SMPL joints' keypoints from any order's.

    A keypoint is missing where it is None, NaN or (0, 0), or its confidence is under `MIN_CONFIDENCE`.

    Args:
        keypoints: 24, 17 or 25 of `[u, v]` or `[u, v, confidence]`, pixels, in an order of `ORDERS`; a mapping from
            an order's names to such entries; `{"order": name, "keypoints": entries}`; or what OpenPose writes, with
            one person.
        min_known: The fewest joints that have to be known.

    Raises:
        ValueError: Not one of these, or fewer joints are known.
    """
    name, table = _parse(keypoints)
    order = ORDERS[name]
    positions, confidences = np.full((NUM_JOINTS, 2), np.nan), np.zeros(NUM_JOINTS)
    is_known = np.isfinite(table).all(1) & (table[:, 2] >= MIN_CONFIDENCE) & table[:, :2].any(1)
    for joint, names in order.joints.items():
        rows = [row for row in map(order.names.index, names) if is_known[row]]
        if rows:
            positions[JOINT_INDEX[joint]] = table[rows, :2].mean(0)
            confidences[JOINT_INDEX[joint]] = table[rows, 2].min()
    if (num_known := np.count_nonzero(confidences)) < min_known:
        raise ValueError(
            f"keypoints: {num_known} joints are known, expected at least {min_known} of the {len(order.joints)} that "
            f"{name} gives: keypoints that are null, NaN, (0, 0) or of a confidence under {MIN_CONFIDENCE} do not "
            "count"
        )
    return Keypoints(fill_missing(positions).astype(np.float32), confidences.astype(np.float32))


def fill_missing(positions: np.ndarray) -> np.ndarray:
    """Positions `(24, 2)` whose NaN rows are predicted from the others, which stay as they are."""
    is_known = np.isfinite(positions).all(1)
    filled = positions.copy()
    filled[~is_known] = _weights(tuple(is_known.tolist())) @ positions[is_known]
    return filled


@cache
def _covariance() -> np.ndarray:
    with np.load(COVARIANCE_PATH) as arrays:
        return arrays["covariance"].astype(np.float64)


@cache
def _weights(is_known: tuple[bool, ...]) -> np.ndarray:
    """Of each known joint in each missing one, `(missing, known)`; rows sum to one."""
    known, missing = np.flatnonzero(is_known), np.flatnonzero(~np.array(is_known))
    covariance, size = _covariance(), len(known)
    # Least squares with a Lagrange multiplier for the sum: best linear prediction with an unknown mean.
    system = np.ones((size + 1, size + 1))
    system[:size, :size] = covariance[np.ix_(known, known)] + KEYPOINT_NOISE_M**2 * np.eye(size)
    system[size, size] = 0
    target = np.ones((size + 1, len(missing)))
    target[:size] = covariance[np.ix_(known, missing)]
    return np.linalg.solve(system, target)[:size].T


def check_place(keypoints: Keypoints, depth: np.ndarray, camera: Camera) -> None:
    """Raise a `ValueError` unless the known keypoints lie in the image `(H, W)`, and most of them on the body."""
    is_known = keypoints.confidences > 0
    known = keypoints.positions[is_known]
    size = np.array([camera.width, camera.height])
    if (known >= 0).all() and (known <= 2).all():
        raise ValueError(
            "keypoints: expected pixels, but all lie between 0 and 2; if they are shares of the image's size, multiply "
            f"u by {camera.width} and v by {camera.height}"
        )
    reach = _OUTSIDE * size.max()
    is_outside = ((known < -reach) | (known > size - 1 + reach)).any(1)
    if is_outside.any():
        joint = np.flatnonzero(is_known)[is_outside][0]
        u, v = keypoints.positions[joint]
        raise ValueError(
            f"keypoints: {np.count_nonzero(is_outside)} of {len(known)} lie outside the image of {camera.width} x "
            f"{camera.height} (width x height) pixels, the first is {JOINT_NAMES[joint]} at ({u:.0f}, {v:.0f}); are "
            "they of an image of another size? Set those that are not seen to NaN"
        )
    v, u = np.nonzero(depth)
    reach = _AROUND * max(np.ptp(u), np.ptp(v))
    low, high = np.array([u.min(), v.min()]) - reach, np.array([u.max(), v.max()]) + reach
    num_inside = np.count_nonzero(((known >= low) & (known <= high)).all(1))
    if num_inside < len(known) / 2:
        raise ValueError(
            f"keypoints: only {num_inside} of {len(known)} lie near the body, which is between (u, v) = ({u.min()}, "
            f"{v.min()}) and ({u.max()}, {v.max()}); are u and v swapped, or are they of another image, another "
            "person, or an image of another size?"
        )


def _parse(keypoints: Any) -> tuple[str, np.ndarray]:
    """Name of the order and `(K, 3)`: u, v, confidence; NaN where missing."""
    if not isinstance(keypoints, Mapping):
        return _parse_entries(keypoints, None)
    if "keypoints" in keypoints:
        return _parse_entries(keypoints["keypoints"], keypoints.get("order"))
    if "people" in keypoints:
        return _parse_entries(_only_person(keypoints["people"]), "body25")
    for name, order in ORDERS.items():
        if keypoints and keypoints.keys() <= set(order.names):
            return _parse_entries([keypoints.get(entry) for entry in order.names], name)
    given = set(map(str, keypoints))
    nearest = max(ORDERS, key=lambda name: len(given & set(ORDERS[name].names)))
    unknown = brief(", ".join(sorted(given - set(ORDERS[nearest].names)))) or "none at all"
    raise ValueError(
        f"keypoints: the names belong to no one order of {', '.join(ORDERS)}; not in {nearest}: {unknown}. Its names: "
        f"{', '.join(ORDERS[nearest].names)}"
    )


def _only_person(people: Any) -> np.ndarray:
    """`(K, 3)` of OpenPose's `people`."""
    is_list = isinstance(people, Sequence) and not isinstance(people, str)
    if not is_list or len(people) != 1:
        got = len(people) if is_list else shown(people)
        raise ValueError(
            f"keypoints: expected one person in OpenPose's file, got {got}; keep the one that the depth image shows"
        )
    (person,) = people
    flat = person.get("pose_keypoints_2d") if isinstance(person, Mapping) else None
    try:
        return np.asarray(flat, np.float64).reshape(-1, 3)
    except (TypeError, ValueError, OverflowError) as error:
        got = "none" if flat is None else f"others ({reason(error)})"
        raise ValueError(
            "keypoints: expected u, v and confidence of each keypoint, one after another, under 'pose_keypoints_2d' of "
            f"OpenPose's person, got {got}; have OpenPose write the file again, with its model BODY_25"
        ) from error


def _parse_entries(entries: Any, name: Any) -> tuple[str, np.ndarray]:
    if name is not None and not (isinstance(name, str) and name in ORDERS):
        raise ValueError(
            f"keypoints: expected an order of {', '.join(ORDERS)}, got {shown(name)}; give one of these names, or "
            "leave the order out"
        )
    try:
        table = np.array([_entry(entry) for entry in entries], np.float64).reshape(-1, 3)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(
            f"keypoints: expected [u, v] or [u, v, confidence] for each, in pixels, or null ({reason(error)})"
        ) from error
    by_size = {len(order.names): known for known, order in ORDERS.items()}
    name = name or by_size.get(len(table))
    if name is None or len(table) != len(ORDERS[name].names):
        expected = ", ".join(f"{len(order.names)} ({known})" for known, order in ORDERS.items())
        raise ValueError(
            f"keypoints: expected {expected} of them, got {len(table)}"
            + (f" with the order {name}" if name else "")
            + "; give those that are missing as null"
        )
    return name, table


def _entry(entry: Any) -> list[float]:
    """`[u, v, confidence]` of one keypoint."""
    if entry is None:
        return [np.nan, np.nan, 0]
    if isinstance(entry, str):
        raise TypeError(f"got the text {shown(entry)}")
    values = [np.nan if value is None else float(value) for value in entry]
    if len(values) not in (2, 3):
        raise ValueError(f"got {len(values)} numbers: {shown(values)}")
    return values if len(values) == 3 else [*values, 1]
