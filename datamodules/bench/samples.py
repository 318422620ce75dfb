"""The benchmark's samples: rendered once, kept clean, and seen anew under each condition."""

import hashlib
from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from datamodules.bench.definition import CHUNK, PATH, VERSION, Definition, Poser, read_definition
from datamodules.cache import cached_samples
from datamodules.noise import add_depth_noise, add_joint_noise, add_keypoint_noise
from datamodules.sensor import Sensor
from ljn.benchmark.conditions import REFERENCE_FOCAL_PX, Condition
from ljn.benchmark.frames import BenchFrame, BenchTruth
from ljn.body import GENDERS
from ljn.body.skeleton import NUM_JOINTS
from ljn.cloud.observation import body_box
from ljn.geometry.camera import Camera, project
from ljn.geometry.rotations import rotvec_to_rotmat
from ljn.render import Renderer, get_renderer

DEPTH_NOISE_M = 0.001
"""Standard deviation of the base condition's noise, metres."""
VISIBLE_M = 0.15
"""How far before a visible joint the surface at its pixel may be, metres."""
_STEPS_PER_METRE = 2.0**16
"""Clean depth is rounded to these, 15 micrometres: a last bit that differs between machines then changes nothing."""
_FORM = 1
"""Raised with every change of what this file makes of a definition."""
_DEPTH_NOISE, _KEYPOINTS, _MISSING, _JOINTS, _OCCLUSION, _SENSOR = range(6)
_DISTANCES_M = (2, 3, 4)
_HEADINGS_DEG = (45, 90, 135)
_HEIGHTS_PX = (50, 100, 200, 300)


