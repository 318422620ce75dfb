"""A body's surface at points spread over it: where pose and shape take them, and the derivative of that.

Bodies are changed in the tangent space of their pose: a change `(85,)` holds a rotation vector for each joint, radians,
R_k <- R_k exp(w_k), then what is added to the 10 shape coefficients and to the root joint's position, metres.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from ljn.body import SMPL
from ljn.body.files import NUM_BETAS
from ljn.body.skeleton import LEVELS, NUM_JOINTS, PARENTS, ROOT
from ljn.geometry.points import farthest_point_sampling, gather_points
from ljn.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat

NUM_CHANGES = 3 * NUM_JOINTS + NUM_BETAS + 3
_LEVEL_SIZES = [len(level) for level in LEVELS]


class BodyState(NamedTuple):
    """Pose, shape and place of bodies, in any frame.

    Attributes:
        rotmats: `(B, 24, 3, 3)`, relative to the parent joint; the first leads from SMPL's rest frame into the frame.
        betas: `(B, 10)`.
        root: `(B, 3)`, the root joint's position, metres.
    """

    rotmats: Tensor
    betas: Tensor
    root: Tensor

    def moved(self, change: Tensor) -> "BodyState":
        """The bodies after a change `(B, 85)`."""
        turns, betas, root = change.split([3 * NUM_JOINTS, NUM_BETAS, 3], -1)
        turned = self.rotmats @ rotvec_to_rotmat(turns.unflatten(-1, (NUM_JOINTS, 3)))
        return BodyState(turned, self.betas + betas, self.root + root)

    def change_from(self, start: "BodyState") -> Tensor:
        """The change `(B, 85)` that makes these bodies of others."""
        turns = rotmat_to_rotvec(start.rotmats.mT @ self.rotmats).flatten(-2)
        return torch.cat([turns, self.betas - start.betas, self.root - start.root], -1)


class PosedSurface(NamedTuple):
    """A posed surface.

    Attributes:
        vertices: `(B, U, 3)`, metres.
        normals: `(B, U, 3)`, unit, outward: the rest pose's, turned as the skin is.
        joints: `(B, 24, 3)`, metres.
        rotations: `(B, 24, 3, 3)`, of each joint, from the rest frame.
        offsets: `(B, 24, 3)`: of each joint, where its rotation alone takes the rest frame's origin, metres.
        unposed: `(B, U, 3)`, rest frame, correctives included, metres.
        blended: `(B, U, 3, 3)`, the weighted mean of the joints' rotations.
        joint_shapes: `(B, 24, 3, 10)`: derivative of `offsets` by the shape.
    """

    vertices: Tensor
    normals: Tensor
    joints: Tensor
    rotations: Tensor
    offsets: Tensor
    unposed: Tensor
    blended: Tensor
    joint_shapes: Tensor


class BodySurface(nn.Module):
    """Vertices of a body, spread evenly over its surface.

    Args:
        body: The body; of one gender.
        num_vertices: How many of its vertices.
    """

    index: Tensor
    _template: Tensor
    _normals: Tensor
    _directions: Tensor
    _shapes: Tensor
    _weights: Tensor
    _J_template: Tensor
    _J_shapes: Tensor
    _below: Tensor
    _parents: Tensor
    _places: Tensor

    def __init__(self, body: SMPL, num_vertices: int) -> None:
        super().__init__()
        if len(body.genders) > 1:
            raise ValueError(f"body: expected one body, got those of {', '.join(body.genders)}")
        template = body._v_template[0].view(3, -1).T.contiguous()
        index = farthest_point_sampling(template[None].float(), min(num_vertices, len(template)))[0]
        index = index.sort().values
        directions = body._directions[0].unflatten(-1, (3, -1))[..., index]  # (217, 3, U)
        below = torch.eye(NUM_JOINTS)
        for joint in reversed(range(1, NUM_JOINTS)):
            below[PARENTS[joint]] += below[joint]
        buffers = {
            "index": index,
            "_template": template[index],
            "_normals": _vertex_normals(template, body.faces)[index],
            "_directions": directions.transpose(1, 2)
            .flatten(1)
            .contiguous(),  # (217, 3U), a vertex after the other
            "_shapes": directions[:NUM_BETAS].permute(2, 1, 0).contiguous(),  # (U, 3, 10)
            "_weights": body._weights[0].T[index].contiguous(),  # (U, 24)
            "_J_template": body._J_template[0].view(NUM_JOINTS, 3),
            "_J_shapes": body._J_shapedirs[0].view(NUM_BETAS, NUM_JOINTS, 3).permute(1, 2, 0).contiguous(),
            "_parents": torch.tensor([max(parent, ROOT) for parent in PARENTS]),
            "_places": body._places,
            "_below": below.to(template),  # 1 where the column's joint is the row's or below it
        }
        for name, value in buffers.items():
            self.register_buffer(name, value.clone(), persistent=False)

    def forward(self, state: BodyState) -> PosedSurface:
        """The surface of bodies."""
        rotmats, betas, root = state
        rest = self._J_template + (self._J_shapes @ betas[:, None, :, None]).squeeze(-1)
        turned = self._world_rotations(rotmats)
        parents = turned[:, self._parents]  # of the root's own bone, which has no length and no shape: itself
        bones = (parents @ (rest - rest[:, self._parents])[..., None]).squeeze(-1)
        places = root[:, None] + self._below.T @ bones
        bone_shapes = (parents @ (self._J_shapes - self._J_shapes[self._parents])).flatten(2)
        shapes = (self._below.T @ bone_shapes).unflatten(-1, (3, NUM_BETAS)) - turned @ self._J_shapes
        offsets = places - (turned @ rest[..., None]).squeeze(-1)

        eye = torch.eye(3, dtype=rotmats.dtype, device=rotmats.device)
        features = torch.cat([betas, (rotmats[:, 1:] - eye).flatten(1)], -1)
        unposed = self._template + (features @ self._directions).unflatten(-1, (-1, 3))
        blended = (self._weights @ turned.flatten(2)).unflatten(-1, (3, 3))
        vertices = (blended @ unposed[..., None]).squeeze(-1) + self._weights @ offsets
        normals = normalize((blended @ self._normals[..., None]).squeeze(-1), dim=-1)
        return PosedSurface(vertices, normals, places, turned, offsets, unposed, blended, shapes)

    def _world_rotations(self, rotmats: Tensor) -> Tensor:
        """Each joint's rotation from the rest frame, `(B, 24, 3, 3)`, all joints of a level at once."""
        root, *levels = rotmats.split(_LEVEL_SIZES, 1)
        world = [root]
        for level, places in zip(levels, self._places.split(_LEVEL_SIZES[1:])):
            world.append(world[-1].index_select(1, places) @ level)
        return torch.cat(world, 1)

    def rows(self, posed: PosedSurface, index: Tensor, directions: Tensor) -> Tensor:
        """How far vertices move along directions with a change: rows of the Jacobian.

        The correctives' own derivative by the pose, some hundredths of the skin's, is left out. On a CPU a compiled
        kernel does it.

        Args:
            posed: The surface.
            index: `(B, M)` long, which of its vertices.
            directions: `(B, M, 3)`, along which each is asked, of any length.

        Returns:
            `(B, M, 85)`: d . dv / d(change), for each.
        """
        if index.device.type == "cpu":
            return self._rows_on_cpu(posed, index, directions)
        return self._rows_as_tensors(posed, index, directions)

    def _rows_as_tensors(self, posed: PosedSurface, index: Tensor, directions: Tensor) -> Tensor:
        weights, unposed = self._weights[index], gather_points(posed.unposed, index)
        at = torch.einsum("bkij,bmj->bmki", posed.rotations, unposed) + posed.offsets[:, None]
        # Of each joint: the part of a vertex that it and the joints below it carry, about it.
        arm = self._below @ (weights[..., None] * at)
        arm = arm - (weights @ self._below.T)[..., None] * posed.joints[:, None]
        # d . (R w x arm) = R^T (arm x d) . w
        turns = torch.linalg.cross(arm, directions[..., None, :].expand_as(arm))
        turns = torch.einsum("bkij,bmki->bmkj", posed.rotations, turns).flatten(2)
        shapes = gather_points(posed.blended.flatten(2), index).unflatten(-1, (3, 3)) @ self._shapes[index]
        shapes = shapes + torch.einsum("bmk,bkil->bmil", weights, posed.joint_shapes)
        return torch.cat([turns, (directions[..., None, :] @ shapes).squeeze(-2), directions], -1)

    def _rows_on_cpu(self, posed: PosedSurface, index: Tensor, directions: Tensor) -> Tensor:
        from ljn.refinement import kernels  # numba takes its time to import

        out = torch.empty(*index.shape, NUM_CHANGES, dtype=directions.dtype)
        fields = (
            *(index, directions, posed.unposed, posed.blended, posed.rotations, posed.offsets, posed.joints),
            *(posed.joint_shapes, self._weights, self._shapes, out),
        )
        kernels.jacobian_rows(*(field.detach().contiguous().numpy() for field in fields))
        return out


def _vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Unit normals `(V, 3)`, each the sum of its faces', which count by their area."""
    corners = vertices[faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sums = torch.zeros_like(vertices)
    for corner in range(3):
        sums.index_add_(0, faces[:, corner], normals)
    return normalize(sums, dim=-1)
