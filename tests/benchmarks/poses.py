"""How well generated poses stand in for real ones: `python -m tests.benchmarks.poses CMU.npz [--sheet PNG]`.

Against real motion capture that the generator has not seen (`poses` `(N, 72)` axis-angle in SMPL's axes, `clip` `(N,)`
numbers and `clips` names, "SUBJECT_TRIAL"), this measures

- coverage: from real poses to the nearest generated one, and
- realism: from generated poses to the nearest real one or its mirror image,

as the mean distance of twelve joints on the reference skeleton, root rotation removed, in centimetres, to the pose that
is nearest by the root mean square. It prints one Markdown table, and below it the subjects and what joint limits do.
Nothing is fitted here.
"""

import argparse
import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from datamodules.sources import SPLITS, PoseRecords
from datamodules.sources.embedded import EmbeddedSource
from datamodules.sources.embedded.joint_limits import ARM_AXES, RANGES, Ranges, within_limits
from datamodules.sources.embedded.mixture import PoseMixture
from datamodules.sources.penetration import penetration
from datamodules.sources.reference import REFERENCE_CAPSULES, REFERENCE_OFFSETS
from ljn.body import SMPL, load_body_models
from ljn.body.kinematics import SIDES, joint_positions, mirror, world_rotations
from ljn.body.skeleton import JOINT_INDEX, NUM_JOINTS, ROOT
from ljn.geometry.camera import Camera
from ljn.geometry.rotations import (
    CAMERA_FROM_BODY,
    euler_to_rotmat,
    rotation_about,
    rotmat_to_rotvec,
    rotvec_to_rotmat,
)
from ljn.render.shading import shade_mesh

NUM_POOL, NUM_QUERIES, NUM_REAL = 20_000, 2_500, 30_000
HELD_OUT = ("01", "03", "06", "08", "09", "11")
"""Subjects that no share was chosen on; see docs/poses.md."""

HARDEST = ("01", "05")  # climbing; ballet
SHEET_COLUMNS, SHEET_SEED = 8, 1
GREY = (0.85, 0.85, 0.85)

MEASURED = [
    JOINT_INDEX[name]
    for name in (
        "l_knee", "r_knee", "l_ankle", "r_ankle", "neck", "head",
        "l_shoulder", "r_shoulder", "l_elbow", "r_elbow", "l_wrist", "r_wrist",
    )
]  # fmt: skip
BAD_CLIPS = ("01_01", "13_18")
"""Clips of the public BVH conversion of CMU's database whose elbows flip; `MAX_ELBOW` finds single frames."""
MAX_ELBOW = 0.43  # radians about y, the way an elbow does not bend


class Real(NamedTuple):
    """Real poses: `rotmat` `(N, 24, 3, 3)` and the subject of each, `(N,)`."""

    rotmat: Tensor
    subject: np.ndarray


def read_real(path: Path) -> Real:
    """The usable frames of a file of real motion capture."""
    with np.load(path) as file:
        poses, clip = file["poses"].astype(np.float64), file["clips"][file["clip"]]
    elbows = [poses[:, 3 * JOINT_INDEX[f"{side}_elbow"] + 1] * sign for side, sign in SIDES.items()]
    is_good = ~np.isin(clip, BAD_CLIPS) & (np.max(elbows, 0) <= MAX_ELBOW)
    subject = np.array([name.split("_")[0] for name in clip])
    return Real(to_rotmat(poses[is_good]), subject[is_good])


def to_rotmat(poses: np.ndarray) -> Tensor:
    """Rotations `(N, 24, 3, 3)` of axis-angle poses `(N, 72)`."""
    return rotvec_to_rotmat(torch.from_numpy(poses).double().unflatten(-1, (NUM_JOINTS, 3)))


def features(rotmat: Tensor) -> Tensor:
    """The measured joints `(N, 12, 3)`, centimetres, of poses `(N, 24, 3, 3)` without their root rotation."""
    rotmat = rotmat.clone()
    rotmat[:, ROOT] = torch.eye(3, dtype=rotmat.dtype)
    return 100 * joint_positions(world_rotations(rotmat), REFERENCE_OFFSETS)[:, MEASURED]


def distances(queries: Tensor, pool: Tensor) -> Tensor:
    """Mean distance `(N,)` of the joints from each query to the nearest pose of the pool (by root mean square)."""
    nearest = torch.cat(
        [torch.cdist(some, pool.flatten(1)).argmin(1) for some in queries.flatten(1).split(500)]
    )
    return (queries - pool[nearest]).norm(dim=-1).mean(-1)


def some(values: Tensor, number: int) -> Tensor:
    """At most `number` of the values, the same ones every time, in their order."""
    if len(values) <= number:
        return values
    return values[np.sort(np.random.default_rng(0).choice(len(values), number, replace=False))]


def with_mirror(rotmat: Tensor) -> Tensor:
    """Poses and their mirror images."""
    return torch.cat([rotmat, mirror(rotmat)])