class BenchSamples:
    """Samples of a definition. See `ljn.benchmark.frames.BenchSamples`.

    A sample's draws come from its own seed, one stream for each purpose, so its frame under a condition is the same
    whatever else is made, in however many threads.

    Args:
        cache_dir: Where meshes, joints and clean depth images are kept once they are made, some 0.15 MB a sample.
        path: Another definition's file, of the same form; None: the benchmark that ships.
        num_samples: The first so many samples; None: all.
        sensors: Sensors by name, as `data/sensor=NAME` configures them: a `Sensor`, or a mapping with one as `sensor`.
            Of their steps, those that change the pose, the shape or the camera count for nothing here.
    """

    def __init__(
        self,
        cache_dir: str | Path,
        path: str | Path | None = None,
        num_samples: int | None = None,
        sensors: Mapping[str, Any] | None = None,
    ) -> None:
        self.cache_dir = Path(cache_dir)
        self._sensors: dict[str, Sensor] = {
            name: each if isinstance(each, Sensor) else each["sensor"]
            for name, each in (sensors or {}).items()
        }
        self.path = Path(path or PATH)
        self.num_samples = num_samples
        if num_samples is not None and (not isinstance(num_samples, int) or num_samples < 1):
            raise ValueError(
                f"num_samples: expected a whole number of 1 or more, or null, got {num_samples!r}"
            )

    @cached_property
    def definition(self) -> Definition:
        """The samples' numbers."""
        definition = read_definition(self.path)
        if (self.num_samples or 0) > len(definition):
            raise ValueError(
                f"num_samples: '{self.path}' has {len(definition)} samples, got {self.num_samples}; ask for fewer"
            )
        return definition.first(self.num_samples or len(definition))

    @property
    def name(self) -> str:
        """Its version; of another definition, the file's stem."""
        return VERSION if self.path == PATH else self.path.stem

    @cached_property
    def _poser(self) -> Poser:
        return Poser()

    @cached_property
    def _bodies(self) -> list[str]:
        return [body.hash for body in self._poser.bodies]

    @property
    def facts(self) -> Mapping[str, Any]:
        """See `ljn.benchmark.frames.BenchSamples`."""
        return {
            "benchmark": self.name,
            "samples": len(self),
            "definition": self.definition.hash,
            "depth images": self.depth_hash,
        }

    @property
    def sensors(self) -> Sequence[str]:
        """See `ljn.benchmark.frames.BenchSamples`."""
        return tuple(self._sensors)

    def __len__(self) -> int:
        return len(self.definition)

    def first(self, num_samples: int) -> Self:
        """See `ljn.benchmark.frames.BenchSamples`."""
        return type(self)(self.cache_dir, self.path, num_samples, self._sensors)

    def identity(self, condition: Condition) -> dict[str, Any]:
        """See `ljn.benchmark.frames.BenchSamples`."""
        made_of = {"definition": self.definition.hash, "bodies": self._bodies, "form": _FORM}
        if condition.sensor is not None:
            made_of["sensor_settings"] = repr(self._sensors[condition.sensor])
        return {**made_of, **condition.changes}

    @cached_property
    def _made(self) -> dict[str, Tensor]:
        made_of = f"{_FORM} {self.definition.hash} {self._bodies}"
        key = f"bench-{hashlib.sha256(made_of.encode()).hexdigest()[:16]}"
        return cached_samples(self.cache_dir, key, self._make)

    def _make(self) -> dict[str, Tensor]:
        """Meshes, joints, the body's box of each clean depth image, one after another; the depth images' hash."""
        definition, renderer = self.definition, self._renderer
        num_vertices = self._poser.layer.num_vertices
        vertices, joints = (torch.empty(len(self), size, 3) for size in (num_vertices, NUM_JOINTS))
        keypoints, centre = torch.empty(len(self), NUM_JOINTS, 2), torch.empty(len(self))
        boxes, pixels = np.empty((len(self), 4), np.int64), []
        digest = hashlib.sha256()
        for start in range(0, len(self), CHUNK):
            part = slice(start, start + CHUNK)
            columns = (definition.pose[part], definition.betas[part], definition.gender[part])
            meshes, posed = self._poser(*columns)
            transl = torch.from_numpy(definition.transl[part]).double()[:, None]
            meshes, posed = meshes + transl, posed + transl
            vertices[part], joints[part] = meshes, posed
            centre[part] = (meshes[..., 2].amin(1) + meshes[..., 2].amax(1)) / 2
            for index, (mesh, skeleton) in enumerate(zip(meshes, posed), start):
                camera = definition.camera(index)
                keypoints[index] = project(skeleton, camera.intrinsics(torch.float64))
                depth = _rounded(renderer(mesh[None], self._poser.layer.faces, camera)[0].numpy())
                left, right, top, bottom = body_box(depth)
                boxes[index] = left, right + 1, top, bottom + 1
                pixels.append(depth[top : bottom + 1, left : right + 1].ravel())
                digest.update(np.array(depth.shape, "<i4").tobytes())
                digest.update(self._noisy(index, depth).astype("<f4").tobytes())
        return {
            "vertices": vertices,
            "joints": joints,
            "keypoints": keypoints,
            "centre": centre,
            "boxes": torch.from_numpy(boxes),
            "pixels": torch.from_numpy(np.concatenate(pixels)),
            "starts": torch.from_numpy(np.cumsum([0, *map(len, pixels)])),
            "digest": torch.from_numpy(np.frombuffer(digest.digest(), np.uint8).copy()),
        }

    @property
    def depth_hash(self) -> str:
        """SHA-256 over the depth images of the base condition: each one's height and width, then its pixels."""
        return self._made["digest"].numpy().tobytes().hex()

    def _rng(self, index: int, purpose: int) -> np.random.Generator:
        return np.random.default_rng([int(self.definition.seed[index]), purpose])

    def _noisy(self, index: int, depth: np.ndarray) -> np.ndarray:
        """A clean depth image with the base condition's noise."""
        return add_depth_noise(depth, DEPTH_NOISE_M, self._rng(index, _DEPTH_NOISE))

    def camera(self, index: int) -> Camera:
        """See `ljn.benchmark.frames.BenchSamples`."""
        return self.definition.camera(index)

    def clean_depth(self, index: int) -> np.ndarray:
        """See `ljn.benchmark.frames.BenchSamples`."""
        width, height = map(int, self.definition.size[index])
        left, right, top, bottom = self._made["boxes"][index].tolist()
        start, stop = self._made["starts"][index : index + 2].tolist()
        depth = np.zeros((height, width), np.float32)
        depth[top:bottom, left:right] = self._made["pixels"][start:stop].view(bottom - top, right - left)
        return depth

    def frames(self, indices: Sequence[int], condition: Condition) -> list[BenchFrame]:
        """See `ljn.benchmark.frames.BenchSamples`."""
        return [self._frame(index, condition) for index in indices]

    def _frame(self, index: int, condition: Condition) -> BenchFrame:
        depth = self._image(index, condition)
        if condition.occluded_percent:
            depth = _occluded(depth, condition.occluded_percent, self._rng(index, _OCCLUSION))
        joints = None
        if condition.joint_noise_mm is not None:
            noise_m, true = condition.joint_noise_mm / 1000, self._made["joints"][index].numpy()
            joints = add_joint_noise(true, noise_m, "isotropic", self._rng(index, _JOINTS))
        keypoints = self._keypoints(index, condition)
        return BenchFrame(depth, self.camera(index), keypoints, joints, condition.num_points)

    def _image(self, index: int, condition: Condition) -> np.ndarray:
        """A sample's depth image `(H, W)`, as the condition's sensor takes it."""
        if condition.sensor is None:
            return self._noisy(index, self.clean_depth(index))
        if condition.sensor not in self._sensors:
            raise ValueError(
                f"sensor: expected one of {', '.join(self.sensors) or 'none'}, got {condition.sensor!r}"
            )
        sensor, seed = self._sensors[condition.sensor], int(self.definition.seed[index])
        mesh, camera = self._made["vertices"][index].numpy().astype(np.float64), self.camera(index)
        [body] = [
            body for body in self._poser.bodies if GENDERS[body.gender] == self.definition.gender[index]
        ]
        sensor.dress(mesh, body, [seed, _SENSOR, 0])
        depth = self._renderer(torch.from_numpy(mesh)[None], self._poser.layer.faces, camera)[0].numpy()
        sensor.expose(depth, camera, self._made["joints"][index].numpy(), [seed, _SENSOR, 1])
        return depth

    @cached_property
    def _renderer(self) -> Renderer:
        return get_renderer("zbuffer")

    def _keypoints(self, index: int, condition: Condition) -> np.ndarray | None:
        """`(24, 3)` float32, within the image as a detector's are."""
        if condition.keypoint_noise_px is None:
            return None
        camera = self.camera(index)
        noise_px = condition.keypoint_noise_px * camera.fx / REFERENCE_FOCAL_PX
        clean = self._made["keypoints"][index].numpy()
        places = add_keypoint_noise(clean, noise_px, self._rng(index, _KEYPOINTS))
        places = places.clip(0, np.array([camera.width - 1, camera.height - 1], np.float32))
        keypoints = np.concatenate([places, np.ones((NUM_JOINTS, 1), np.float32)], -1)
        num_missing = round(condition.missing_percent / 100 * NUM_JOINTS)
        order = self._rng(index, _MISSING).permutation(NUM_JOINTS)
        keypoints[order[:num_missing]] = np.nan, np.nan, 0
        return keypoints

    def truth(self, indices: Sequence[int]) -> BenchTruth:
        """See `ljn.benchmark.frames.BenchSamples`."""
        rows = list(indices)
        return BenchTruth(*(self._made[name][rows].numpy() for name in ("joints", "vertices")))

    def groups(self) -> dict[str, np.ndarray]:
        """See `ljn.benchmark.frames.BenchSamples`."""
        boxes = self._made["boxes"].numpy()
        return {
            "distance, m": _in_ranges(self._made["centre"].numpy(), _DISTANCES_M, "1", "5"),
            "heading, degrees from facing": _in_ranges(self.facing(), _HEADINGS_DEG, "0", "180"),
            "height of the body, px": _in_ranges(boxes[:, 3] - boxes[:, 2], _HEIGHTS_PX, "0", "512"),
            "pose": self.definition.kind,
        }

    def visible(self) -> np.ndarray:
        """See `ljn.benchmark.frames.BenchSamples`."""
        seen = np.empty((len(self), NUM_JOINTS), bool)
        for index in range(len(self)):
            u, v = self._made["keypoints"][index].round().long().T.numpy()
            surface = self.clean_depth(index)[v, u]
            seen[index] = (surface > 0) & (self._made["joints"][index, :, 2].numpy() - surface <= VISIBLE_M)
        return seen

    def facing(self) -> np.ndarray:
        """See `ljn.benchmark.frames.BenchSamples`."""
        root = torch.from_numpy(self.definition.pose[:, :3].astype(np.float64))
        # SMPL's front in the body world, whose x points at the camera.
        return rotvec_to_rotmat(root)[:, 0, 2].clamp(-1, 1).arccos().rad2deg().numpy()


