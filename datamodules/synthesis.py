"""From a pose record to a training sample: mesh, depth image, noisy cloud with normals, initial joints."""

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from datamodules.noise import JOINT_NOISES, add_depth_noise, add_joint_noise, add_keypoint_noise
from datamodules.placement import HEADINGS, check_margin, draw_heading, place
from datamodules.sources import PoseRecords
from ljn.body import SMPL, BodyModel
from ljn.body.skeleton import NUM_JOINTS
from ljn.cloud.observation import ObservationRecipe, observe, stack_observations
from ljn.data import Batch
from ljn.geometry.camera import Camera, project
from ljn.geometry.rotations import CAMERA_FROM_BODY, rotation_about, rotmat_to_rotvec, rotvec_to_rotmat
from ljn.pipeline.keypoints import fill_missing
from ljn.render import RENDERERS, Renderer, get_renderer

# Each purpose has a generator of its own: changing one (the number of points, a sigma) leaves the others' draws.
_PLACEMENT, _DEPTH_NOISE, _SAMPLING, _KEYPOINTS, _JOINTS, _MISSING, _CAMERA = range(7)

SAMPLES_VERSION = 1
"""Raised with every change of the samples made of the same records: results are comparable within a version only."""
INITIAL_JOINTS = ("lifted", "noised")


@dataclass(frozen=True)
class SynthesisSettings:
    """How a pose becomes a sample.

    Attributes:
        heading: `histogram`, `uniform` or `source`; see `draw_heading`.
        distance_m: Range of the depth of the body's centre, metres.
        margin_px: Clear border around the body, pixels.
        depth_noise_m: Standard deviation of the depth noise, metres.
        keypoint_noise_px: Standard deviation of the keypoints' noise, pixels; of a sample with another focal length in
            proportion to it.
        missing_keypoints: Shares of the keypoints, one of which is missing in a sample, each keypoint by itself; those
            are filled in from the others.
        focal_factors: Range of each sample's focal length in the same image, as multiples of the camera's.
        pixel_factors: Range of each sample's number of pixels along a side, as multiples of the camera's.
        initial_joints: `lifted` (noisy keypoints with the depth at their pixels) or `noised` (true joints with
            noise).
        joint_noise_m: Standard deviation of the noise of `noised`, metres.
        joint_noise: Its directions: `planar` (the camera's x and y) or `isotropic`.
        renderer: A name that `ljn.render.get_renderer` knows.
    """

    heading: str = "histogram"
    distance_m: tuple[float, float] = (1.5, 3.0)
    margin_px: float = 8.0
    depth_noise_m: float = 0.001
    keypoint_noise_px: float = 10.0
    missing_keypoints: tuple[float, ...] = (0.0,)
    focal_factors: tuple[float, float] = (1.0, 1.0)
    pixel_factors: tuple[float, float] = (1.0, 1.0)
    initial_joints: str = "lifted"
    joint_noise_m: float = 0.02
    joint_noise: str = "planar"
    renderer: str = "auto"

    def __post_init__(self) -> None:
        choices = {
            "heading": HEADINGS,
            "initial_joints": INITIAL_JOINTS,
            "joint_noise": JOINT_NOISES,
            "renderer": RENDERERS,
        }
        for name, known in choices.items():
            if getattr(self, name) not in known:
                raise ValueError(f"{name}: expected one of {', '.join(known)}, got '{getattr(self, name)}'")
        for name in ("distance_m", "focal_factors", "pixel_factors"):
            values = getattr(self, name)
            if not isinstance(values, Sequence) or len(values) != 2:
                raise ValueError(f"{name}: expected two numbers, lowest and highest, got {values!r}")
            if not 0 < values[0] <= values[1]:
                raise ValueError(f"{name}: expected 0 < lowest <= highest, got {values}")
            object.__setattr__(self, name, tuple(map(float, values)))
        for name in ("margin_px", "depth_noise_m", "keypoint_noise_px", "joint_noise_m"):
            value = getattr(self, name)
            if not (isinstance(value, int | float) and math.isfinite(value) and value >= 0):
                raise ValueError(f"{name}: expected a number of 0 or more, got {value!r}")
            object.__setattr__(self, name, float(value))  # so that 10 and 10.0 make the same set of samples
        shares = self.missing_keypoints
        if not isinstance(shares, Sequence) or not shares or not all(0 <= share <= 1 for share in shares):
            raise ValueError(
                f"missing_keypoints: expected shares between 0 and 1, as in [0, 0.5], got {shares!r}"
            )
        object.__setattr__(self, "missing_keypoints", tuple(map(float, shares)))

    def smallest(self, camera: Camera) -> Camera:
        """The camera with the smallest image and the narrowest view that a sample may have."""
        return _varied(camera, self.focal_factors[1], self.pixel_factors[0])

    def densest_focal_px(self, camera: Camera) -> float:
        """The longest focal length that a sample may have, pixels."""
        return camera.fx * self.focal_factors[1] * self.pixel_factors[1]


