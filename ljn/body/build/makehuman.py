"""Reading MakeHuman's files: base mesh, blend shapes ("targets"), rig. Metres; x to the left, y up, z forward."""

import gzip
import json
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ljn.body.build.adults import ATTRIBUTES, Adults, blend_weights
from ljn.body.skeleton import JOINT_INDEX, JOINT_NAMES, NUM_JOINTS

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_METRES = 0.1
"""MakeHuman's unit is the decimetre."""

_BONES = {
    "root": "pelvis", "spine05": "pelvis", "spine04": "pelvis", "spine03": "spine1", "spine02": "spine2",
    "spine01": "spine3", "neck01": "neck", "neck02": "neck", "neck03": "neck",
    "pelvis": "pelvis", "breast": "spine3",
}  # fmt: skip
_LIMB_BONES = {
    "upperleg01": "hip", "upperleg02": "hip", "lowerleg01": "knee", "lowerleg02": "knee", "foot": "ankle",
    "clavicle": "collar", "shoulder01": "collar", "upperarm01": "shoulder", "upperarm02": "shoulder",
    "lowerarm01": "elbow", "lowerarm02": "elbow", "wrist": "wrist", "metacarpal1": "wrist",
    "metacarpal2": "wrist", "metacarpal3": "wrist", "metacarpal4": "wrist", "finger1-1": "wrist",
}  # fmt: skip

_CUBES: dict[str, dict[str, float]] = {
    "pelvis": {"joint-pelvis": 0.3, "joint-spine-4": 0.7}, "spine1": {"joint-spine-3": 1.0},
    "spine2": {"joint-spine-2": 1.0}, "spine3": {"joint-spine-1": 1.0}, "neck": {"joint-neck": 1.0},
    "head": {"joint-head": 1.0},
}  # fmt: skip
_LIMB_CUBES: dict[str, dict[str, float]] = {
    "hip": {"upper-leg": 1.0}, "knee": {"knee": 1.0}, "ankle": {"ankle": 1.0},
    "foot": {f"toe-{i}-1": 0.2 for i in range(1, 6)}, "collar": {"clavicle": 0.5, "scapula": 0.5},
    "shoulder": {"shoulder": 1.0}, "elbow": {"elbow": 1.0}, "wrist": {"hand": 1.0},
    "hand": {f"finger-{i}-1": 0.25 for i in range(2, 6)},
}  # fmt: skip
"""Joints as means of the small cubes that mark MakeHuman's joints."""


def joint_of_bone(bone: str) -> int:
    """The SMPL joint that moves what a bone of MakeHuman's default rig moves."""
    stem, _, side = bone.partition(".")
    side = {"L": "l_", "R": "r_"}.get(side, "")
    if stem in _BONES:
        return JOINT_INDEX[_BONES[stem]]
    if side and stem in _LIMB_BONES:
        return JOINT_INDEX[side + _LIMB_BONES[stem]]
    if side and stem.startswith(("toe", "finger")):
        return JOINT_INDEX[side + ("foot" if stem.startswith("toe") else "hand")]
    return JOINT_INDEX["head"]  # head, jaw, eyes, tongue and every facial bone


