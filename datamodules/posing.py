"""Bodies of a table of records, posed and placed before their cameras: what all rendered samples begin with."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from datamodules.placement import check_margin, draw_heading, place
from datamodules.sensor import Sensor
from datamodules.sources import PoseRecords
from ljn.body import GENDERS, SMPL, BodyModel, SparseSMPL
from ljn.data import Batch
from ljn.geometry.camera import Camera
from ljn.geometry.rotations import body_to_camera, rotation_about, rotmat_to_rotvec, rotvec_to_rotmat

PLACEMENT, CAMERA, PERSON = 0, 6, 7
"""Numbers of purposes. Each purpose has a generator of its own: changing one leaves the others' draws. Those of depth
images are in `datamodules.synthesis`, those of colour in `datamodules.rgb`.
"""

SampleKey = tuple[int, ...]
"""An epoch, a record's index and, where a render is used again, the number of that use; without it, the first, 0."""


class Placing(Protocol):
    """What settings say of how bodies come before their cameras; see `SynthesisSettings`."""

    @property
    def heading(self) -> str: ...  # noqa: D102

    @property
    def distance_m(self) -> tuple[float, float]: ...  # noqa: D102

    @property
    def margin_px(self) -> float: ...  # noqa: D102

    @property
    def focal_factors(self) -> tuple[float, float]: ...  # noqa: D102

    @property
    def pixel_factors(self) -> tuple[float, float]: ...  # noqa: D102


class Posed(NamedTuple):
    """Bodies before their cameras.

    Attributes:
        pose: `(B, 72)`, axis-angle in body world, radians.
        betas: `(B, 10)`.
        gender: `(B,)` int64.
        vertices: `(B, V, 3)`, metres, camera frame.
        joints: `(B, 24, 3)`, metres, camera frame.
        cameras: The camera of each.
    """

    pose: Tensor
    betas: Tensor
    gender: Tensor
    vertices: Tensor
    joints: Tensor
    cameras: Sequence[Camera]