def independent_angles(number: int) -> Tensor:
    """Poses whose joints turn independently and uniformly within their ranges: what limits alone give."""
    rng = np.random.default_rng(0)
    shoulder = Ranges(ARM_AXES, (-90.0, -110.0, -60.0), (75.0, 40.0, 60.0))
    rotmat = torch.eye(3, dtype=torch.float64).repeat(number, NUM_JOINTS, 1, 1)
    for name, (axes, low, high) in {**RANGES, "shoulder": shoulder}.items():
        for joint in [name] if name in JOINT_INDEX else [f"{side}_{name}" for side in SIDES]:
            angles = torch.from_numpy(rng.uniform(low, high, (number, 3))).deg2rad()
            rotmat[:, JOINT_INDEX[joint]] = euler_to_rotmat(axes, angles)
            if joint.startswith("r_"):
                rotmat[:, JOINT_INDEX[joint]] *= torch.tensor([[1, -1, -1], [-1, 1, 1], [-1, 1, 1]])
    return rotmat


class Scorer:
    """Scores pools of poses against real ones."""

    def __init__(self, real: Real) -> None:
        self.real = real
        self._all = features(some(real.rotmat, NUM_QUERIES))
        is_held_out = np.isin(real.subject, HELD_OUT)
        self._held_out = features(some(real.rotmat[is_held_out], NUM_QUERIES))
        self._references = features(some(with_mirror(real.rotmat), NUM_REAL))

    def coverage(self, pool: Tensor) -> list[str]:
        """Mean and 90th percentile of the distances from real poses, of all and of the held-out subjects."""
        pool = features(pool)
        return _two(distances(self._all, pool)) + _two(distances(self._held_out, pool))

    def realism(self, pool: Tensor) -> list[str]:
        """Mean and 90th percentile of the distances to real poses."""
        return _two(distances(features(some(pool, NUM_QUERIES)), self._references))

    def coverage_by_other_people(self) -> list[str]:
        """The coverage of each subject by the real poses of all others and their mirror images."""
        found = []
        for subject in np.unique(self.real.subject):
            is_subject = self.real.subject == subject
            others = features(some(with_mirror(self.real.rotmat[~is_subject]), NUM_POOL))
            found.append((is_subject, distances(features(self.real.rotmat[is_subject]), others)))
        values = torch.empty(len(self.real.subject), dtype=torch.float64)
        for is_subject, distance in found:
            values[is_subject] = distance
        return _two(values) + _two(values[np.isin(self.real.subject, HELD_OUT)])


def _two(values: Tensor) -> list[str]:
    return [f"{values.mean():.1f}", f"{values.quantile(0.9):.1f}"]


def deepest(mixture: PoseMixture, rotmat: Tensor) -> str:
    """The deepest penetration by the body's capsules and by the reference skeleton's, centimetres."""
    on_reference = penetration(world_rotations(rotmat), REFERENCE_OFFSETS, REFERENCE_CAPSULES).max()
    return f"{100 * mixture.depth(rotmat).max():.1f} / {100 * on_reference:.1f}"


def rejected(mixture: PoseMixture, label: str) -> str:
    """Share of a kind's or family's first draws that reach into themselves."""
    proposed = mixture.propose(np.random.default_rng(0), np.full(2000, label))
    return f"{100 * (1 - mixture.is_clear(proposed.rotmat).mean()):.0f} %"


def kind_of(sequence: str) -> str:
    """The kind or family that a record's `sequence` tells of."""
    if "|" in sequence:
        return "mixed" if "proc/" in sequence else "swapped"
    return sequence if sequence.startswith("proc/") else "whole"


def rows(scorer: Scorer) -> Iterator[list[str]]:
    """The table's rows."""
    source = EmbeddedSource()
    mixture = source.mixture.of("train")
    records = source.records("train", NUM_POOL, 0)
    pool = to_rotmat(records.pose)
    yield [
        "**the generator, train donors**", str(len(pool)), *scorer.coverage(pool), *scorer.realism(pool), "",
        deepest(mixture, pool),
    ]  # fmt: skip
    kinds = np.array([kind_of(sequence) for sequence in records.sequence.tolist()])
    for label in mixture.labels:
        part = pool[torch.from_numpy(kinds == label)]
        yield [
            f"its part `{label}`", str(len(part)), *scorer.coverage(part), *scorer.realism(part),
            rejected(mixture, label), deepest(mixture, part),
        ]  # fmt: skip
    for split in ("val", "test"):
        other = to_rotmat(source.records(split, NUM_POOL, 0).pose)
        yield [
            f"the generator, {split} donors", str(len(other)), *scorer.coverage(other), *scorer.realism(other), "",
            deepest(mixture, other),
        ]  # fmt: skip
    procedural = to_rotmat(EmbeddedSource(shares={"procedural": 1}).records("train", NUM_POOL, 0).pose)
    baselines = {
        "procedural families only": procedural,
        "clips and their mirror images": mixture.donors.rotmat,
        "independent uniform angles": independent_angles(NUM_POOL),
    }
    for name, poses in baselines.items():
        yield [
            name,
            str(len(poses)),
            *scorer.coverage(poses),
            *scorer.realism(poses),
            "",
            deepest(mixture, poses),
        ]
    yield ["real poses of all other subjects", str(NUM_POOL), *scorer.coverage_by_other_people(), *[""] * 4]


