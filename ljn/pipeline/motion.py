"""Motions as files that other programs read: AMASS's form (`.npz`) and BVH. Arrays in, a file out.

Both are of one person with one shape: bones keep their lengths. A motion is in the body world, z up where the camera
was held level, with the camera at the origin, looking along -x.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ljn.body.skeleton import BONES, JOINT_NAMES, NUM_JOINTS, PARENTS, ROOT
from ljn.body.smpl import SMPL
from ljn.geometry.rotations import BODY_TO_OPENGL, CAMERA_FROM_BODY, rotmat_to_euler, rotvec_to_rotmat
from ljn.pipeline.prediction import Prediction

_AMASS_WIDTH = 156  # of SMPL-H's 52 joints
_AMASS_BODY = 66  # of those that are SMPL's, too: all but its two hands, whose rotations are left out
_AMASS_BETAS = 16
_AMASS_SOFT = 8  # dynamic soft-tissue coefficients, zero here: some readers want them
_BVH_ORDER = "zxy"
_BVH_UNIT_M = 0.01
_END_SHARE = 0.5  # of its last bone's length that a chain goes on


class BodyMotion(NamedTuple):
    """A person's motion, one shape throughout."""

    pose: (
        np.ndarray
    )  # `(T, 72)` axis-angle, radians; the first three lead from SMPL's rest frame into the body world
    root: np.ndarray  # `(T, 3)`, where the pelvis is, metres, body world
    betas: np.ndarray  # `(10,)`
    rest_joints: np.ndarray  # `(24, 3)`, the joints of that shape at rest, metres, SMPL's rest frame
    rate_hz: float  # frames a second
    gender: str = "neutral"  # of the body that the betas are of

    @property
    def joints(self) -> np.ndarray:
        """The joints `(T, 24, 3)`, metres, body world."""
        local = rotvec_to_rotmat(torch.from_numpy(self.pose).double().unflatten(-1, (NUM_JOINTS, 3))).numpy()
        world, joints = local.copy(), np.repeat(self.root[:, None].astype(np.float64), NUM_JOINTS, 1)
        for parent, joint in BONES:
            world[:, joint] = world[:, parent] @ local[:, joint]
            bone = self.rest_joints[joint] - self.rest_joints[parent]
            joints[:, joint] = joints[:, parent] + world[:, parent] @ bone
        return joints


class PosedFrame(NamedTuple):
    """What a motion needs of one frame's prediction."""

    pose: np.ndarray  # `(72,)`; see `Prediction`
    betas: np.ndarray  # `(10,)`
    joints: np.ndarray  # `(24, 3)`, the mesh's, metres, camera frame

    @classmethod
    def of(cls, prediction: Prediction) -> "PosedFrame":
        """Of one person's prediction.

        Raises:
            ValueError: It has no mesh.
        """
        pose, betas, joints = prediction.pose, prediction.betas, prediction.mesh_joints
        if pose is None or betas is None or joints is None:
            raise ValueError("prediction: expected one with a mesh, got joints alone; give a mesh regressor")
        return cls(pose, betas, joints)


def body_motion(frames: Sequence[PosedFrame | None], body: SMPL, rate_hz: float) -> BodyMotion:
    """The motion of a sequence of predictions, frame by frame; its shape is their median.

    Args:
        frames: In order. Where one is None, the person stays as in the frame before (before the first, as in that).
        body: The body that was predicted.
        rate_hz: Frames a second.

    Raises:
        ValueError: There is no frame, or `rate_hz` is no rate.
    """
    if not 0 < rate_hz < np.inf:
        raise ValueError(f"rate_hz: expected frames a second, more than 0, got {rate_hz}")
    known = [frame for frame in frames if frame is not None]
    if not known:
        raise ValueError("frames: expected at least one that was predicted, got none")
    held, last = [], known[0]
    for frame in frames:
        last = last if frame is None else frame
        held.append(last)
    betas = np.median([frame.betas for frame in known], 0)
    with torch.inference_mode():
        rest = body.rest_joints(torch.from_numpy(betas).to(body.faces.device)).cpu().numpy()
    root = np.array([frame.joints[ROOT] for frame in held], np.float64) @ CAMERA_FROM_BODY.numpy()
    return BodyMotion(np.array([frame.pose for frame in held]), root, betas, rest, rate_hz, body.genders[0])