def _rounded(depth: np.ndarray) -> np.ndarray:
    """A clean depth image, rounded; see `_STEPS_PER_METRE`."""
    return np.rint(depth * np.float32(_STEPS_PER_METRE)) / np.float32(_STEPS_PER_METRE)


def _occluded(depth: np.ndarray, percent: float, rng: np.random.Generator) -> np.ndarray:
    """A depth image `(H, W)` without those of the body's pixels that a box hides, `percent` of them.

    The box's middle is a pixel of the body, its sides are to each other as 1:2 to 2:1, and it is as large as it has to
    be; draws do not depend on `percent`.
    """
    v, u = np.nonzero(depth)
    middle, shape = rng.integers(len(v)), np.sqrt(2.0) ** rng.uniform(-1, 1)
    reach = np.maximum(np.abs(u - u[middle]) / shape, np.abs(v - v[middle]) * shape)
    num_hidden = round(percent / 100 * len(v))
    hidden = np.argsort(reach, kind="stable")[:num_hidden]
    seen = depth.copy()
    seen[v[hidden], u[hidden]] = 0
    return seen


def _in_ranges(values: np.ndarray, limits: Sequence[float], low: str, high: str) -> np.ndarray:
    """`(S,)` str: which range between limits each value is in; outside of the ends, the nearest."""
    ends = [low, *map(str, limits), high]
    names = [f"{first}-{last}" for first, last in pairwise(ends)]
    return np.array(names)[np.digitize(values, limits)]