class BodySynthesizer(ABC):
    """Makes samples of a table of records; cheap to build and to send to a worker process.

    The body layer is made on first use, in the process that uses it, as are other things that a subclass names in
    `lazy`.

    Args:
        records: The poses and shapes.
        bodies: A body for each gender among the records.
        camera: The camera.
        settings: How bodies come before it.
        seed_key: What the random draws depend on, beside a sample's epoch and index: a seed and a split number.
        dtype: Precision of the body; float64 makes fixed sets agree across machines.
        sensor: What becomes of bodies and images; None for nothing.
    """

    lazy: tuple[str, ...] = ("_smpl",)

    def __init__(
        self,
        records: PoseRecords,
        bodies: Sequence[BodyModel],
        camera: Camera,
        settings: Placing,
        seed_key: tuple[int, int],
        dtype: torch.dtype = torch.float32,
        sensor: Sensor | None = None,
    ) -> None:
        if settings.heading == "source" and not records.has_heading:
            raise ValueError(
                "heading: these poses carry no heading of their own; use 'histogram' or 'uniform'"
            )
        check_margin(smallest_camera(camera, settings), settings.margin_px)
        self.records = records if settings.heading == "source" else records.without_heading()
        self.bodies = bodies
        self.camera = camera
        self.placing = settings
        self.seed_key = seed_key
        self.dtype = dtype
        self.sensor = sensor

    @abstractmethod
    def batch(self, keys: Sequence[SampleKey]) -> Batch:
        """The samples of `keys`.

        A sample depends on its key alone; in float32 up to the rounding of products over a batch.
        """

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in self.lazy}

    @cached_property
    def _smpl(self) -> SMPL:
        return SparseSMPL(self.bodies).to(self.dtype)

    def _rng(self, key: SampleKey, purpose: int) -> np.random.Generator:
        return np.random.default_rng(self._seed(key, purpose))

    def _seed(self, key: SampleKey, purpose: int) -> list[int]:
        epoch, index, *use = key
        return [*self.seed_key, epoch, index, purpose, *(use if any(use) else ())]

    @torch.no_grad()
    def _posed(self, keys: Sequence[SampleKey], is_dressed: bool) -> Posed:
        """Pose the bodies, place them before their cameras and, where that is wanted, dress them."""
        settings = self.placing
        cameras = [self._camera_of(key) for key in keys]
        placement = [self._rng(key, PLACEMENT) for key in keys]
        rows = [key[1] for key in keys]
        pose = torch.from_numpy(self.records.pose[rows]).to(self.dtype)
        heading = torch.tensor([draw_heading(settings.heading, rng) for rng in placement], dtype=self.dtype)
        root = rotation_about("z", heading) @ rotvec_to_rotmat(pose[:, :3])
        betas = torch.from_numpy(self.records.betas[rows]).to(self.dtype)
        root, betas = self._as_seen(keys, root, betas)
        pose = torch.cat([rotmat_to_rotvec(root), pose[:, 3:]], -1)

        gender = torch.from_numpy(self.records.gender[rows])
        vertices, joints = self._smpl(pose, betas, gender)
        vertices, joints = body_to_camera(vertices), body_to_camera(joints)
        transl = torch.from_numpy(
            np.stack(
                [
                    place(mesh, camera, rng.random(3), settings.distance_m, settings.margin_px)
                    for mesh, camera, rng in zip(vertices.numpy(), cameras, placement)
                ]
            )
        ).to(self.dtype)
        if is_dressed and self.sensor is not None:  # in their places, which clothes do not change
            for mesh, key, code in zip(vertices.numpy(), keys, gender.tolist()):
                self.sensor.dress(mesh, self._body_of[code], self._seed(key, PERSON))
        return Posed(pose, betas, gender, vertices + transl[:, None], joints + transl[:, None], cameras)

    def _as_seen(self, keys: Sequence[SampleKey], root: Tensor, betas: Tensor) -> tuple[Tensor, Tensor]:
        """The roots' rotations `(B, 3, 3)` and shapes `(B, 10)` that the sensor makes of others."""
        if self.sensor is None:
            return root, betas
        root, betas = root.clone(), betas.clone()
        for i, key in enumerate(keys):
            seed = self._seed(key, PERSON)
            turned = self.sensor.turn(seed)
            if turned is not None:
                root[i] = torch.from_numpy(turned).to(root) @ root[i]
            betas[i] = torch.from_numpy(self.sensor.shape(betas[i].numpy(), seed)).to(betas)
        return root, betas

    @cached_property
    def _body_of(self) -> dict[int, BodyModel]:
        """The body of each gender's code."""
        return {GENDERS[body.gender]: body for body in self.bodies}

    def _camera_of(self, key: SampleKey) -> Camera:
        """The camera of a sample."""
        ranges = (self.placing.focal_factors, self.placing.pixel_factors)
        if all(low == high == 1 for low, high in ranges):
            return self.camera
        rng = self._rng(key, CAMERA)
        factors = [math.exp(rng.uniform(math.log(low), math.log(high))) for low, high in ranges]
        return varied_camera(self.camera, *factors)


def smallest_camera(camera: Camera, settings: Placing) -> Camera:
    """The camera with the smallest image and the narrowest view that a sample may have."""
    return varied_camera(camera, settings.focal_factors[1], settings.pixel_factors[0])


def varied_camera(camera: Camera, focal_factor: float, pixel_factor: float) -> Camera:
    """A camera with another focal length in an image of the same shape, then with another number of pixels."""
    width, height = (max(1, round(size * pixel_factor)) for size in (camera.width, camera.height))
    along_u, along_v = width / camera.width, height / camera.height
    return Camera(
        camera.fx * focal_factor * along_u,
        camera.fy * focal_factor * along_v,
        (camera.cx + 0.5) * along_u - 0.5,
        (camera.cy + 0.5) * along_v - 0.5,
        width,
        height,
    )
