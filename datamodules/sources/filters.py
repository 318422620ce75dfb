"""Which recorded poses are taken: by heading, the pelvis' height, and how far body parts reach into each other."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch

from datamodules.sources.clearance import Clearance
from ljn.body import load_body_model
from ljn.body.kinematics import joint_positions, world_rotations
from ljn.body.skeleton import NUM_JOINTS, ROOT
from ljn.geometry.rotations import BODY_TO_OPENGL, rotvec_to_rotmat, swing_twist


@cache
def _clearance() -> Clearance:
    return Clearance(load_body_model())


@dataclass(frozen=True)
class PoseFilters:
    """Limits of the poses that are taken; None for none. Poses are measured on the embedded neutral body's mean shape.

    Attributes:
        max_heading_deg: How far a person may be turned away from the body world's x axis, to either side, degrees.
        pelvis_height_m: Range of the pelvis' height above the lowest joint, metres: some 0.9 standing, 0.5 kneeling,
            0.2 lying.
        max_penetration_m: How far body parts may reach into each other, metres.
    """

    max_heading_deg: float | None = None
    pelvis_height_m: Sequence[float] | None = None
    max_penetration_m: float | None = None

    def __post_init__(self) -> None:
        for name in ("max_heading_deg", "max_penetration_m"):
            limit = getattr(self, name)
            if limit is not None and not 0 <= limit < math.inf:
                raise ValueError(f"{name}: expected a number of 0 or more, or null, got {limit}")
        heights = self.pelvis_height_m
        if heights is not None:
            if not isinstance(heights, Sequence) or len(heights) != 2 or not heights[0] <= heights[1]:
                raise ValueError(
                    f"pelvis_height_m: expected two numbers, lowest and highest, or null, got {heights}"
                )
            object.__setattr__(self, "pelvis_height_m", tuple(map(float, heights)))

    @property
    def fingerprint(self) -> str:
        """Names what is taken of a table of poses."""
        on_body = self.pelvis_height_m is not None or self.max_penetration_m is not None
        return f"{self} {_clearance().hash if on_body else ''}"

    def takes(self, pose: np.ndarray) -> np.ndarray:
        """Whether each of the poses `(n, 72)`, axis-angle in body world, is within all limits: `(n,)` bool."""
        is_taken = np.ones(len(pose), bool)
        if self.max_heading_deg is self.pelvis_height_m is self.max_penetration_m is None:
            return is_taken
        rotmat = rotvec_to_rotmat(torch.from_numpy(pose).double().unflatten(-1, (NUM_JOINTS, 3)))
        rotmat[:, ROOT] = BODY_TO_OPENGL @ rotmat[:, ROOT]  # SMPL's axes: y up
        if self.max_heading_deg is not None:
            up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
            _, heading = swing_twist(rotmat[:, ROOT], up)
            is_taken &= (heading.abs() <= math.radians(self.max_heading_deg)).numpy()
        if self.pelvis_height_m is not None:
            heights = joint_positions(world_rotations(rotmat), _clearance().offsets)[..., 1]
            height = (heights[:, ROOT] - heights.amin(1)).numpy()
            is_taken &= (self.pelvis_height_m[0] <= height) & (height <= self.pelvis_height_m[1])
        if self.max_penetration_m is not None:
            is_taken &= (_clearance().depth(rotmat) <= self.max_penetration_m).numpy()
        return is_taken
