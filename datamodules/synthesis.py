"""From a pose record to a training sample: mesh, depth image, noisy cloud with normals, initial joints."""

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from datamodules.noise import JOINT_NOISES, add_depth_noise, add_joint_noise, add_keypoint_noise
from datamodules.placement import HEADINGS
from datamodules.posing import BodySynthesizer, SampleKey
from datamodules.scenes import KeptScenes, Scene, mirrored
from datamodules.sensor import Sensor
from datamodules.sources import ImageSource, PoseRecords
from ljn.body import BodyModel
from ljn.body.skeleton import NUM_JOINTS
from ljn.cloud.observation import ObservationRecipe, observe, stack_observations
from ljn.data import Batch
from ljn.geometry.camera import Camera, project
from ljn.pipeline.filling import fill_missing
from ljn.render import RENDERERS, Renderer, get_renderer

_DEPTH_NOISE, _SAMPLING, _KEYPOINTS, _JOINTS, _MISSING, _SENSOR = 1, 2, 3, 4, 5, 8  # see datamodules.posing

SAMPLES_VERSION = 1
"""Raised with every change of the samples made of the same records: results are comparable within a version only."""
INITIAL_JOINTS = ("lifted", "noised")


def is_mirrored(key: SampleKey) -> bool:
    """Whether a sample shows its render mirrored: every second use does."""
    return sum(key[2:]) % 2 == 1


