import numpy as np
import pytest
import torch

from datamodules.sources.embedded.procedural import draw_poses
from ljn.body.kinematics import joint_positions, world_rotations
from ljn.body.skeleton import JOINT_INDEX, NUM_JOINTS
from ljn.geometry.rotations import euler_to_rotmat


@pytest.fixture(scope="session")
def family_poses(offsets):
    """Some hundred poses of a family."""
    return lambda name, n=300: draw_poses(np.random.default_rng(3), np.full(n, name), offsets)


@pytest.fixture(scope="session")
def place(offsets):
    """Joint positions by name, `(n, 3)` each, metres, y up."""

    def joints(rotmat):
        positions = joint_positions(world_rotations(rotmat), offsets)
        return {name: positions[:, index] for name, index in JOINT_INDEX.items()}

    return joints


@pytest.fixture(scope="session")
def posed():
    """A pose `(1, 24, 3, 3)` from angles in degrees, joint by joint: an order of axes and the three angles."""

    def pose(**joints):
        rotmat = torch.eye(3, dtype=torch.float64).repeat(1, NUM_JOINTS, 1, 1)
        for name, (axes, *angles) in joints.items():
            rotmat[0, JOINT_INDEX[name]] = euler_to_rotmat(
                axes, torch.tensor(angles, dtype=torch.float64).deg2rad()
            )
        return rotmat

    return pose
