"""The orders in which detectors give 2D keypoints, and which of the 24 SMPL joints each of them gives."""

from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

import numpy as np

from ljn.body.skeleton import JOINT_NAMES


class Order(NamedTuple):
    """A set of keypoints as detectors give it."""

    names: tuple[str, ...]  # its keypoints, in order
    # for each SMPL joint that can be taken from it, from which: the mean of those known. All others are filled in.
    joints: Mapping[str, tuple[str, ...]]
    title: str  # for messages
    # of each of its other keypoints, the joints in whose middle it lies, more or less: tells orders apart
    beside: Mapping[str, tuple[str, ...]]


# The same places as SMPL's, but for hips, which are annotated near the skin, often higher and farther out than the
# joint's centre. Heads, between the ears, are some 3 cm higher than SMPL's joint, where the skull turns; feet, between
# big and small toe, some 4 cm before SMPL's, the ball of the foot.
_LIMBS = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
_SIDES = ("left", "right")


def _limbs(form: str, *joints: str) -> dict[str, tuple[str, ...]]:
    """Keypoints of both sides' joints by SMPL's names: `form` spells one, of `side`, `Side`, `S`, `joint`, `Joint`."""
    made: dict[str, tuple[str, ...]] = {}
    for side in _SIDES:
        for joint in joints:
            words = {"side": side, "Side": side.capitalize(), "S": side[0].upper()}
            made[f"{side[0]}_{joint}"] = (form.format(joint=joint, Joint=joint.capitalize(), **words),)
    return made


def _at(joint: str, *names: str) -> dict[str, tuple[str, ...]]:
    """Keypoints beside one joint; `{s}` in its name is the side that a keypoint's name says."""
    return {
        name: (joint.format(s="r" if "right" in name.lower() or name[0] == "R" else "l"),) for name in names
    }


def _both(*names: str) -> tuple[str, ...]:
    """Names with `left` in them, each followed by the other side's."""
    return tuple(side for name in names for side in (name, name.replace("left", "right")))


_OPENPOSE_ARMS = ("Nose", "Neck", "RShoulder", "RElbow", "RWrist", "LShoulder", "LElbow", "LWrist")
_OPENPOSE_FACE = ("REye", "LEye", "REar", "LEar")

