"""Steps that change the person: clothes, wider shapes, and a camera that is not held upright."""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numba
import numpy as np

from datamodules.sensor.chain import Step
from ljn.body import BodyModel
from ljn.body.skeleton import JOINT_INDEX, JOINT_NAMES

_NUM_WAVES = 24
_TRUNK = ("pelvis", "spine1", "spine2", "spine3", "l_collar", "r_collar")


@dataclass(frozen=True, kw_only=True)
class Tilt(Step):
    """The camera looks up or down, and is held askew: the body leans in its image.

    Attributes:
        pitch_deg: Standard deviation of the angle about the camera's horizontal axis, degrees.
        roll_deg: Of that about its optical axis.
    """

    pitch_deg: float = 12
    roll_deg: float = 4

    def turn(self, rng: np.random.Generator, strength: float) -> np.ndarray:
        """See `Step`."""
        pitch, roll = np.radians(
            strength * np.array([self.pitch_deg, self.roll_deg]) * rng.standard_normal(2)
        )
        # The body world's x points at the camera, its z up, and y across.
        about_y = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]])
        about_x = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]])
        return about_x @ about_y


@dataclass(frozen=True, kw_only=True)
class WideShapes(Step):
    """Shapes beyond those that are drawn, up to 4 standard deviations.

    Attributes:
        factor: What the coefficients are multiplied by, less 1.
    """

    factor: float = 0.5

    def shape(self, betas: np.ndarray, rng: np.random.Generator, strength: float) -> np.ndarray:
        """See `Step`."""
        return np.clip(betas * (1 + strength * self.factor), -4, 4)


@dataclass(frozen=True, kw_only=True)
class Clothing(Step):
    """The surface pushed outward: clothes, loose around trunk, hips and sleeves, in folds; hair; shoes.

    Each part's thickness is uniform from 0 to its value, metres. Sleeves and trouser legs are long, short or none.

    Attributes:
        trunk_m: Of the trunk, a third more at the hips.
        limbs_m: Of sleeves and trouser legs.
        hair_m: Of the hair, on the head's top and back.
        shoes_m: Of shoes.
        folds: Depth of the folds, as a share of the thickness.
    """

    trunk_m: float = 0.035
    limbs_m: float = 0.03
    hair_m: float = 0.06
    shoes_m: float = 0.02
    folds: float = 0.6

    def dress(self, vertices: np.ndarray, body: BodyModel, rng: np.random.Generator, strength: float) -> None:
        """See `Step`."""
        wardrobe = _wardrobe(body)
        trunk, sleeves, legs, hair, shoes, collar = rng.random(6)
        sleeve_length, leg_length = rng.integers(0, 3, 2)
        thickness = np.zeros(len(JOINT_NAMES) + 1, np.float32)
        for name in _TRUNK:
            thickness[JOINT_INDEX[name]] = trunk * self.trunk_m
        thickness[JOINT_INDEX["pelvis"]] *= 1.33
        thickness[JOINT_INDEX["neck"]] = 0.3 * collar * self.trunk_m
        for side in ("l", "r"):
            thickness[JOINT_INDEX[f"{side}_shoulder"]] = sleeves * self.limbs_m * (sleeve_length > 0)
            thickness[JOINT_INDEX[f"{side}_elbow"]] = sleeves * self.limbs_m * (sleeve_length > 1)
            thickness[JOINT_INDEX[f"{side}_hip"]] = max(legs * self.limbs_m, 0.5 * trunk * self.trunk_m)
            thickness[JOINT_INDEX[f"{side}_knee"]] = legs * self.limbs_m * (leg_length > 0)
            thickness[JOINT_INDEX[f"{side}_ankle"]] = shoes * self.shoes_m
            thickness[JOINT_INDEX[f"{side}_foot"]] = shoes * self.shoes_m
        thickness[-1] = hair * self.hair_m
        offsets = wardrobe.parts @ (strength * thickness)
        folds = wardrobe.waves @ rng.standard_normal(_NUM_WAVES, dtype=np.float32)
        _push(vertices, wardrobe.faces, offsets, folds * np.float32(self.folds / np.sqrt(_NUM_WAVES / 2)))


class _Wardrobe(NamedTuple):
    """What clothes of a body are made of.

    Attributes:
        faces: `(F, 3)` int64.
        parts: `(V, 25)` float32: how far each joint's part has a vertex, and the hair.
        waves: `(V, 24)` float32: waves over the rest pose, with a mean square of a half.
    """

    faces: np.ndarray
    parts: np.ndarray
    waves: np.ndarray


@lru_cache(maxsize=8)
def _wardrobe(body: BodyModel) -> _Wardrobe:
    rest, weights = body.v_template.astype(np.float64), body.weights.astype(np.float64)
    head = weights[:, JOINT_INDEX["head"]]
    low, high = rest[head > 0.5].min(0), rest[head > 0.5].max(0)
    height = (rest[:, 1] - low[1]) / (high[1] - low[1])  # SMPL's rest pose: y up, z to the front
    back = (high[2] - rest[:, 2]) / (high[2] - low[2])
    hair = head * np.clip(4 * np.maximum(height - 0.72, np.minimum(back - 0.55, height - 0.15)), 0, 1)
    rng = np.random.default_rng(0)  # the same waves for every body; a sample draws their sizes
    directions = rng.standard_normal((3, _NUM_WAVES))
    directions /= np.linalg.norm(directions, axis=0)
    lengths_m = np.exp(rng.uniform(np.log(0.06), np.log(0.3), _NUM_WAVES))
    waves = np.cos(rest @ (2 * np.pi * directions / lengths_m) + rng.uniform(0, 2 * np.pi, _NUM_WAVES))
    parts = np.concatenate([weights, hair[:, None]], 1)
    return _Wardrobe(np.array(body.faces), parts.astype(np.float32), waves.astype(np.float32))


@numba.njit(cache=True, nogil=True)
def _push(vertices: np.ndarray, faces: np.ndarray, offsets: np.ndarray, folds: np.ndarray) -> None:
    """Move each vertex along its normal by its offset, with folds, never inward."""
    normals = np.zeros((len(vertices), 3))
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = (
            vertices[j, 0] - vertices[i, 0],
            vertices[j, 1] - vertices[i, 1],
            vertices[j, 2] - vertices[i, 2],
        )
        bx, by, bz = (
            vertices[k, 0] - vertices[i, 0],
            vertices[k, 1] - vertices[i, 1],
            vertices[k, 2] - vertices[i, 2],
        )
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        for corner in (i, j, k):
            normals[corner, 0] += nx
            normals[corner, 1] += ny
            normals[corner, 2] += nz
    for v in range(len(vertices)):
        offset = offsets[v] * max(0.0, 1.0 + folds[v])
        length = np.sqrt(normals[v, 0] ** 2 + normals[v, 1] ** 2 + normals[v, 2] ** 2)
        if offset > 0.0 and length > 0.0:
            for axis in range(3):
                vertices[v, axis] += normals[v, axis] * offset / length
