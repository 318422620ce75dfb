"""The skeleton that poses are made on: forward kinematics, mirror images, headings."""

import numpy as np
import torch
from torch import Tensor

from ljn.body.files import BodyModel
from ljn.body.skeleton import LEVELS, MIRROR, PARENTS, ROOT
from ljn.geometry.rotations import rotation_about, swing_twist

SIDES: dict[str, int] = {"l": 1, "r": -1}
"""The two sides of the body and the sign of their x axis."""

_UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
_ACROSS = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)


def joint_offsets(body: BodyModel) -> Tensor:
    """The rest positions of a body's joints relative to their parents, `(24, 3)`, metres; zero for the root."""
    joints = torch.from_numpy(body.J_regressor.astype(np.float64) @ body.v_template.astype(np.float64))
    return joints - joints[[max(parent, ROOT) for parent in PARENTS]]


def world_rotations(rotmat: Tensor) -> Tensor:
    """Rotations from the rest frame into the world, `(n, 24, 3, 3)`, of such relative to the parent joint."""
    world = rotmat.clone()
    for level in LEVELS[1:]:
        children = list(level)
        world[:, children] = world[:, [PARENTS[joint] for joint in level]] @ rotmat[:, children]
    return world


def joint_positions(world: Tensor, offsets: Tensor) -> Tensor:
    """Where joints are, `(n, 24, 3)`, metres, root at the origin; of `world_rotations`, and offsets as `joint_offsets`.

    Offsets are `(24, 3)`, or `(n, 24, 3)` of each.
    """
    bones = (world[:, [max(parent, ROOT) for parent in PARENTS]] * offsets[..., None, :]).sum(-1)
    joints = torch.zeros_like(bones)
    for level in LEVELS[1:]:
        children = list(level)
        joints[:, children] = joints[:, [PARENTS[joint] for joint in level]] + bones[:, children]
    return joints


def mirror(rotmat: Tensor) -> Tensor:
    """The mirror images of poses `(..., 24, 3, 3)`: left and right change places."""
    return rotmat[..., list(MIRROR), :, :] * _ACROSS[:, None] * _ACROSS


def without_heading(root: Tensor) -> Tensor:
    """Root rotations `(..., 3, 3)` less their turn about the vertical.

    What stays is the shortest way from standing upright and looking along z to the body's present attitude. Unlike
    the direction that the pelvis looks in, this has no jump where a body leans over, lies or crawls.
    """
    _, heading = swing_twist(root, _UP)
    return rotation_about("y", -heading) @ root
