"""The loaded bodies in SURREAL's clips: whether they are the ones that it was made with, and shapes that come near."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from datamodules.sources.surreal.files import FilmedClip
from datamodules.sources.surreal.world import CAMERA, filmed_pose, to_camera, turned_pose
from ljn.body import GENDERS, SMPL, BodyModel, SparseSMPL
from ljn.body.kinematics import joint_positions, world_rotations
from ljn.body.skeleton import NUM_JOINTS, PARENTS, ROOT
from ljn.geometry.rotations import body_to_camera, rotvec_to_rotmat
from ljn.render import get_renderer

_SHAPE_PRIOR = 0.02**2  # of joints known within 2 cm, against shape coefficients of standard deviation 1
_OUTLIER_M = 0.15


class ClipBodies:
    """The bodies of a data module, posed as SURREAL's clips say.

    Args:
        bodies: Female and male, or one for all.
    """

    def __init__(self, bodies: Sequence[BodyModel]) -> None:
        self._layer: SMPL = SparseSMPL(bodies).double()
        self._only = GENDERS[bodies[0].gender] if len(bodies) == 1 else None

    def joints(self, clip: FilmedClip, frames: np.ndarray) -> np.ndarray:
        """Joints `(n, 24, 3)`, metres, SURREAL's world, of the bodies of some frames; their roots are the file's."""
        offsets = _offsets(self._layer.rest_joints(_double(clip.betas[frames]), self._gender(clip, frames)))
        return joint_positions(_rotations(clip, frames), offsets).numpy() + clip.joints[frames][:, ROOT, None]

    def errors_m(self, clip: FilmedClip, frames: np.ndarray) -> np.ndarray:
        """`(n, 24)`, metres: from the bodies' joints to the file's."""
        return np.linalg.norm(self.joints(clip, frames) - clip.joints[frames], axis=-1)

    def fitted_betas(self, clip: FilmedClip, frames: np.ndarray) -> np.ndarray:
        """The one shape `(10,)` with which the bodies' joints come nearest to the file's in these frames.

        Posed joints are linear in the shape: least squares, with the shape's own standard deviation of 1.
        """
        basis = torch.cat([torch.zeros(1, 10), torch.eye(10)]).double()
        gender = self._gender(clip, frames)[:1].expand(len(basis))
        rotations = _rotations(clip, frames)
        rest = _offsets(self._layer.rest_joints(basis, gender))
        made = torch.stack([joint_positions(rotations, offsets).flatten() for offsets in rest], -1)
        columns = made[:, 1:] - made[:, :1]
        target = (
            torch.from_numpy(clip.joints[frames] - clip.joints[frames][:, ROOT, None]).flatten() - made[:, 0]
        )
        normal = columns.T @ columns + _SHAPE_PRIOR * torch.eye(10, dtype=torch.float64)
        return torch.linalg.solve(normal, columns.T @ target).numpy()

    def rendered(self, clip: FilmedClip, frames: np.ndarray) -> np.ndarray:
        """Planar depth `(n, 240, 320)`, metres, of the bodies of some frames, as the images turned back show them."""
        pose = torch.from_numpy(turned_pose(clip.pose[frames], clip.zrot[frames]))
        vertices, joints = self._layer(pose, _double(clip.betas[frames]), self._gender(clip, frames))
        root = torch.from_numpy(to_camera(clip.joints[frames][:, ROOT], clip.camera_place))
        placed = body_to_camera(vertices - joints[:, ROOT, None]) + root[:, None]
        return get_renderer("auto")(placed, self._layer.faces, CAMERA).numpy()

    def _gender(self, clip: FilmedClip, frames: np.ndarray) -> Tensor:
        gender = torch.from_numpy(clip.gender[frames])
        return gender if self._only is None else torch.full_like(gender, self._only)


def lengthening() -> np.ndarray:
    """By what factor a pixel's ray is longer than the depth along the axis, `(240, 320)`: sqrt(1 + x^2 + y^2)."""
    u = (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx
    v = (np.arange(CAMERA.height) - CAMERA.cy) / CAMERA.fy
    return np.sqrt(1 + u**2 + v[:, None] ** 2)


def radial_share(measured: Sequence[np.ndarray], rendered: Sequence[np.ndarray]) -> float:
    """How much of a ray's greater length than the planar depth is in measured depth: 0 of planar, 1 of radial images.

    The slope, by least squares, of the difference between measured and rendered planar depth over what a ray is longer;
    each image's own mean is taken off both, since bodies are never quite the same. Images `(240, 320)` in metres, 0 is
    background. NaN where no pixel is of both.
    """
    factor = lengthening() - 1
    products = squares = 0.0
    for seen, made in zip(measured, rendered):
        is_both = (seen > 0) & (made > 0) & (np.abs(seen - made) < _OUTLIER_M)
        if not is_both.any():
            continue
        longer = (made * factor)[is_both]
        longer -= longer.mean()
        products += float(longer @ (seen - made)[is_both])
        squares += float(longer @ longer)
    return products / squares if squares else float("nan")


def _double(values: np.ndarray) -> Tensor:
    return torch.from_numpy(values.astype(np.float64))


def _rotations(clip: FilmedClip, frames: np.ndarray) -> Tensor:
    """From the rest frame into SURREAL's world, `(n, 24, 3, 3)`."""
    pose = torch.from_numpy(filmed_pose(clip.pose[frames], clip.zrot[frames]))
    return world_rotations(rotvec_to_rotmat(pose.unflatten(-1, (NUM_JOINTS, 3))))


def _offsets(rest: Tensor) -> Tensor:
    """Joints relative to their parents, `(..., 24, 3)`; zero of the root."""
    return rest - rest[..., [max(parent, ROOT) for parent in PARENTS], :]
