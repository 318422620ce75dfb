"""Motion files of the formats' facts, written here from known poses, without the library's own writers."""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datamodules.sources.reference import REFERENCE_OFFSETS
from ljn.body.skeleton import JOINT_INDEX, NUM_JOINTS, PARENTS

ROOT = Path(__file__).parents[3]
OFFSETS = REFERENCE_OFFSETS.numpy()


def world_rotations(poses):
    """Rotations `(T, 24, 3, 3)` into the world of poses `(T, 72)`, joint by joint."""
    local = Rotation.from_rotvec(np.reshape(poses, (-1, 3))).as_matrix().reshape(-1, NUM_JOINTS, 3, 3)
    world = local.copy()
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            world[:, joint] = world[:, parent] @ local[:, joint]
    return world


@pytest.fixture(scope="session")
def joints_of():
    """Joints `(T, 24, 3)` of poses `(T, 72)` on the reference skeleton, metres, root at the origin."""

    def joints(poses):
        world = world_rotations(np.asarray(poses, np.float64))
        positions = np.zeros((len(world), NUM_JOINTS, 3))
        for joint, parent in enumerate(PARENTS):
            if parent >= 0:
                positions[:, joint] = positions[:, parent] + world[:, parent] @ OFFSETS[joint]
        return positions

    return joints


@pytest.fixture(scope="session")
def some_poses():
    """Poses `(T, 72)` of moderate angles in SMPL's axes."""

    def draw(number, seed=0):
        return 0.3 * np.random.default_rng(seed).standard_normal((number, 72))

    return draw


# Name, parent, offset, and the joint of SMPL that it shows.
CMU_DAZ = (
    ("hip", None, (0, 0, 0), "pelvis"),
    ("abdomen", "hip", (0, 7.5, 0.3), "spine2"),
    ("chest", "abdomen", (0, 11.2, -0.4), "spine3"),
    ("neck", "chest", (0, 24.9, -3.1), "neck"),
    ("head", "neck", (0, 6.8, 1.1), "head"),
    *(
        row
        for s, sign in (("l", 1), ("r", -1))
        for row in (
            (f"{s}Collar", "chest", (sign * 1.7, 20.4, -1.2), None),
            (f"{s}Shldr", f"{s}Collar", (sign * 14.1, -1.0, -1.6), f"{s}_shoulder"),
            (f"{s}ForeArm", f"{s}Shldr", (sign * 26.9, -0.6, -2.1), f"{s}_elbow"),
            (f"{s}Hand", f"{s}ForeArm", (sign * 24.6, 0.4, 1.3), f"{s}_wrist"),
            (f"{s}Buttock", "hip", (sign * 8.77824, 4.35084, 1.2192), None),
            (f"{s}Thigh", f"{s}Buttock", (0, -1.70687, -2.19456), f"{s}_hip"),
            (f"{s}Shin", f"{s}Thigh", (0, -36.8199, 0.73152), f"{s}_knee"),
            (f"{s}Foot", f"{s}Shin", (sign * -0.73152, -45.1104, -5.12064), f"{s}_ankle"),
        )
    ),
)
_BONES = {"hip": "knee", "knee": "ankle", "shoulder": "elbow", "elbow": "wrist"}


def _turn(start, end):
    """The shortest rotation from one direction to another."""
    start, end = start / np.linalg.norm(start), end / np.linalg.norm(end)
    axis = np.cross(start, end)
    angle = np.arctan2(np.linalg.norm(axis), start @ end)
    return Rotation.from_rotvec(axis / max(np.linalg.norm(axis), 1e-12) * angle).as_matrix()


