import pytest
import torch

from datamodules.sources.embedded import EmbeddedSource
from datamodules.sources.embedded.joint_limits import (
    RANGES,
    SHOULDER_ACROSS_DEG,
    SHOULDER_BACK_DEG,
    SHOULDER_TWIST_DEG,
    with_square_elbows,
    within_limits,
)
from ljn.body.kinematics import SIDES, joint_positions, mirror, world_rotations
from ljn.body.skeleton import JOINT_INDEX, NUM_JOINTS, ROOT
from ljn.geometry.rotations import (
    euler_to_rotmat,
    rotmat_to_euler,
    rotmat_to_rotvec,
    rotvec_to_rotmat,
    swing_twist,
)

DTYPE = torch.float64
LIMITED = [
    (joint, kind)
    for kind in RANGES
    for joint in ([kind] if kind in JOINT_INDEX else [f"{side}_{kind}" for side in SIDES])
]


def random_poses(n=400, scale=1.2, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return rotvec_to_rotmat(scale * torch.randn(n, NUM_JOINTS, 3, dtype=DTYPE, generator=generator))


def angles_of(rotmat, joint, kind):
    """Angles `(n, 3)`, degrees, as the left side counts them."""
    angles = rotmat_to_euler(RANGES[kind].axes, rotmat[:, JOINT_INDEX[joint]]).rad2deg()
    if joint.startswith("r_"):
        angles = angles * torch.tensor([1.0 if axis == "x" else -1.0 for axis in RANGES[kind].axes])
    return angles


def uniform_poses(n=200):
    """Poses anywhere within the ranges."""
    rotmat = torch.eye(3, dtype=DTYPE).repeat(n, NUM_JOINTS, 1, 1)
    generator = torch.Generator().manual_seed(0)
    for joint, kind in LIMITED:
        axes, low, high = RANGES[kind]
        low, high = torch.tensor(low, dtype=DTYPE), torch.tensor(high, dtype=DTYPE)
        angles = (low + (high - low) * torch.rand(n, 3, dtype=DTYPE, generator=generator)).deg2rad()
        side = [-1.0 if joint.startswith("r_") and axis != "x" else 1.0 for axis in axes]
        rotmat[:, JOINT_INDEX[joint]] = euler_to_rotmat(axes, angles * torch.tensor(side))
    return rotmat


def test_every_joint_but_the_root_and_the_shoulders_has_ranges():
    assert len(LIMITED) == NUM_JOINTS - 3
    for axes, low, high in RANGES.values():
        assert all(a <= 0 <= b for a, b in zip(low, high))
        assert max(abs(low[1]), abs(high[1])) < 75  # far from where the angles become ambiguous
        assert sorted(axes) == ["x", "y", "z"]


@pytest.mark.parametrize(("joint", "kind"), LIMITED)
def test_all_angles_end_up_within_their_ranges(joint, kind):
    angles = angles_of(within_limits(random_poses()), joint, kind)
    assert (angles >= torch.tensor(RANGES[kind].low, dtype=DTYPE) - 1e-9).all()
    assert (angles <= torch.tensor(RANGES[kind].high, dtype=DTYPE) + 1e-9).all()


def test_legal_poses_stay_as_they_are_to_the_last_bit():
    rotmat = uniform_poses()
    torch.testing.assert_close(within_limits(rotmat), rotmat, atol=1e-12, rtol=0)
    inside = within_limits(random_poses())
    shrunk = rotvec_to_rotmat(0.9 * rotmat_to_rotvec(inside))
    is_same = (within_limits(shrunk) == shrunk).flatten(2).all(-1)
    assert is_same.double().mean() > 0.9
    rest = torch.eye(3, dtype=DTYPE).repeat(1, NUM_JOINTS, 1, 1)
    assert torch.equal(within_limits(rest), rest)


def test_held_poses_stay_so_the_root_turns_freely_and_both_sides_have_the_same_limits():
    rotmat = random_poses()
    held = within_limits(rotmat)
    torch.testing.assert_close(within_limits(held), held, atol=1e-9, rtol=0)
    assert torch.equal(held[:, ROOT], rotmat[:, ROOT])
    torch.testing.assert_close(within_limits(mirror(rotmat)), mirror(held), atol=1e-9, rtol=0)


@pytest.mark.parametrize("side", SIDES)
def test_knees_bend_backwards_only(posed, place, side):
    knee = {f"{side}_knee": ("xzy", 90.0, 0.0, 0.0)}
    bent = within_limits(posed(**knee))
    joints = place(bent)
    assert joints[f"{side}_ankle"][0, 2] < joints[f"{side}_knee"][0, 2] - 0.3  # z is forward
    wrong = within_limits(posed(**{f"{side}_knee": ("xzy", -90.0, 0.0, 0.0)}))
    assert place(wrong)[f"{side}_ankle"][0, 2] < joints[f"{side}_knee"][0, 2] + 0.1


@pytest.mark.parametrize("side", SIDES)
def test_elbows_bend_forwards_only(posed, place, side):
    sign = SIDES[side]
    joints = place(within_limits(posed(**{f"{side}_elbow": ("yzx", -90.0 * sign, 0.0, 0.0)})))
    assert joints[f"{side}_wrist"][0, 2] > joints[f"{side}_elbow"][0, 2] + 0.2
    joints = place(within_limits(posed(**{f"{side}_elbow": ("yzx", 90.0 * sign, 0.0, 0.0)})))
    assert joints[f"{side}_wrist"][0, 2] > joints[f"{side}_elbow"][0, 2] - 0.05


@pytest.mark.parametrize("side", SIDES)
def test_hips_bring_the_leg_far_forward_and_little_backward(posed, place, side):
    for angle, low, high in ((-170.0, 0.2, 0.4), (90.0, -0.3, -0.1)):
        joints = place(within_limits(posed(**{f"{side}_hip": ("xzy", angle, 0.0, 0.0)})))
        forward = joints[f"{side}_knee"][0, 2] - joints[f"{side}_hip"][0, 2]
        assert low < forward < high


@pytest.mark.parametrize("side", SIDES)
def test_upper_arms_keep_out_of_the_back_and_the_far_side(side):
    sign, joint = SIDES[side], JOINT_INDEX[f"{side}_shoulder"]
    arm = torch.tensor([sign, 0.0, 0.0], dtype=DTYPE)
    rotmat = random_poses(2000, scale=2.0)
    held = within_limits(rotmat)[:, joint]
    towards = held @ arm
    assert torch.asin(-towards[:, 2]).rad2deg().max() <= SHOULDER_BACK_DEG + 1e-6
    assert torch.asin((-towards * arm).sum(-1)).rad2deg().max() <= SHOULDER_ACROSS_DEG + 1e-6
    twist = sign * swing_twist(held, arm)[1].rad2deg()
    assert twist.min() >= SHOULDER_TWIST_DEG[0] - 1e-6
    assert twist.max() <= SHOULDER_TWIST_DEG[1] + 1e-6
    # Those that were out of bounds were led to the bounds and no farther.
    before = rotmat[:, joint] @ arm
    back = torch.asin(-towards[(before[:, 2] < -0.9) & (before @ arm > 0), 2]).rad2deg()
    torch.testing.assert_close(back, torch.full_like(back, SHOULDER_BACK_DEG))


def test_real_poses_are_hardly_touched():
    donors = EmbeddedSource().mixture.of("test").donors.rotmat
    moved = rotmat_to_rotvec(donors.mT @ within_limits(donors)).norm(dim=-1).rad2deg()
    assert (moved > 5).any(1).double().mean() < 0.15
    assert moved.mean() < 0.3


# Elbows whose hinge lies elsewhere


def test_squaring_elbows_moves_no_joint_and_leaves_no_sideways_bend(offsets):
    rotmat = within_limits(random_poses(scale=0.6))
    for side in SIDES:  # hinges tilted by 25 degrees, bent by 5 to 120
        axis = torch.tensor([0.0, -0.9, 0.42 * SIDES[side]], dtype=DTYPE) * SIDES[side]
        flexion = torch.linspace(5, 120, len(rotmat), dtype=DTYPE).deg2rad()
        rotmat[:, JOINT_INDEX[f"{side}_elbow"]] = rotvec_to_rotmat(flexion[:, None] * axis)
    square = with_square_elbows(rotmat)
    before, after = (joint_positions(world_rotations(poses), offsets) for poses in (rotmat, square))
    torch.testing.assert_close(after, before, atol=2e-3, rtol=0)  # the forearm is not quite on the x axis
    for side in SIDES:
        wrist = JOINT_INDEX[f"{side}_wrist"]
        torch.testing.assert_close(world_rotations(square)[:, wrist], world_rotations(rotmat)[:, wrist])
        angles = angles_of(square, f"{side}_elbow", "elbow")
        assert angles[angles[:, 0] < -20, 1].abs().max() < 1e-6
        assert angles[:, 1].abs().max() < 8
    others = [j for j, name in enumerate(JOINT_INDEX) if name[2:] not in ("shoulder", "elbow")]
    assert torch.equal(square[:, others], rotmat[:, others])


def test_straight_and_square_elbows_stay(posed):
    rotmat = torch.cat(
        [posed(), posed(l_elbow=("yzx", -3.0, 3.0, 20.0)), posed(l_elbow=("yzx", -80.0, 0.0, 40.0))]
    )
    torch.testing.assert_close(with_square_elbows(rotmat), rotmat)