@dataclass(frozen=True)
class SynthesisSettings:
    """How a pose becomes a sample.

    Attributes:
        heading: `histogram`, `uniform` or `source`; see `draw_heading`. All but `source` take the place of a heading
            that was recorded.
        distance_m: Range of the depth of the body's centre, metres.
        margin_px: Clear border around the body, pixels.
        depth_noise_m: Standard deviation of the depth noise of the sensor `gaussian`, metres; others have their own.
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

    def densest_focal_px(self, camera: Camera) -> float:
        """The longest focal length that a sample may have, pixels."""
        return camera.fx * self.focal_factors[1] * self.pixel_factors[1]


class DepthSynthesizer(BodySynthesizer):
    """Renders samples of a table of records, seen by a depth camera.

    Args:
        records: The poses and shapes.
        bodies: A body for each gender among the records.
        camera: The depth camera.
        settings: See `SynthesisSettings`.
        recipe: How depth images are observed.
        takes: What of an observation is made beside keypoints and initial joints: see `ljn.cloud.observation.PARTS`.
            Where none of it comes from a depth image, none is rendered.
        seed_key: See `BodySynthesizer`.
        dtype: See `BodySynthesizer`.
        num_kept: How many batches' renders are kept, for batches of the same bodies to come.
        sensor: What becomes of bodies and images before they are observed; None for `gaussian`, the thesis's: noise of
            `settings.depth_noise_m` on the body, and nothing else.
    """

    lazy = ("_smpl", "_renderer", "_kept")

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
        num_kept: int = 0,
        sensor: Sensor | None = None,
    ) -> None:
        super().__init__(records, bodies, camera, settings, seed_key, dtype, sensor)
        self.settings = settings
        self.recipe = recipe
        self.takes = {*takes, "keypoints", "initial_joints"}
        self.num_kept = num_kept

    @cached_property
    def _renderer(self) -> Renderer:
        return get_renderer(self.settings.renderer)

    @cached_property
    def _kept(self) -> KeptScenes:
        return KeptScenes(self.num_kept)

    def batch(self, keys: Sequence[SampleKey]) -> Batch:
        """See `BodySynthesizer`."""
        rendered, which = tuple(key[:2] for key in keys), [is_mirrored(key) for key in keys]
        scene = self._kept.get(rendered, which)
        if scene is None:
            scene = self._render(rendered, self._takes_image)
            self._kept.put(rendered, scene)
            scene = mirrored(scene, which)
        return self._observe(keys, self._with_noise(keys, scene))

    def examples(self, keys: Sequence[SampleKey]) -> tuple[Batch, Tensor]:
        """The samples of `keys` with the noisy depth images `(B, H, W)`, metres, that they were taken from.

        Smaller images lie in the upper left corner.
        """
        scene = self._render([key[:2] for key in keys], with_depth=True)
        scene = self._with_noise(keys, mirrored(scene, [is_mirrored(key) for key in keys]))
        depth = torch.zeros(len(keys), *np.max([image.shape for image in scene.depth], 0))
        for whole, image in zip(depth, scene.depth):
            whole[: image.shape[0], : image.shape[1]] = torch.from_numpy(image)
        return self._observe(keys, scene), depth

    @property
    def _seen(self) -> frozenset[str]:
        """What is made by `observe`; joints with noise are not."""
        return frozenset(
            self.takes - ({"initial_joints"} if self.settings.initial_joints == "noised" else set())
        )

    @property
    def _takes_image(self) -> bool:
        """Whether anything that is taken comes from a depth image."""
        return bool(self._seen - {"keypoints", "confidences"})

    def _render(self, keys: Sequence[SampleKey], with_depth: bool) -> Scene:
        """The bodies before their cameras, rendered where depth is wanted."""
        posed = self._posed(keys, is_dressed=with_depth)
        if with_depth:
            depth = self._images(posed.vertices, posed.cameras)
        else:
            depth = [np.zeros((0, 0), np.float32)] * len(keys)
        return Scene(posed.pose, posed.betas, posed.gender, posed.joints, posed.cameras, depth)

    def _images(self, vertices: Tensor, cameras: Sequence[Camera]) -> list[np.ndarray]:
        """The depth images of meshes, each by its camera: all at once where that is the same."""
        if len(set(cameras)) == 1:
            return list(self._renderer(vertices, self._smpl.faces, cameras[0]).numpy())
        return [
            self._renderer(mesh[None], self._smpl.faces, camera)[0].numpy()
            for mesh, camera in zip(vertices, cameras)
        ]

    def _with_noise(self, keys: Sequence[SampleKey], scene: Scene) -> Scene:
        """The scene, its images as the sensor takes them; in place."""
        for i, (image, key) in enumerate(zip(scene.depth, keys)):
            if self.sensor is None:
                add_depth_noise(
                    image, self.settings.depth_noise_m, self._rng(key, _DEPTH_NOISE), in_place=True
                )
            else:
                self.sensor.expose(image, scene.cameras[i], scene.joints[i].numpy(), self._seed(key, _SENSOR))
        return scene

    def _observe(self, keys: Sequence[SampleKey], scene: Scene) -> Batch:
        """Observe the depth images; add the truth."""
        settings = self.settings
        intrinsics = torch.stack([camera.intrinsics(self.dtype) for camera in scene.cameras])
        keypoints = project(scene.joints, intrinsics).float()
        observations = []
        for i, (key, camera) in enumerate(zip(keys, scene.cameras)):
            noise_px = settings.keypoint_noise_px * camera.fx / self.camera.fx
            noisy = add_keypoint_noise(keypoints[i].numpy(), noise_px, self._rng(key, _KEYPOINTS))
            left, confidences = self._left(noisy, key)
            sampling = self._rng(key, _SAMPLING)
            made = observe(scene.depth[i], camera, left, self.recipe, self._seen, sampling, confidences)
            if settings.initial_joints == "noised":
                made["initial_joints"] = add_joint_noise(
                    scene.joints[i].numpy(),
                    settings.joint_noise_m,
                    settings.joint_noise,
                    self._rng(key, _JOINTS),
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
            sample_id=torch.tensor([index for _, index, *_ in keys]),
        )

    def _left(self, keypoints: np.ndarray, key: SampleKey) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Keypoints, those that are missing filled in, and confidences; None where none is left."""
        if not any(self.settings.missing_keypoints):
            return keypoints, None
        rng = self._rng(key, _MISSING)
        is_left = rng.random(NUM_JOINTS) >= rng.choice(self.settings.missing_keypoints)
        if not is_left.any():
            return None, None
        return fill_missing(np.where(is_left[:, None], keypoints, np.nan)), is_left.astype(np.float32)


class RecordedSynthesizer(DepthSynthesizer):
    """Samples of records that have depth images of their own: these are seen as they are, without anything added.

    Args:
        source: Where the images come from.
        records: Its records.
        others: As `DepthSynthesizer`; of the settings, those of keypoints and joints count.
    """

    def __init__(self, source: ImageSource, records: PoseRecords, *others: Any) -> None:
        super().__init__(records, *others)
        self.records = records  # with the headings that the images show
        self.source = source

    def _render(self, keys: Sequence[SampleKey], with_depth: bool) -> Scene:
        return self.source.scene(self.records, [index for _, index in keys], with_depth)

    def _with_noise(self, keys: Sequence[SampleKey], scene: Scene) -> Scene:
        return scene


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