@dataclass(frozen=True)
class MakeHuman:
    """The base mesh with everything that deforms it."""

    vertices: Array  # `(N, 3)`, metres, the base shape with its helper geometry
    body_faces: list[list[int]]  # the body's polygons, three or four vertex indices each; closed, genus 0
    cubes: Array  # `(24, N)`, SMPL's joints as weighted means of helper vertices
    weights: Array  # `(N, 24)`, skinning weights, merged to SMPL's joints; rows of helpers are zero
    # blend shapes by the attribute values they belong to: vertex indices and offsets in metres
    targets: dict[tuple[str, ...], tuple[Index, Array]]

    @classmethod
    def read(cls, folder: Path) -> "MakeHuman":
        """Everything below MakeHuman's `folder` (see `find_makehuman`) that adult bodies need."""
        vertices, groups = _read_obj(folder / "3dobjs" / "base.obj")
        rig = json.loads((folder / "rigs" / "standard" / "weights.default.json").read_text(encoding="utf-8"))
        weights = np.zeros((len(vertices), NUM_JOINTS))
        for bone, entries in rig["weights"].items():
            for vertex, weight in entries:
                weights[int(vertex), joint_of_bone(bone)] += weight
        targets = {
            key: _read_target(path) for key, path in _target_files(folder / "targets") if path.is_file()
        }
        return cls(vertices * _METRES, groups["body"], _cube_means(groups, len(vertices)), weights, targets)

    @cached_property
    def body_ids(self) -> Index:
        """The body's vertices among all, ascending."""
        return np.unique(np.concatenate(self.body_faces))

    def shapes(self, adults: Adults, rows: Index) -> tuple[Array, Array]:
        """The bodies of n adults in MakeHuman's rest pose: vertices `(n, R, 3)` and joints `(n, 24, 3)`, metres.

        `rows` `(R,)` are the vertices wanted.
        """
        coefficients = blend_weights(list(self.targets), adults)  # (n, T)
        helpers = np.flatnonzero(self.cubes.any(0))
        wanted = np.concatenate([rows, helpers])
        offsets = np.zeros((len(self.targets), len(wanted), 3))
        dense = np.zeros_like(self.vertices)
        for number, (ids, values) in enumerate(self.targets.values()):
            dense[ids] = values
            offsets[number] = dense[wanted]
            dense[ids] = 0
        shapes = self.vertices[wanted] + np.tensordot(coefficients, offsets, 1)
        joints = np.einsum("jh,nhd->njd", self.cubes[:, helpers], shapes[:, len(rows) :])
        return shapes[:, : len(rows)], joints


def _read_obj(path: Path) -> tuple[Array, dict[str, list[list[int]]]]:
    """Vertices in the file's unit and the polygons of each group; every other kind of line is left out."""
    vertices: list[list[float]] = []
    groups: dict[str, list[list[int]]] = {}
    faces: list[list[int]] = []
    with open(path, encoding="utf-8") as file:
        for line in file:
            kind, *fields = line.split() or [""]
            if kind == "v":
                vertices.append([float(field) for field in fields[:3]])
            elif kind == "g":
                faces = groups.setdefault(fields[0], [])
            elif kind == "f":
                faces.append([int(field.split("/")[0]) - 1 for field in fields])
    return np.array(vertices), groups


def _read_target(path: Path) -> tuple[Index, Array]:
    lines = gzip.decompress(path.read_bytes()).splitlines()
    numbers = b" ".join(line for line in lines if not line.startswith(b"#")).split()
    table = np.array(numbers, dtype=np.float64).reshape(-1, 4)
    return table[:, 0].astype(np.int64), table[:, 1:] * _METRES


def _target_files(folder: Path) -> list[tuple[tuple[str, ...], Path]]:
    """The adult targets: the attribute values that each belongs to, and its file."""
    # The order of attributes in MakeHuman's file names; breasts have targets for women only.
    families = {
        "macrodetails/universal-{}": ("gender", "age", "muscle", "weight"),
        "macrodetails/{}": ("ethnicity", "gender", "age"),
        "macrodetails/height/{}": ("gender", "age", "muscle", "weight", "height"),
        "macrodetails/proportions/{}": ("gender", "age", "muscle", "weight", "proportions"),
        "breast/{}": ("gender", "age", "muscle", "weight", "cupsize", "firmness"),
    }
    return [
        (key, folder / f"{name.format('-'.join(key))}.target.gz")
        for name, attributes in families.items()
        for key in product(*(ATTRIBUTES[attribute] for attribute in attributes))
    ]


def _cube_means(groups: dict[str, list[list[int]]], num_vertices: int) -> Array:
    means = np.zeros((NUM_JOINTS, num_vertices))
    for row, name in zip(means, JOINT_NAMES):
        side, _, limb = name.rpartition("_")
        parts = {f"joint-{side}-{cube}": w for cube, w in _LIMB_CUBES[limb].items()} if side else _CUBES[name]
        for cube, weight in parts.items():
            vertices = np.unique(np.concatenate(groups[cube]))
            row[vertices] += weight / len(vertices)
    return means
