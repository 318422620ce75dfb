"""Pose and shape from joints, bone by bone (ours, beyond the thesis): kinematics first, a perceptron for the rest.

The joints are seen in the body's own frame (left, up, forward: from hips, shoulders and spine), so the network need
not learn every heading. For each joint it corrects the direction of the joint's bone, as observed, and that of a
reference (forward, or up where the bone itself points forward): the bone gives the swing, the network the twist, and
both make the joint's rotation in that frame, so no error is handed down the tree. Every further stage sees where the
joints come to lie with the pose and shape so far.
"""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from ljn.body import SMPL
from ljn.body.files import NUM_BETAS
from ljn.body.skeleton import JOINT_INDEX, NUM_JOINTS, PARENTS
from ljn.geometry.rotations import BODY_TO_OPENGL, rot6d_to_rotmat
from ljn.nets.body_network import BodyEstimate, BodyNetwork

_PARENTS = list(PARENTS[1:])
_NEXT = {
    name: following
    for chain in (
        ("pelvis", "spine1", "spine2", "spine3", "neck", "head"),
        *(
            tuple(f"{side}_{name}" for name in limb)
            for side in "lr"
            for limb in (("hip", "knee", "ankle", "foot"), ("collar", "shoulder", "elbow", "wrist", "hand"))
        ),
    )
    for name, following in pairwise(chain)
}
# Both ends of each joint's bone: to the next joint down the limb, or, at its end, from the joint before.
_ENDS = [JOINT_INDEX[_NEXT[name]] if name in _NEXT else joint for name, joint in JOINT_INDEX.items()]
_STARTS = [joint if end != joint else PARENTS[joint] for joint, end in enumerate(_ENDS)]
_NUM_OUTPUTS = 6 * NUM_JOINTS + NUM_BETAS
_NUM_SEEN = 3 * NUM_JOINTS + 4 * (NUM_JOINTS - 1) + 9
_NUM_FED_BACK = 2 * 3 * NUM_JOINTS + _NUM_OUTPUTS


class KinematicNetwork(BodyNetwork):
    """The network; `use_body` has to be called before it is.

    Args:
        channels: Width of the residual stream.
        num_blocks: Residual blocks of a stage.
        num_stages: Stages, each of which is an iteration of `BodyEstimate`.
    """

    takes = ("initial_joints",)
    _template: Tensor
    _directions: Tensor
    _reference: Tensor
    _rest: Tensor

    def __init__(self, channels: int = 512, num_blocks: int = 1, num_stages: int = 2) -> None:
        super().__init__()
        if num_stages < 1:
            raise ValueError(f"num_stages: expected at least 1, got {num_stages}")
        self.stages = nn.ModuleList(
            KinematicStage(_NUM_SEEN + (_NUM_FED_BACK if stage else 0), channels, num_blocks)
            for stage in range(num_stages)
        )

    def use_body(self, body: SMPL) -> None:
        """Take the rest joints and how they move with the shape: see `BodyNetwork.use_body`."""
        shapes = torch.cat([torch.zeros(1, NUM_BETAS), torch.eye(NUM_BETAS)])
        template, *moved = body.rest_joints(shapes).float()
        bones = normalize(template[_ENDS] - template[_STARTS], dim=-1)
        up, forward = torch.tensor([0.0, 1, 0]), torch.tensor([0.0, 0, 1])
        reference = torch.where(bones[:, 2:].abs() > 0.8, up, forward)
        constants = {
            "_template": template,
            "_directions": torch.stack(moved) - template,
            "_reference": reference,
            "_rest": rot6d_to_rotmat(torch.cat([bones, reference], -1)),
        }
        for name, value in constants.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, initial_joints: Tensor) -> BodyEstimate:
        """Pose and shape after each stage, from joints `(B, 24, 3)`, metres, camera frame."""
        joints = initial_joints * initial_joints.new_tensor([1, -1, -1])  # OpenGL's axes, right-handed
        joints = joints - joints.mean(1, keepdim=True)
        frame = body_frame(joints)
        joints = joints @ frame
        bones = joints[:, 1:] - joints[:, _PARENTS]
        lengths = bones.norm(dim=-1, keepdim=True) + 1e-6
        seen = [2 * joints.flatten(1), (bones / lengths).flatten(1), 5 * lengths.flatten(1), frame.flatten(1)]
        observed = normalize(joints[:, _ENDS] - joints[:, _STARTS], dim=-1)

        hidden: Tensor | None = None
        total = joints.new_zeros(len(joints), _NUM_OUTPUTS)
        rotmats, shapes = [], []
        for stage in self.stages:
            change, hidden = stage(torch.cat(seen, -1), hidden)
            total = total + change
            turns, betas = total.split([6 * NUM_JOINTS, NUM_BETAS], -1)
            along, across = turns.unflatten(-1, (NUM_JOINTS, 6)).split(3, -1)
            world = (
                rot6d_to_rotmat(torch.cat([observed + along, self._reference + across], -1)) @ self._rest.mT
            )
            root = BODY_TO_OPENGL.T.to(frame) @ frame @ world[:, 0]
            relative = world[:, _PARENTS].mT @ world[:, 1:]
            rotmats.append(torch.cat([root[:, None], relative], 1))
            shapes.append(betas)
            reached = self._joints(world, betas)
            seen = [*seen[:4], 5 * (joints - reached).flatten(1), 2 * reached.flatten(1), total]
        return BodyEstimate(torch.stack(rotmats), torch.stack(shapes))

    def _joints(self, world: Tensor, betas: Tensor) -> Tensor:
        """Joints `(B, 24, 3)` about their mean, of rotations `(B, 24, 3, 3)` in the body's own frame and a shape."""
        rest = self._template + torch.einsum("bi,ijk->bjk", betas, self._directions)
        offsets = (world[:, _PARENTS] @ (rest[:, 1:] - rest[:, _PARENTS])[..., None]).squeeze(-1)
        places = [torch.zeros_like(offsets[:, 0])]
        for bone, parent in enumerate(_PARENTS):
            places.append(places[parent] + offsets[:, bone])
        joints = torch.stack(places, 1)
        return joints - joints.mean(1, keepdim=True)


