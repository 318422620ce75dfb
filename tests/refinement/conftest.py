import numpy as np
import pytest
import torch

from ljn.body import SMPL
from ljn.body.skeleton import JOINT_INDEX
from ljn.cloud.observation import ObservationRecipe, observe, stack_observations
from ljn.geometry.camera import Camera
from ljn.geometry.rotations import CAMERA_FROM_BODY, rotvec_to_rotmat, smpl_pose_to_body_world
from ljn.refinement.surface import BodyState
from ljn.render import get_renderer

CAMERA = Camera(366.5, 366.5, 206.5, 253.0, 424, 512)
TAKES = ("points", "crop", "crop_camera")


@pytest.fixture(scope="session")
def body():
    return SMPL.load()


def a_pose(spread=0.0, seed=0):
    """Arms half down, facing the camera; and every joint turned by random angles, radians."""
    rotvec = torch.zeros(24, 3)
    rotvec[JOINT_INDEX["l_shoulder"], 2], rotvec[JOINT_INDEX["r_shoulder"], 2] = -0.7, 0.7
    rotvec[JOINT_INDEX["l_elbow"], 1], rotvec[JOINT_INDEX["r_knee"], 0] = -0.5, 0.4
    pose = smpl_pose_to_body_world(rotvec.flatten())
    return pose + spread * torch.randn(72, generator=torch.Generator().manual_seed(seed))


def state_of(pose, betas, root):
    """The camera frame's state of a pose `(72,)` in body world."""
    rotmats = rotvec_to_rotmat(pose.unflatten(-1, (24, 3)))
    turned = torch.cat([CAMERA_FROM_BODY.to(pose) @ rotmats[:1], rotmats[1:]])
    return BodyState(turned[None], betas[None], root[None])


def mesh_of(body, state):
    """Vertices and joints, camera frame."""
    vertices, joints = body.from_rotmats(state.rotmats, state.betas)
    shift = state.root[:, None] - joints[:, :1]
    return vertices + shift, joints + shift


def depth_of(body, state):
    """The depth image `(H, W)`."""
    return get_renderer("zbuffer")(mesh_of(body, state)[0], body.faces, CAMERA)[0].numpy()


def seen_of(depth, num_points=1024, camera=CAMERA):
    """A batch of one observation."""
    recipe = ObservationRecipe(num_points=num_points)
    observation = observe(depth, camera, None, recipe, TAKES, np.random.default_rng(0))
    return stack_observations([observation])


def guess_of(state, joints):
    """What a refiner is given to start at a state whose joints are these."""
    rotmats = torch.cat([CAMERA_FROM_BODY.to(joints).T @ state.rotmats[:, :1], state.rotmats[:, 1:]], 1)
    return rotmats, state.betas, joints


def fitted(refined):
    """The camera frame's state of what a refiner returns."""
    turned = CAMERA_FROM_BODY.to(refined.root) @ refined.rotmats[:, :1]
    return BodyState(torch.cat([turned, refined.rotmats[:, 1:]], 1), refined.betas, refined.root)


def error_mm(body, state, target):
    """Mean distance of the vertices, camera frame."""
    vertices, wanted = mesh_of(body, state)[0], mesh_of(body, target)[0]
    return 1000 * (vertices - wanted).norm(dim=-1).mean().item()
