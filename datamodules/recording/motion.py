"""A clip of motion, made ready to stand before a camera."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch

from datamodules.sources.embedded import EmbeddedSource
from datamodules.sources.embedded.joint_limits import with_square_elbows
from datamodules.sources.embedded.records import ClipMixture
from ljn.body.skeleton import NUM_JOINTS, ROOT
from ljn.geometry.rotations import rotation_about, rotmat_to_rotvec, rotvec_to_rotmat, smpl_pose_to_body_world

SPLIT = "test"
"""Whose clips are shown: what ships has never seen them."""


class Motion(NamedTuple):
    """A motion.

    Attributes:
        name: Of the clip.
        pose: `(T, 72)` float64 axis-angle, radians; the first three place the body in body world.
    """

    name: str
    pose: np.ndarray


def embedded_motion(
    clip: str, start: int = 0, num_frames: int | None = None, heading_deg: float = 0
) -> Motion:
    """A part of an embedded clip of the test split.

    Args:
        clip: Its name.
        start: The first frame, from 0.
        num_frames: How many; None for all that are left.
        heading_deg: Which way the first frame faces: 0 into the camera, 90 to the image's right.

    Raises:
        ValueError: No such clip or frame.
    """
    mixture = _embedded()
    clips = [name for name in dict.fromkeys(mixture.clips.clip.tolist()) if name in mixture.split[SPLIT]]
    if clip not in clips:
        raise ValueError(f"clip: expected one of the {SPLIT} split's ({', '.join(clips)}), got '{clip}'")
    poses = mixture.clips.poses[mixture.clips.clip == clip]
    if not 0 <= start < len(poses) or (num_frames is not None and num_frames < 1):
        raise ValueError(
            f"start: expected a frame of the clip '{clip}' (0 to {len(poses) - 1}) and num_frames of 1 or more, got "
            f"start {start} and num_frames {num_frames}"
        )
    pose = torch.from_numpy(poses[start:][:num_frames]).double()
    pose = smpl_pose_to_body_world(pose).unflatten(-1, (NUM_JOINTS, 3))
    rotmat = with_square_elbows(rotvec_to_rotmat(pose))
    forward = rotmat[0, ROOT, :, 2]  # SMPL's rest pose looks along z
    turn = np.deg2rad(heading_deg) - torch.atan2(forward[1], forward[0])
    rotmat[:, ROOT] = rotation_about("z", turn) @ rotmat[:, ROOT]
    return Motion(clip, rotmat_to_rotvec(rotmat).flatten(-2).numpy())


@lru_cache(maxsize=1)
def _embedded() -> ClipMixture:
    return EmbeddedSource().mixture