ORDERS: Mapping[str, Order] = {
    "smpl24": Order(JOINT_NAMES, {name: (name,) for name in JOINT_NAMES}, "SMPL's 24 joints", {}),
    "coco17": Order(
        (
            "nose",
            *_both("left_eye", "left_ear", "left_shoulder", "left_elbow", "left_wrist"),
            *_both("left_hip", "left_knee", "left_ankle"),
        ),
        {"head": ("left_ear", "right_ear"), **_limbs("{side}_{joint}", *_LIMBS)},
        "COCO's 17 keypoints",
        _at("head", "nose", *_both("left_eye")),
    ),
    # OpenPose's Neck and MidHip are means of its shoulders and hips, and add nothing to them.
    "body25": Order(
        (
            *_OPENPOSE_ARMS, "MidHip", "RHip", "RKnee", "RAnkle", "LHip", "LKnee", "LAnkle", *_OPENPOSE_FACE,
            "LBigToe", "LSmallToe", "LHeel", "RBigToe", "RSmallToe", "RHeel",
        ),
        {
            "head": ("LEar", "REar"),
            "l_foot": ("LBigToe", "LSmallToe"),
            "r_foot": ("RBigToe", "RSmallToe"),
            **_limbs("{S}{Joint}", *_LIMBS),
        },
        "OpenPose's BODY_25",
        {
            **_at("head", "Nose", "REye", "LEye"),
            "Neck": ("l_shoulder", "r_shoulder"),
            "MidHip": ("l_hip", "r_hip"),
            **_at("{s}_ankle", "LHeel", "RHeel"),
        },
    ),
    "coco18": Order(
        (*_OPENPOSE_ARMS, "RHip", "RKnee", "RAnkle", "LHip", "LKnee", "LAnkle", *_OPENPOSE_FACE),
        {"head": ("LEar", "REar"), **_limbs("{S}{Joint}", *_LIMBS)},
        "OpenPose's COCO model with 18",
        {**_at("head", "Nose", "REye", "LEye"), "Neck": ("l_shoulder", "r_shoulder")},
    ),
    # Its hands are knuckles, as SMPL's; its feet's tips some 7 cm before SMPL's.
    "mediapipe33": Order(
        (
            "nose", "left_eye_inner", "left_eye", "left_eye_outer", "right_eye_inner", "right_eye", "right_eye_outer",
            "left_ear", "right_ear", "mouth_left", "mouth_right",
            *_both("left_shoulder", "left_elbow", "left_wrist", "left_pinky", "left_index", "left_thumb"),
            *_both("left_hip", "left_knee", "left_ankle", "left_heel", "left_foot_index"),
        ),
        {
            "head": ("left_ear", "right_ear"),
            **{f"{side[0]}_hand": (f"{side}_pinky", f"{side}_index") for side in _SIDES},
            **{f"{side[0]}_foot": (f"{side}_foot_index",) for side in _SIDES},
            **_limbs("{side}_{joint}", *_LIMBS),
        },
        "MediaPipe's 33 landmarks",
        {
            **_at("head", "nose", *_both("left_eye_inner", "left_eye", "left_eye_outer"), "mouth_left", "mouth_right"),
            **_at("{s}_hand", *_both("left_thumb")),
            **_at("{s}_ankle", *_both("left_heel")),
        },
    ),
    "kinect25": Order(
        (
            "SpineBase", "SpineMid", "Neck", "Head", "ShoulderLeft", "ElbowLeft", "WristLeft", "HandLeft",
            "ShoulderRight", "ElbowRight", "WristRight", "HandRight", "HipLeft", "KneeLeft", "AnkleLeft", "FootLeft",
            "HipRight", "KneeRight", "AnkleRight", "FootRight", "SpineShoulder", "HandTipLeft", "ThumbLeft",
            "HandTipRight", "ThumbRight",
        ),
        {
            "pelvis": ("SpineBase",),
            "neck": ("Neck", "SpineShoulder"),  # above and below SMPL's
            "head": ("Head",),
            **_limbs("{Joint}{Side}", *_LIMBS, "hand", "foot"),
        },
        "Kinect v2's 25 (NTU RGB+D's)",
        {
            "SpineMid": ("spine2",),
            **_at("{s}_hand", "HandTipLeft", "ThumbLeft", "HandTipRight", "ThumbRight"),
        },
    ),
    "azure32": Order(
        (
            "PELVIS", "SPINE_NAVEL", "SPINE_CHEST", "NECK",
            *(f"{joint}_{side}" for side in ("LEFT", "RIGHT")
              for joint in ("CLAVICLE", "SHOULDER", "ELBOW", "WRIST", "HAND", "HANDTIP", "THUMB")),
            *(f"{joint}_{side}" for side in ("LEFT", "RIGHT") for joint in ("HIP", "KNEE", "ANKLE", "FOOT")),
            "HEAD", "NOSE", "EYE_LEFT", "EAR_LEFT", "EYE_RIGHT", "EAR_RIGHT",
        ),
        {
            "pelvis": ("PELVIS",),
            "neck": ("NECK",),
            "head": ("HEAD",),
            **{
                f"{side[0].lower()}_{joint}": (f"{joint.upper()}_{side}",)
                for side in ("LEFT", "RIGHT") for joint in (*_LIMBS, "hand", "foot")
            },
        },
        "Azure Kinect's 32",
        {
            "SPINE_NAVEL": ("spine1",),
            "SPINE_CHEST": ("spine3",),
            **_at("{s}_collar", "CLAVICLE_LEFT", "CLAVICLE_RIGHT"),
            **_at("{s}_hand", "HANDTIP_LEFT", "THUMB_LEFT", "HANDTIP_RIGHT", "THUMB_RIGHT"),
            **_at("head", "NOSE", "EYE_LEFT", "EAR_LEFT", "EYE_RIGHT", "EAR_RIGHT"),
        },
    ),
    # Its feet are ankles. SMPL's head lies below the middle between neck base, which others call nose, and crown.
    "h36m17": Order(
        (
            "root", "right_hip", "right_knee", "right_foot", "left_hip", "left_knee", "left_foot", "spine", "thorax",
            "neck_base", "head", "left_shoulder", "left_elbow", "left_wrist", "right_shoulder", "right_elbow",
            "right_wrist",
        ),
        {
            "pelvis": ("root",),
            "neck": ("thorax",),
            "head": ("neck_base", "head"),
            **{f"{side[0]}_ankle": (f"{side}_foot",) for side in _SIDES},
            **_limbs("{side}_{joint}", "hip", "knee", "shoulder", "elbow", "wrist"),
        },
        "Human3.6M's 17",
        {"spine": ("spine2",)},
    ),
}  # fmt: skip
"""The orders by name; of those of one length, the more common one first."""

KNOWN_ORDERS = ", ".join(f"{name} ({order.title})" for name, order in ORDERS.items())
"""For messages."""


@cache
def taken_by(order: str) -> np.ndarray:
    """`(24, K)`: 1 where a joint is taken from a keypoint, else 0."""
    names, joints = ORDERS[order].names, ORDERS[order].joints
    return np.array([[name in joints.get(joint, ()) for name in names] for joint in JOINT_NAMES], float)


@cache
def middles_of(order: str) -> np.ndarray:
    """`(K, 24)`: each keypoint as a mean of joints, more or less."""
    middles = taken_by(order).T.copy()
    for name, joints in ORDERS[order].beside.items():
        middles[ORDERS[order].names.index(name), [JOINT_NAMES.index(joint) for joint in joints]] = 1
    return middles / middles.sum(1, keepdims=True)


def orders_of(num_keypoints: int) -> tuple[str, ...]:
    """The names of the orders of that many keypoints."""
    return tuple(name for name, order in ORDERS.items() if len(order.names) == num_keypoints)


def spelt(name: object) -> str:
    """A keypoint's name without case, separators and the prefix that an SDK gives its constants."""
    letters = "".join(letter for letter in str(name).lower() if letter.isalnum())
    return letters.removeprefix("k4abtjoint").removeprefix("jointtype")


def order_of_names(names: Mapping[str, object]) -> tuple[str, dict[str, object]] | None:
    """The first order that has all of some keypoints' names, and the values by that order's spelling."""
    given = {spelt(name): value for name, value in names.items()}
    for name, order in ORDERS.items():
        if given and given.keys() <= {spelt(keypoint) for keypoint in order.names}:
            return name, {keypoint: given.get(spelt(keypoint)) for keypoint in order.names}
    return None