def shape_distance_mm(frames: Sequence[PosedFrame | None], motion: BodyMotion) -> float:
    """How far the motion's one shape moves joints: their median distance from the frames' own, which have theirs."""
    known = [(frame, joints) for frame, joints in zip(frames, motion.joints) if frame is not None]
    given = np.array([frame.joints for frame, _ in known], np.float64) @ CAMERA_FROM_BODY.numpy()
    return 1000 * float(np.median(np.linalg.norm(given - np.array([joints for _, joints in known]), axis=-1)))


def write_amass(path: Path, motion: BodyMotion) -> None:
    """Write an `.npz` file as AMASS's of SMPL-H: poses, trans, betas, dmpls, gender, mocap_framerate.

    Its joints are the motion's. The hands' rotations, which SMPL-H has none of, are left out, and its fingers rest.
    """
    _check(motion)
    number = len(motion.pose)
    poses, betas = np.zeros((number, _AMASS_WIDTH)), np.zeros(_AMASS_BETAS)
    poses[:, :_AMASS_BODY] = motion.pose[:, :_AMASS_BODY]
    betas[: len(motion.betas)] = motion.betas
    np.savez_compressed(
        path,
        poses=poses,
        trans=motion.root
        - motion.rest_joints[ROOT],  # SMPL's layers turn a body about its root, and then move it
        betas=betas,
        dmpls=np.zeros((number, _AMASS_SOFT)),
        gender=np.array(motion.gender),
        mocap_framerate=np.array(float(motion.rate_hz)),
    )


def write_bvh(path: Path, motion: BodyMotion) -> None:
    """Write a BVH file: the 24 joints under their names, y up, z forward, centimetres, degrees."""
    _check(motion)
    offsets = motion.rest_joints - motion.rest_joints[[max(parent, ROOT) for parent in PARENTS]]
    lines, order = ["HIERARCHY"], []
    rotations = " ".join(f"{axis.upper()}rotation" for axis in _BVH_ORDER)

    def write(joint: int, depth: int) -> None:
        indent = "\t" * depth
        channels = f"3 {rotations}" if joint != ROOT else f"6 Xposition Yposition Zposition {rotations}"
        lines.extend(
            [
                f"{indent}{'ROOT' if joint == ROOT else 'JOINT'} {JOINT_NAMES[joint]}",
                f"{indent}{{",
                f"{indent}\tOFFSET {_numbers(offsets[joint] / _BVH_UNIT_M)}",
                f"{indent}\tCHANNELS {channels}",
            ]
        )
        order.append(joint)
        children = [child for parent, child in BONES if parent == joint]
        for child in children:
            write(child, depth + 1)
        if not children:
            end = _numbers(_END_SHARE * offsets[joint] / _BVH_UNIT_M)
            lines.extend(
                [f"{indent}\tEnd Site", f"{indent}\t{{", f"{indent}\t\tOFFSET {end}", f"{indent}\t}}"]
            )
        lines.append(f"{indent}}}")

    write(ROOT, 0)
    rotmat = rotvec_to_rotmat(torch.from_numpy(motion.pose).double().unflatten(-1, (NUM_JOINTS, 3)))
    rotmat[:, ROOT] = BODY_TO_OPENGL @ rotmat[:, ROOT]
    angles = rotmat_to_euler(_BVH_ORDER, rotmat).rad2deg().numpy()[:, order].reshape(len(rotmat), -1)
    root = motion.root @ BODY_TO_OPENGL.numpy().T / _BVH_UNIT_M
    lines += ["MOTION", f"Frames: {len(rotmat)}", f"Frame Time: {1 / motion.rate_hz:.8f}"]
    lines += [_numbers(row) for row in np.concatenate([root, angles], 1)]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


WRITERS: dict[str, tuple[str, Callable[[Path, BodyMotion], None]]] = {
    "amass": (".npz", write_amass),
    "bvh": (".bvh", write_bvh),
}
"""The forms of a motion's file: the suffix, and what writes it."""


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.6f}" for value in values)


def _check(motion: BodyMotion) -> None:
    number = len(motion.pose)
    shapes = {"pose": (number, 3 * NUM_JOINTS), "root": (number, 3), "rest_joints": (NUM_JOINTS, 3)}
    for name, shape in shapes.items():
        value = getattr(motion, name)
        if value.shape != shape or not np.isfinite(value).all():
            raise ValueError(f"{name}: expected finite numbers of shape {shape}, got {value.shape}")
    if number == 0:
        raise ValueError("pose: expected at least one frame, got none")