class DepthSynthesizer:
    """Renders samples of a table of records; cheap to build and to send to a worker process.

    The body layer and the renderer are made on first use, in the process that uses them.

    Args:
        records: The poses and shapes.
        bodies: A body for each gender among the records.
        camera: The depth camera.
        settings: See `SynthesisSettings`.
        recipe: How depth images are observed.
        takes: What of an observation is made beside keypoints and initial joints: see `ljn.cloud.observation.PARTS`.
        seed_key: What the random draws depend on, beside a sample's epoch and index: a seed and a split number.
        dtype: Precision of the body; float64 makes fixed sets agree across machines.
    """

    def __init__(
        self,
        records: PoseRecords,
        bodies: Sequence[BodyModel],
        camera: Camera,
        settings: SynthesisSettings,
        recipe: ObservationRecipe,
        takes: Collection[str],
        seed_key: tuple[int, int],
        dtype: torch.dtype = torch.float32,
    ) -> None:
        if settings.heading == "source" and not records.has_heading:
            raise ValueError(
                "heading: these poses carry no heading of their own; use 'histogram' or 'uniform'"
            )
        check_margin(settings.smallest(camera), settings.margin_px)
        self.records = records
        self.bodies = bodies
        self.camera = camera
        self.settings = settings
        self.recipe = recipe
        self.takes = {*takes, "keypoints", "initial_joints"}
        self.seed_key = seed_key
        self.dtype = dtype

    def __getstate__(self) -> dict[str, Any]:
        lazy = ("_smpl", "_renderer")
        return {name: value for name, value in self.__dict__.items() if name not in lazy}

    @cached_property
    def _smpl(self) -> SMPL:
        return SMPL(self.bodies).to(self.dtype)

    @cached_property
    def _renderer(self) -> Renderer:
        return get_renderer(self.settings.renderer)

    def _rng(self, epoch: int, index: int, purpose: int) -> np.random.Generator:
        return np.random.default_rng([*self.seed_key, epoch, index, purpose])

    def batch(self, keys: Sequence[tuple[int, int]]) -> Batch:
        """The samples of `keys`, each an epoch and a record's index.

        A sample depends on its key alone; in float32 up to the rounding of products over a batch.
        """
        return self._observe(keys, self._render(keys))

    def examples(self, keys: Sequence[tuple[int, int]]) -> tuple[Batch, Tensor]:
        """The samples of `keys` with the noisy depth images `(B, H, W)`, metres, that they were taken from.

        Smaller images lie in the upper left corner.
        """
        scene = self._render(keys)
        depth = torch.zeros(len(keys), *np.max([image.shape for image in scene.depth], 0))
        for whole, image in zip(depth, scene.depth):
            whole[: image.shape[0], : image.shape[1]] = torch.from_numpy(image)
        return self._observe(keys, scene), depth

    @torch.no_grad()
    def _render(self, keys: Sequence[tuple[int, int]]) -> "_Scene":
        """Pose the bodies, place them before the camera, take noisy depth images."""
        settings = self.settings
        cameras = [self._camera_of(*key) for key in keys]
        placement = [self._rng(epoch, index, _PLACEMENT) for epoch, index in keys]
        rows = [index for _, index in keys]
        pose = torch.from_numpy(self.records.pose[rows]).to(self.dtype)
        heading = torch.tensor([draw_heading(settings.heading, rng) for rng in placement], dtype=self.dtype)
        root = rotation_about("z", heading) @ rotvec_to_rotmat(pose[:, :3])
        pose = torch.cat([rotmat_to_rotvec(root), pose[:, 3:]], -1)
        betas = torch.from_numpy(self.records.betas[rows]).to(self.dtype)

        gender = torch.from_numpy(self.records.gender[rows])
        vertices, joints = self._smpl(pose, betas, gender)
        cam_from_body = CAMERA_FROM_BODY.to(self.dtype)
        vertices, joints = vertices @ cam_from_body.T, joints @ cam_from_body.T
        transl = torch.from_numpy(
            np.stack(
                [
                    place(mesh, camera, rng.random(3), settings.distance_m, settings.margin_px)
                    for mesh, camera, rng in zip(vertices.numpy(), cameras, placement)
                ]
            )
        ).to(self.dtype)
        vertices, joints = vertices + transl[:, None], joints + transl[:, None]

        depth = self._images(vertices, cameras)
        for image, (epoch, index) in zip(depth, keys):
            add_depth_noise(
                image, settings.depth_noise_m, self._rng(epoch, index, _DEPTH_NOISE), in_place=True
            )
        return _Scene(pose, betas, gender, joints, cameras, depth)

    def _camera_of(self, epoch: int, index: int) -> Camera:
        """The camera of a sample."""
        ranges = (self.settings.focal_factors, self.settings.pixel_factors)
        if all(low == high == 1 for low, high in ranges):
            return self.camera
        rng = self._rng(epoch, index, _CAMERA)
        factors = [math.exp(rng.uniform(math.log(low), math.log(high))) for low, high in ranges]
        return _varied(self.camera, *factors)

    def _images(self, vertices: Tensor, cameras: Sequence[Camera]) -> list[np.ndarray]:
        """The depth images of meshes, each by its camera: all at once where that is the same."""
        if len(set(cameras)) == 1:
            return list(self._renderer(vertices, self._smpl.faces, cameras[0]).numpy())
        return [
            self._renderer(mesh[None], self._smpl.faces, camera)[0].numpy()
            for mesh, camera in zip(vertices, cameras)
        ]

    def _observe(self, keys: Sequence[tuple[int, int]], scene: "_Scene") -> Batch:
        """Observe the depth images; add the truth."""
        settings = self.settings
        intrinsics = torch.stack([camera.intrinsics(self.dtype) for camera in scene.cameras])
        keypoints = project(scene.joints, intrinsics).float()
        observations = []
        for i, (epoch, index) in enumerate(keys):
            camera = scene.cameras[i]
            noise_px = settings.keypoint_noise_px * camera.fx / self.camera.fx
            noisy = add_keypoint_noise(keypoints[i].numpy(), noise_px, self._rng(epoch, index, _KEYPOINTS))
            kept, confidences = self._kept(noisy, epoch, index)
            sampling = self._rng(epoch, index, _SAMPLING)
            made = observe(scene.depth[i], camera, kept, self.recipe, self.takes, sampling, confidences)
            if settings.initial_joints == "noised":
                made["initial_joints"] = add_joint_noise(
                    scene.joints[i].numpy(),
                    settings.joint_noise_m,
                    settings.joint_noise,
                    self._rng(epoch, index, _JOINTS),
                )
            observations.append(made)
        return Batch(
            **stack_observations(observations),  # type: ignore[typeddict-item]
            true_keypoints=keypoints,
            joints=scene.joints.float(),
            pose=scene.pose.float(),
            betas=scene.betas.float(),
            gender=scene.gender,
            camera=intrinsics.float(),
            sample_id=torch.tensor([index for _, index in keys]),
        )

    def _kept(
        self, keypoints: np.ndarray, epoch: int, index: int
    ) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Keypoints, those that are missing filled in, and confidences; None where none is left."""
        if not any(self.settings.missing_keypoints):
            return keypoints, None
        rng = self._rng(epoch, index, _MISSING)
        is_kept = rng.random(NUM_JOINTS) >= rng.choice(self.settings.missing_keypoints)
        if not is_kept.any():
            return None, None
        return fill_missing(np.where(is_kept[:, None], keypoints, np.nan)), is_kept.astype(np.float32)


def _varied(camera: Camera, focal_factor: float, pixel_factor: float) -> Camera:
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


class _Scene(NamedTuple):
    """Bodies before their cameras: `(B, 72)`, `(B, 10)`, `(B,)`, `(B, 24, 3)`; noisy depth `(H, W)` each, metres."""

    pose: Tensor
    betas: Tensor
    gender: Tensor
    joints: Tensor
    cameras: list[Camera]
    depth: list[np.ndarray]


def concatenate(batches: Iterable[Batch], num_samples: int) -> dict[str, Tensor]:
    """Batches of `num_samples` samples in all, joined along their first dimension.

    Copied as they come: while it lives, a tensor from a worker process holds shared memory and an open file, of
    which there are few.
    """
    samples: dict[str, Tensor] = {}
    start = 0
    for batch in batches:
        stop = start + len(batch["sample_id"])
        for name, value in cast(dict[str, Tensor], batch).items():
            if name not in samples:
                samples[name] = value.new_empty((num_samples, *value.shape[1:]))
            samples[name][start:stop] = value
        start = stop
    assert start == num_samples
    return samples