def print_subjects(scorer: Scorer) -> None:
    """Print the generator's mean coverage of each subject with its share of the frames, and all but `HARDEST`."""
    pool = features(to_rotmat(EmbeddedSource().records("train", NUM_POOL, 0).pose))
    rotmat, subject = scorer.real
    means = []
    for name in np.unique(subject):
        distance = distances(features(some(rotmat[subject == name], NUM_QUERIES)), pool)
        means.append(f"{name} {distance.mean():.1f} ({100 * (subject == name).mean():.0f} %)")
    others = features(some(rotmat[~np.isin(subject, HARDEST)], NUM_QUERIES))
    mean, p90 = _two(distances(others, pool))
    print("\nCoverage by subject (share of the real poses):", ", ".join(means), end=". ")
    print(f"Without {' and '.join(HARDEST)}: mean {mean}, p90 {p90}.")


def print_limits() -> None:
    """Print how much joint limits change the clips."""
    clips = torch.cat([EmbeddedSource().mixture.of(split).donors.rotmat for split in SPLITS])
    held = within_limits(clips)
    turned = rotmat_to_rotvec(clips.mT @ held).norm(dim=-1).rad2deg()
    moved = (features(held) - features(clips)).norm(dim=-1)
    print(
        f"\nJoint limits touch {100 * (turned > 1e-6).any(1).double().mean():.0f} % of the clips' frames, "
        f"{100 * (turned > 5).any(1).double().mean():.0f} % by more than 5 degrees at some joint "
        f"({100 * (turned > 5).double().mean():.1f} % of all joints); measured joints move by {moved.mean():.2f} cm in "
        f"the mean, {moved.amax(1).quantile(0.99):.1f} cm at most in 99 % of the frames."
    )


def print_table(scorer: Scorer) -> None:
    """Print the table, a row as soon as it is known."""
    heads = [
        "pool", "poses", "coverage mean", "p90", "held out mean", "p90", "realism mean", "p90", "rejected",
        "deepest, body / reference",
    ]  # fmt: skip
    print("|", " | ".join(heads), "|")
    print("|", " | ".join(["---"] + ["---:"] * (len(heads) - 1)), "|")
    for row in rows(scorer):
        print("|", " | ".join(row), "|", flush=True)


def draw_sheet(records: PoseRecords) -> Image.Image:
    """Poses as shaded bodies seen three-quarter from the front, each with its lowest vertex on the floor line."""
    cell, oversampling, distance = 160, 3, 8.0
    size = cell * oversampling
    focal = size * distance / 2.5  # 2.5 m fill a cell
    camera = Camera(fx=focal, fy=focal, cx=size / 2, cy=0.50 * size, width=size, height=size)
    smpl = SMPL(load_body_models(None, ("female", "male"))).double()
    pose = torch.from_numpy(records.pose).double()
    turn, tilt = (torch.tensor(math.radians(angle), dtype=torch.float64) for angle in (35.0, 5.0))
    root = rotmat_to_rotvec(rotation_about("z", turn) @ rotvec_to_rotmat(pose[:, :3]))
    pose, betas = torch.cat([root, pose[:, 3:]], -1), torch.from_numpy(records.betas).double()
    vertices = smpl(pose, betas, torch.from_numpy(records.gender)).vertices
    vertices[..., :2] -= (vertices[..., :2].amin(1) + vertices[..., :2].amax(1))[:, None] / 2
    vertices[..., 2] -= vertices[..., 2].amin(-1)[:, None]
    # Seen from a little above, along x, from the height of a standing person's hips.
    cam_from_world = rotation_about("x", tilt) @ CAMERA_FROM_BODY
    hips, away = torch.tensor([0.0, 0.0, 0.95]), torch.tensor([0.0, 0.0, distance])
    meshes = ((vertices - hips) @ cam_from_world.T + away).numpy()
    _, floor_y, floor_z = (-cam_from_world @ hips.double() + away).tolist()
    floor_row = round(focal * floor_y / floor_z + camera.cy)

    page = np.ones((SHEET_COLUMNS * size, SHEET_COLUMNS * size, 3))
    for number, mesh in enumerate(meshes):
        row, column = (size * index for index in divmod(number, SHEET_COLUMNS))
        tile = page[row : row + size, column : column + size]
        tile[floor_row : floor_row + oversampling] = 0.6
        tile[:] = shade_mesh(mesh, smpl.faces.numpy(), camera, GREY, background=tile.copy())
    return Image.fromarray((255 * page[..., 0]).astype(np.uint8)).reduce(oversampling)


def main() -> None:
    """Print the table; draw the sheet."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("real", type=Path, help="real motion capture (.npz)")
    parser.add_argument("--sheet", type=Path, help="also draw 64 random poses into this PNG")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.sheet:
        records = EmbeddedSource().records("train", SHEET_COLUMNS**2, SHEET_SEED)
        draw_sheet(records).save(arguments.sheet, optimize=True)
    scorer = Scorer(read_real(arguments.real))
    print_table(scorer)
    print_subjects(scorer)
    print_limits()


if __name__ == "__main__":
    main()
