import numpy as np
import pytest
import torch

from datamodules.sources.penetration import fit_capsules, penetration, segment_distance
from datamodules.sources.reference import REFERENCE_CAPSULES, REFERENCE_OFFSETS
from ljn.body import load_body_model
from ljn.body.kinematics import SIDES, joint_positions, world_rotations
from ljn.body.skeleton import JOINT_INDEX, NUM_JOINTS, PARENTS

DTYPE = torch.float64
ARM_THROUGH_TRUNK = {"l_shoulder": ("zyx", 30.0, -178.0, 0.0)}
ARMS_CROSSED_THROUGH_EACH_OTHER = {
    "l_shoulder": ("zyx", 0.0, -120.0, 0.0),
    "r_shoulder": ("zyx", 0.0, 120.0, 0.0),
}
SHIN_THROUGH_SHIN = {"l_hip": ("xzy", -10.0, -15.0, 0.0), "r_hip": ("xzy", -10.0, 15.0, 0.0)}
HANGING = {"l_shoulder": ("zyx", -70.0, 0.0, 0.0), "r_shoulder": ("zyx", 70.0, 0.0, 0.0)}


@pytest.fixture(scope="module")
def capsules(body):
    return fit_capsules(body)


@pytest.fixture(scope="module")
def depth(offsets, capsules):
    """The deepest penetration of poses on the body, metres."""
    return lambda rotmat: penetration(world_rotations(rotmat), offsets, capsules).amax(1)


def depth_on_reference(rotmat):
    return penetration(world_rotations(rotmat), REFERENCE_OFFSETS, REFERENCE_CAPSULES).amax(1)


def test_distances_between_segments_equal_a_search_over_both():
    generator = torch.Generator().manual_seed(0)
    ends = torch.rand(4, 3, 200, dtype=DTYPE, generator=generator)
    ends[1, :, :20] = ends[0, :, :20]  # points
    ends[3, :, 10:30] = ends[2, :, 10:30]
    ends[3, :, 30:50] = ends[2, :, 30:50] + 0.7 * (ends[1, :, 30:50] - ends[0, :, 30:50])  # parallel
    distance = segment_distance(*ends)
    steps = torch.linspace(0, 1, 80, dtype=DTYPE)
    one = ends[0, ..., None] + steps * (ends[1] - ends[0])[..., None]
    other = ends[2, ..., None] + steps * (ends[3] - ends[2])[..., None]
    search = (one[..., :, None] - other[..., None, :]).norm(dim=0).flatten(1).amin(1)
    assert (distance <= search + 1e-12).all()
    torch.testing.assert_close(distance, search, atol=0.015, rtol=0)


def test_the_t_pose_and_hanging_arms_are_clear(posed, depth):
    for pose in (posed(), posed(**HANGING)):
        assert depth(pose) < 0.01
        assert depth_on_reference(pose) < 0.01


@pytest.mark.parametrize("pose", [ARM_THROUGH_TRUNK, ARMS_CROSSED_THROUGH_EACH_OTHER, SHIN_THROUGH_SHIN])
def test_limbs_through_the_trunk_or_each_other_are_found(posed, depth, pose):
    assert depth(posed(**pose)) > 0.05
    assert depth_on_reference(posed(**pose)) > 0.05


def test_depth_is_the_overlap_of_the_capsules(posed, offsets, capsules):
    # Two capsules moved by hand: the hands, brought onto one line by sliding the skeleton's offsets.
    world = world_rotations(posed())
    pair = [capsules.names.index(name) for name in ("l_hand", "r_hand")]
    column = (capsules.pairs == torch.tensor(pair)[:, None]).all(0).nonzero().item()
    apart = penetration(world, offsets, capsules)[0, column]
    moved = offsets.clone()
    moved[JOINT_INDEX["l_wrist"]] -= torch.tensor([0.10, 0.0, 0.0])
    nearer = penetration(world, moved, capsules)[0, column]
    assert (nearer - apart).item() == pytest.approx(0.10, abs=1e-3)  # they point at each other along x


@pytest.mark.parametrize("gender", ["neutral", "female", "male"])
def test_capsules_have_the_body_parts_sizes(gender):
    capsules = fit_capsules(load_body_model(gender=gender))
    radii = dict(zip(capsules.names, capsules.radii.tolist()))
    for name, low, high in (
        ("pelvis", 0.10, 0.15), ("waist", 0.07, 0.13), ("chest", 0.10, 0.15), ("head", 0.06, 0.11),
        ("thigh", 0.06, 0.10), ("shin", 0.04, 0.07), ("foot", 0.03, 0.05),
        ("upper_arm", 0.035, 0.06), ("forearm", 0.028, 0.045), ("hand", 0.02, 0.05),
    ):  # fmt: skip
        for key in [name] if name in radii else [f"{side}_{name}" for side in SIDES]:
            assert low < radii[key] < high


def test_capsules_lie_within_the_body(body, capsules, offsets):
    # Each axis is closer to the mesh's vertices of its part than its radius, by half of them.
    joints = joint_positions(torch.eye(3, dtype=DTYPE).expand(1, NUM_JOINTS, 3, 3), offsets)[0]
    root = (body.J_regressor @ body.v_template)[0]
    vertices = torch.from_numpy((body.v_template - root).astype(np.float64))
    owner = torch.from_numpy(body.weights.argmax(1))
    for side in SIDES:
        for name in ("forearm", "shin"):
            number = capsules.names.index(f"{side}_{name}")
            joint = capsules.joints[number, 0]
            start, end = joints[joint] + capsules.ends[number]
            part = vertices[owner == joint].T
            line = [start[:, None].expand_as(part), end[:, None].expand_as(part)]
            distance = segment_distance(part, part, *line)
            assert 0.35 < (distance < capsules.radii[number]).double().mean() < 0.6


def test_neighbours_are_not_tested_against_each_other(capsules):
    tested = {(capsules.names[i], capsules.names[j]) for i, j in capsules.pairs.T.tolist()}
    for pair in (("pelvis", "waist"), ("l_upper_arm", "l_forearm"), ("pelvis", "r_thigh"), ("chest", "head")):
        assert pair not in tested
    for pair in (("chest", "l_upper_arm"), ("l_thigh", "r_thigh"), ("head", "r_hand")):
        assert pair in tested
    assert all(i < j for i, j in capsules.pairs.T.tolist())


def test_the_reference_skeleton_is_symmetric_and_of_human_size():
    length = REFERENCE_OFFSETS.norm(dim=1)
    for name, joint in JOINT_INDEX.items():
        if name.startswith("l_"):
            other = REFERENCE_OFFSETS[JOINT_INDEX["r" + name[1:]]]
            assert torch.equal(REFERENCE_OFFSETS[joint] * torch.tensor([-1.0, 1.0, 1.0]), other)
    assert PARENTS[JOINT_INDEX["l_knee"]] == JOINT_INDEX["l_hip"]
    assert 0.7 < (length[JOINT_INDEX["l_knee"]] + length[JOINT_INDEX["l_ankle"]]).item() < 0.85
    assert len(REFERENCE_CAPSULES.names) == 11
    assert REFERENCE_CAPSULES.pairs.shape == (2, 43)
