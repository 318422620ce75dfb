"""What two definitions of a joint differ by: labels that lie at a declared depth behind the surface, and SMPL's joints.

The offset is fitted on the synthetic body, whose joints and surface are known, never on labels.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch

from ljn.benchmark.frames import BenchSamples
from ljn.benchmark.labels import JointMap
from ljn.geometry.camera import back_project, project

MAX_FACING_DEG = 45.0
"""Bodies that face the camera within this angle are fitted on."""
OCCLUDED_M = 0.25
"""A joint is left out where the surface at its pixel is farther than this before it."""


class Offsets(NamedTuple):
    """What the labels' definition adds to the mapped joints.

    Attributes:
        metres: `(J, 3)`, camera frame.
        numbers: `(J,)`, from how many bodies each is.
    """

    metres: np.ndarray
    numbers: np.ndarray


def fit_offsets(samples: BenchSamples, mapped: JointMap, surface_depth_m: Mapping[str, float]) -> Offsets:
    """The mean offset from each mapped joint to the point at a declared depth behind the surface at its pixel.

    Args:
        samples: The bodies, of which those that face the camera count.
        mapped: Which joints the names stand for.
        surface_depth_m: For each name, how far behind the surface, along the ray, its labels lie; metres.

    Raises:
        ValueError: A name has no depth, or none of the bodies shows it.
    """
    if missing := [name for name in mapped.names if name not in surface_depth_m]:
        raise ValueError(
            f"bench.surface_depth_m: expected a depth of every label, metres, or none at all; there is none of "
            f"{', '.join(missing)}: add bench.surface_depth_m.{missing[0]}=0"
        )
    declared = np.array([float(surface_depth_m[name]) for name in mapped.names])
    found: list[np.ndarray] = []
    for index in np.flatnonzero(samples.facing() <= MAX_FACING_DEG).tolist():
        camera, depth = samples.camera(index), samples.clean_depth(index)
        joints = mapped(samples.truth([index]).joints[0].astype(np.float64))
        intrinsics = camera.intrinsics(torch.float64)
        pixels = project(torch.from_numpy(joints), intrinsics)
        u, v = pixels.round().long().T.numpy()
        surface = depth[v, u].astype(np.float64)
        points = back_project(pixels, torch.from_numpy(surface), intrinsics).numpy()
        is_seen = (surface > 0) & (joints[:, 2] - surface <= OCCLUDED_M)
        length = np.linalg.norm(points, axis=-1, keepdims=True)
        points += declared[:, None] * points / np.where(length > 0, length, 1)
        found.append(np.where(is_seen[:, None], points - joints, np.nan))
    offsets = np.array(found).reshape(-1, len(mapped.names), 3)
    numbers = np.isfinite(offsets[..., 0]).sum(0)
    if (numbers == 0).any():
        name = mapped.names[int(np.argmin(numbers))]
        raise ValueError(
            f"bench.samples: no body that faces the camera shows '{name}', so its offset cannot be fitted; take more "
            "samples"
        )
    return Offsets(np.nanmean(offsets, 0), numbers)