class KinematicStage(nn.Module):
    """A residual perceptron: what is seen, and the hidden state of the stage before, to changes and a hidden state.

    Args:
        in_channels: Numbers seen.
        channels: Width of the residual stream.
        num_blocks: Residual blocks.
    """

    def __init__(self, in_channels: int, channels: int, num_blocks: int) -> None:
        super().__init__()
        self.first = nn.Linear(in_channels, channels)
        self.blocks = nn.ModuleList(
            nn.Sequential(
                nn.LayerNorm(channels),
                nn.Linear(channels, 2 * channels),
                nn.GELU(),
                nn.Linear(2 * channels, channels),
            )
            for _ in range(num_blocks)
        )
        self.norm = nn.LayerNorm(channels)
        self.last = nn.Linear(channels, _NUM_OUTPUTS)
        # It starts from the observed bones and the mean shape.
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, seen: Tensor, hidden: Tensor | None) -> tuple[Tensor, Tensor]:
        """`(B, in_channels)` and `(B, channels)` or None -> changes `(B, 154)` and hidden state `(B, channels)`."""
        x = self.first(seen) if hidden is None else self.first(seen) + hidden
        for block in self.blocks:
            x = x + block(x)
        return self.last(self.norm(x)), x


def body_frame(joints: Tensor) -> Tensor:
    """The body's left, up and forward as the columns of a rotation matrix.

    Args:
        joints: `(B, 24, 3)`, right-handed axes.

    Returns:
        `(B, 3, 3)`.
    """
    at = {name: joints[:, index] for name, index in JOINT_INDEX.items()}
    upper = (at["neck"] + at["spine3"] + at["spine2"] + at["l_shoulder"] + at["r_shoulder"]) / 5
    up = normalize(upper - (at["pelvis"] + at["l_hip"] + at["r_hip"]) / 3, dim=-1)
    hips, shoulders = at["l_hip"] - at["r_hip"], at["l_shoulder"] - at["r_shoulder"]
    left = 2 * hips + shoulders / 2 + at["l_collar"] - at["r_collar"]
    left = normalize(left - (left * up).sum(-1, keepdim=True) * up, dim=-1)
    return torch.stack([left, up, torch.linalg.cross(left, up)], -1)
