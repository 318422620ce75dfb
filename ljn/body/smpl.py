"""The SMPL layer (section 3.1): pose and shape in, vertices and joints out."""

from collections.abc import Callable, Sequence
from copy import copy
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from ljn.body.files import GENDERS, NUM_BETAS, BodyModel, load_body_model
from ljn.body.skeleton import LEVELS, NUM_JOINTS, PARENTS
from ljn.geometry.rotations import rotvec_to_rotmat

_LEVEL_SIZES = [len(level) for level in LEVELS]
_PLACE_IN_LEVEL = {joint: place for level in LEVELS for place, joint in enumerate(level)}
_SKINNED_AT_ONCE = 4

assert tuple(chain(*LEVELS)) == tuple(range(NUM_JOINTS)), "SMPL numbers its joints level by level"


class SMPLOutput(NamedTuple):
    """A posed body.

    Attributes:
        vertices: `(..., V, 3)`, metres, in the frame that the pose's first rotation leads into.
        joints: `(..., 24, 3)`, metres, same frame; the root stays at its rest position J_0(beta).
    """

    vertices: Tensor
    joints: Tensor


class SMPL(nn.Module):
    """Body meshes M(beta, theta) of Eq. 3.1-3.2, differentiable, for one body or several genders at once.

    It computes in the precision of its buffers (`.double()` for float64), under autocast too, since half
    precision would move vertices by millimetres (as TF32 would: leave torch's float32 matmul precision at "highest").
    The bodies are no part of its state dict: they may be licensed, and must not travel in a checkpoint. `hash` says
    which they were.

    Attributes:
        faces: `(F, 3)` long, vertex indices.
        num_vertices: V.
        genders: The genders loaded.
        hash: The body's hash; of several bodies, the sorted hashes joined by "-".
    """

    faces: Tensor
    _v_template: Tensor
    _directions: Tensor
    _J_template: Tensor
    _J_shapedirs: Tensor
    _weights: Tensor
    _parents: Tensor
    _places: Tensor

    def __init__(self, models: BodyModel | Sequence[BodyModel]) -> None:
        """Builds the layer of one body, or of bodies of different genders that share their faces."""
        super().__init__()
        models = [models] if isinstance(models, BodyModel) else list(models)
        self.genders = tuple(model.gender for model in models)
        if not models or len(set(self.genders)) < len(models):
            raise ValueError(f"models: expected one body for each gender, got genders {self.genders}")
        faces, self.num_vertices = models[0].faces, len(models[0].v_template)
        for model in models[1:]:
            if len(model.v_template) != self.num_vertices or not np.array_equal(model.faces, faces):
                raise ValueError(
                    f"models: expected bodies with the same faces, but those of {self.genders[0]} and "
                    f"{model.gender} differ; give bodies of one mesh topology"
                )
        self.hash = "-".join(sorted(model.hash for model in models))

        layouts = [_layout(model) for model in models]
        buffers = {name: torch.stack([layout[name] for layout in layouts]) for name in layouts[0]}
        buffers["faces"] = torch.tensor(faces)
        buffers["_parents"] = torch.tensor(PARENTS[1:])
        buffers["_places"] = torch.tensor([_PLACE_IN_LEVEL[parent] for parent in PARENTS[1:]])
        for name, buffer in buffers.items():
            self.register_buffer(name, buffer, persistent=False)

    @classmethod
    def load(cls, path: str | Path | None = None, gender: str = "neutral") -> "SMPL":
        """The layer of one model file, or of an embedded body; see `load_body_model`."""
        return cls(load_body_model(path, gender))

    def on_vertices(self, vertices: Tensor) -> "SMPL":
        """The layer that gives some of the vertices alone, and the same joints: for losses, where all are too many.

        Args:
            vertices: `(U,)` long, their indices.
        """
        layer = copy(self)
        layer._buffers = dict(self._buffers)
        layer.num_vertices = len(vertices)
        layer._buffers["_v_template"] = self._v_template.unflatten(-1, (3, -1))[..., vertices].flatten(-2)
        directions = self._directions.unflatten(-1, (3, -1))[..., vertices]
        layer._buffers["_directions"] = directions.flatten(-2).contiguous()
        layer._buffers["_weights"] = self._weights[..., vertices].contiguous()
        layer._buffers["faces"] = self.faces[:0]
        return layer

    def forward(self, pose: Tensor, betas: Tensor, gender: Tensor | None = None) -> SMPLOutput:
        """Posed vertices and joints.

        Args:
            pose: `(..., 72)`, 24 rotation vectors relative to the parent joint, radians. The first one leads
                from SMPL's rest frame into the output's frame.
            betas: `(..., 10)`, shape, in standard deviations of the body's own components.
            gender: `(...)` long, codes of `GENDERS`; may be left out where one body is loaded.

        Returns:
            Vertices `(..., V, 3)` and joints `(..., 24, 3)`, metres.
        """
        _check_shape("pose", pose, pose.shape[:-1], 3 * NUM_JOINTS)
        with torch.autocast(pose.device.type, enabled=False):
            rotvecs = pose.to(self._v_template.dtype).unflatten(-1, (NUM_JOINTS, 3))
            return self.from_rotmats(rotvec_to_rotmat(rotvecs), betas, gender)

    def from_rotmats(self, rotmats: Tensor, betas: Tensor, gender: Tensor | None = None) -> SMPLOutput:
        """Posed vertices and joints, from rotation matrices `(..., 24, 3, 3)` relative to the parent; see `forward`."""
        if rotmats.shape[-3:] != (NUM_JOINTS, 3, 3):
            raise ValueError(f"rotmats: expected shape (..., {NUM_JOINTS}, 3, 3), got {tuple(rotmats.shape)}")
        _check_shape("betas", betas, rotmats.shape[:-3], NUM_BETAS)
        vertices, joints = self._by_gender(self._pose, gender, betas, rotmats.flatten(-3))
        return SMPLOutput(vertices, joints)

    @property
    def skinning_weights(self) -> Tensor:
        """`(V, 24)`, how much each joint moves a vertex, of the first gender's body."""
        return self._weights[0].T

    def rest_joints(self, betas: Tensor, gender: Tensor | None = None) -> Tensor:
        """The joints J(beta) of the unposed body, `(..., 24, 3)`, metres, SMPL's rest frame; see `forward`."""
        _check_shape("betas", betas, betas.shape[:-1], NUM_BETAS)
        (joints,) = self._by_gender(lambda slot, flat: (self._rest_joints(slot, flat),), gender, betas)
        return joints

    @torch.no_grad()
    def fit_betas(self, vertices: Tensor) -> Tensor:
        """The shape `(..., 10)` whose rest mesh comes nearest to a mesh, by least squares; where one body is loaded.

        `vertices` are `(..., V, 3)`, metres, in rest pose (T-pose, SMPL's rest frame).

        Raises:
            ValueError: Several bodies are loaded, or the mesh has another number of vertices.
        """
        self._groups(None, torch.Size())
        if vertices.shape[-2:] != (self.num_vertices, 3):
            raise ValueError(
                f"vertices: expected (..., {self.num_vertices}, 3), got {tuple(vertices.shape)}: another mesh topology"
            )
        offset = vertices.mT.flatten(-2).double() - self._v_template[0].double()
        basis = self._directions[0][:NUM_BETAS].double()
        inverse = torch.linalg.inv(basis @ basis.T)
        return (offset @ basis.T @ inverse).to(vertices.dtype)

    def _by_gender(
        self, body: Callable[..., tuple[Tensor, ...]], gender: Tensor | None, *inputs: Tensor
    ) -> list[Tensor]:
        """Outputs of `body(slot, *inputs)` where each sample meets the buffers of its own gender."""
        leading = inputs[0].shape[:-1]
        slots, groups = self._groups(gender, leading)
        flat = [value.reshape(-1, value.shape[-1]).to(self._v_template.dtype) for value in inputs]
        with torch.autocast(flat[0].device.type, enabled=False):
            if len(slots) == 1:
                outputs = body(slots[0], *flat)
            else:
                parts = [body(slot, *(value[group] for value in flat)) for slot, group in zip(slots, groups)]
                order = torch.cat(groups).argsort()
                outputs = tuple(torch.cat(part)[order] for part in zip(*parts))
        return [output.unflatten(0, leading) if leading else output[0] for output in outputs]

    def _groups(self, gender: Tensor | None, leading: torch.Size) -> tuple[list[int], list[Tensor]]:
        """The bodies asked for, by their places in the buffers, and the flat indices of their samples."""
        if gender is None:
            if len(self.genders) > 1:
                raise ValueError(f"gender: expected codes, since several bodies are loaded: {self.genders}")
            return [0], []
        if gender.shape != leading:
            raise ValueError(f"gender: expected shape {tuple(leading)}, got {tuple(gender.shape)}")
        slots = {GENDERS[name]: slot for slot, name in enumerate(self.genders)}
        gender = gender.flatten()
        codes = gender.unique().tolist() or list(slots)[:1]
        if not slots.keys() >= set(codes):
            loaded = ", ".join(f"{GENDERS[name]} ({name})" for name in self.genders)
            raise ValueError(f"gender: expected codes of loaded bodies, {loaded}; got {codes}")
        return [slots[code] for code in codes], [(gender == code).nonzero().squeeze(-1) for code in codes]

    def _rest_joints(self, slot: int, betas: Tensor) -> Tensor:
        joints = torch.addmm(self._J_template[slot], betas, self._J_shapedirs[slot])
        return joints.unflatten(-1, (NUM_JOINTS, 3))

    def _pose(self, slot: int, betas: Tensor, rotmats: Tensor) -> tuple[Tensor, Tensor]:
        rotmats = rotmats.unflatten(-1, (NUM_JOINTS, 3, 3))
        rest_joints = self._rest_joints(slot, betas)
        transforms = self._forward_kinematics(rotmats, rest_joints)  # (B, 24, 3, 4)
        joints = transforms[..., 3]
        # Eq. 3.2: the shape's and the pose's offsets in one product.
        eye = torch.eye(3, dtype=rotmats.dtype, device=rotmats.device)
        features = torch.cat([betas, (rotmats[:, 1:] - eye).flatten(1)], dim=-1)
        unposed = self._unposed(slot, features).unflatten(-1, (3, -1))
        return self._skin(slot, unposed, transforms, rest_joints), joints

    def _unposed(self, slot: int, features: Tensor) -> Tensor:
        """Vertices `(B, 3V)` before they are skinned, of the betas and the pose's features `(B, 217)`."""
        return torch.addmm(self._v_template[slot], features, self._directions[slot])

    def _forward_kinematics(self, rotmats: Tensor, rest_joints: Tensor) -> Tensor:
        """Each joint's rotation and position, `(B, 24, 3, 4)`, all joints of a level at once."""
        parent_joints = pad(rest_joints.index_select(1, self._parents), (0, 0, 1, 0))  # (B, 24, 3)
        local = torch.cat([rotmats, (rest_joints - parent_joints)[..., None]], dim=-1)
        bottom = torch.eye(4, dtype=local.dtype, device=local.device)[3:].expand(*local.shape[:2], 1, 4)
        root, *levels = torch.cat([local, bottom], dim=-2).split(_LEVEL_SIZES, dim=1)
        world = [root]
        for level, places in zip(levels, self._places.split(_LEVEL_SIZES[1:])):
            world.append(world[-1].index_select(1, places) @ level)
        return torch.cat(world, dim=1)[:, :, :3]

    def _skin(self, slot: int, unposed: Tensor, transforms: Tensor, rest_joints: Tensor) -> Tensor:
        """W of Eq. 3.1: vertices `(B, V, 3)` moved by the weighted mean of the joints' transforms.

        Coordinates are `(B, 3, V)` throughout: with the vertices innermost this takes a quarter of the time on a CPU.
        There a few bodies at once stay in its cache, which gives the same numbers.
        """
        if len(unposed) > _SKINNED_AT_ONCE and unposed.device.type == "cpu" and not torch.is_grad_enabled():
            parts = zip(*(value.split(_SKINNED_AT_ONCE) for value in (unposed, transforms, rest_joints)))
            return torch.cat([self._skin(slot, *part) for part in parts])
        rotation, position = transforms.split([3, 1], dim=-1)
        relative = torch.cat([rotation, position - rotation @ rest_joints[..., None]], dim=-1)
        blended = relative.flatten(2).transpose(1, 2).reshape(-1, NUM_JOINTS) @ self._weights[slot]
        blended = blended.view(-1, 3, 4, self.num_vertices)
        homogeneous = pad(unposed, (0, 0, 0, 1), value=1.0)  # (B, 4, V)
        return (blended * homogeneous[:, None]).sum(2).transpose(1, 2).contiguous()


def _layout(model: BodyModel) -> dict[str, Tensor]:
    """A body's buffers: coordinates before vertices, contiguous as the matrix products want them."""
    template, shapedirs, posedirs = map(torch.tensor, (model.v_template, model.shapedirs, model.posedirs))
    J_regressor = torch.tensor(model.J_regressor, dtype=torch.float64)
    J_shapedirs = torch.einsum("jv,vck->kjc", J_regressor, shapedirs.double())
    return {
        "_v_template": template.T.flatten(),  # (3V)
        "_directions": torch.cat([shapedirs, posedirs], dim=-1).permute(2, 1, 0).flatten(1),  # (217, 3V)
        "_J_template": (J_regressor @ template.double()).flatten().float(),  # (72)
        "_J_shapedirs": J_shapedirs.flatten(1).float(),  # (10, 72)
        "_weights": torch.tensor(model.weights).T.contiguous(),  # (24, V)
    }


def _check_shape(name: str, value: Tensor, leading: torch.Size, last: int) -> None:
    expected = (*leading, last)
    if value.shape != expected:
        raise ValueError(f"{name}: expected shape {expected}, got {tuple(value.shape)}")