def bvh_text(poses, skeleton=CMU_DAZ, order="ZXY", frame_time=1 / 30, axes=None, rest=None):
    """A BVH file of poses `(T, 72)` in SMPL's axes, its first frame a T-pose; `axes` leads SMPL's to the file's.

    `rest` are rotations `(3, 3)` by name, of joints whose own axes lie otherwise than the world's in the T-pose.
    """
    rest = rest or {}
    axes = np.eye(3) if axes is None else axes
    rows = {name: (parent, np.array(offset, float), joint) for name, parent, offset, joint in skeleton}
    of_joint = {joint: name for name, (_, _, joint) in rows.items() if joint}
    world = world_rotations(poses)
    turned = {}
    for name, (_, _, joint) in rows.items():
        if joint is None:
            continue
        turn = np.eye(3)
        if joint[2:] in _BONES:
            child = joint[:2] + _BONES[joint[2:]]
            turn = _turn(OFFSETS[JOINT_INDEX[child]], rows[of_joint[child]][1])
        turned[name] = world[:, JOINT_INDEX[joint]] @ turn.T
    lines, columns = ["HIERARCHY"], []

    def rest_of(name):
        if name is None:
            return np.eye(3)
        return rest[name] if name in rest else rest_of(rows[name][0])

    def write(name, depth):
        parent, offset, _ = rows[name]
        offset = rest_of(parent).T @ offset
        indent = "  " * depth
        lines.append(f"{indent}{'JOINT' if parent else 'ROOT'} {name}")
        lines.append(f"{indent}{{")
        lines.append(f"{indent}  OFFSET {' '.join(f'{value:.6f}' for value in axes @ offset)}")
        channels = [f"{axis}rotation" for axis in order]
        above = name
        local = np.eye(3)[None].repeat(len(poses), 0)
        if name in turned:
            above = parent
            while above is not None and above not in turned:
                above = rows[above][0]
            local = turned[name] if above is None else turned[above].transpose(0, 2, 1) @ turned[name]
        if parent is None:
            channels = ["Xposition", "Yposition", "Zposition", *channels]
            columns.append(np.tile(axes @ [0, 90.0, 0], (len(poses), 1)))
        lines.append(f"{indent}  CHANNELS {len(channels)} {' '.join(channels)}")
        local = axes @ rest_of(parent).T @ local @ rest_of(name) @ axes.T
        columns.append(Rotation.from_matrix(local).as_euler(order, degrees=True))
        children = [child for child, (of, _, _) in rows.items() if of == name]
        for child in children:
            write(child, depth + 1)
        if not children:
            lines.extend(
                [f"{indent}  End Site", f"{indent}  {{", f"{indent}    OFFSET 0 1 0", f"{indent}  }}"]
            )
        lines.append(f"{indent}}}")

    write(skeleton[0][0], 0)
    frames = np.concatenate(columns, 1)
    if not rest:
        frames = np.concatenate([np.zeros_like(frames[:1]), frames])
    lines += ["MOTION", f"Frames: {len(frames)}", f"Frame Time: {frame_time:.7f}"]
    lines += [" ".join(f"{value:.7f}" for value in frame) for frame in frames]
    return "\n".join(lines) + "\n"


@pytest.fixture(scope="session")
def make_bvh():
    """The text of a BVH file of CMU's skeleton as converted for DAZ."""
    return bvh_text


@pytest.fixture(scope="session")
def cmu_poses():
    """A public conversion of CMU's motion capture, brought to SMPL's joints: its file, or the test is skipped."""
    beside = Path(__file__).parents[4] / "shared" / "data" / "cmu_subjects_01_12.npz"
    path = Path(os.environ.get("LJN_CMU_POSES", beside))
    if not path.is_file():
        pytest.skip("no file of CMU's poses; name one with LJN_CMU_POSES=cmu_subjects_01_12.npz")
    return path


@pytest.fixture(scope="session")
def real_poses():
    """Frames of the clips that ship, `(T, 72)`, SMPL's axes."""
    with np.load(ROOT / "datamodules/sources/embedded/data/seed_poses.npz") as arrays:
        return arrays["poses"][::23].astype(np.float64)
