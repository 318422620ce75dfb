import numpy as np
import pytest
import torch

from datamodules.sources.embedded.arms import GOALS
from datamodules.sources.embedded.families import FAMILIES
from datamodules.sources.embedded.joint_limits import within_limits
from datamodules.sources.embedded.posture import Draw
from datamodules.sources.embedded.procedural import draw_poses
from datamodules.sources.embedded.source import FAMILY_SHARES
from ljn.body.kinematics import SIDES
from ljn.body.skeleton import JOINT_INDEX
from ljn.geometry.rotations import rotmat_to_rotvec

FEET = [JOINT_INDEX[f"{side}_{name}"] for side in SIDES for name in ("foot", "ankle")]


@pytest.fixture(params=FAMILIES)
def family(request):
    return request.param


def stacked(joints):
    return torch.stack(list(joints.values()), 1)  # in the order of JOINT_NAMES


def bend(joints, upper, middle, lower):
    """The angle between two bones, degrees: 0 where the limb is straight."""
    one, other = joints[middle] - joints[upper], joints[lower] - joints[middle]
    return torch.cosine_similarity(one, other, dim=-1).clamp(-1, 1).acos().rad2deg()


def knees(joints):
    return torch.stack([bend(joints, f"{s}_hip", f"{s}_knee", f"{s}_ankle") for s in SIDES], 1)


def trunk_elevation(joints):
    """Degrees between the trunk and the floor."""
    trunk = joints["neck"] - joints["pelvis"]
    return torch.asin(trunk[:, 1] / trunk.norm(dim=-1)).rad2deg()


def share(condition):
    return condition.double().mean().item()


def test_every_family_has_a_default_share():
    assert set(FAMILY_SHARES) == set(FAMILIES)
    assert min(FAMILY_SHARES.values()) > 0


def test_poses_are_rotations_and_differ(family, family_poses):
    rotmat = family_poses(family, 50)
    torch.testing.assert_close(rotmat @ rotmat.mT, torch.eye(3).double().expand_as(rotmat))
    assert (torch.linalg.det(rotmat) > 0).all()
    assert len(np.unique(rotmat[:, 1:].flatten(1).numpy().round(6), axis=0)) == 50


def test_joint_limits_change_families_little(family, family_poses):
    rotmat = family_poses(family)
    moved = rotmat_to_rotvec(rotmat.mT @ within_limits(rotmat)).norm(dim=-1).rad2deg()
    assert moved.mean() < 1.0
    assert share(moved > 10) < 0.03


def test_the_same_stream_gives_the_same_poses_in_any_company(family, offsets):
    one, same, other = (draw_poses(np.random.default_rng(s), np.full(5, family), offsets) for s in (1, 1, 2))
    assert torch.equal(one, same)
    assert (one - other).abs().flatten(1).amax(1).min() > 0.01


def test_left_and_right_are_alike_on_average(family, family_poses, place):
    joints = place(family_poses(family, 2000))
    for name in ("knee", "ankle", "wrist"):
        left, right = (joints[f"{side}_{name}"].mean(0) for side in SIDES)
        mirrored = right * torch.tensor([-1.0, 1.0, 1.0])
        assert (left - mirrored).norm() < 0.05


@pytest.mark.parametrize("name", ["stand", "walk", "run", "squat", "lunge", "kick"])
def test_whoever_is_on_their_feet_has_them_lowest_and_the_head_highest(name, family_poses, place):
    height = stacked(place(family_poses(name)))[..., 1]
    assert share(torch.isin(height.argmin(1), torch.tensor(FEET))) > 0.9
    assert share(height[:, JOINT_INDEX["head"]] > height[:, FEET].amin(1) + 0.5) > 0.97


def test_standing_and_walking_knees_are_nearly_straight(family_poses, place):
    assert knees(place(family_poses("stand"))).median() < 25
    walking = knees(place(family_poses("walk")))
    assert 15 < walking.median() < 45
    assert walking.max() > 50  # in the swing


def test_walkers_stride_and_swing_their_arms_against_it(family_poses, place):
    joints = place(family_poses("walk", 1000))
    step = joints["l_ankle"][:, 2] - joints["r_ankle"][:, 2]
    swing = joints["l_wrist"][:, 2] - joints["r_wrist"][:, 2]
    assert 0.3 < step.abs().median() < 0.8
    assert torch.corrcoef(torch.stack([step, swing]))[0, 1] < -0.5


def test_runners_stride_farther_and_bend_knees_and_elbows_more(family_poses, place):
    run, walk = (place(family_poses(name)) for name in ("run", "walk"))
    elbows = [bend(run, f"{s}_shoulder", f"{s}_elbow", f"{s}_wrist").median() for s in SIDES]
    assert min(elbows) > 60
    assert knees(run).mean() > knees(walk).mean() + 15


def test_squatters_bend_both_knees_and_keep_their_feet_under_them(family_poses, place):
    joints = place(family_poses("squat"))
    both = knees(joints)
    assert share((both > 20).all(1)) > 0.97
    assert both.max() > 120
    assert torch.corrcoef(both.T)[0, 1] > 0.9
    ankles = (joints["l_ankle"] + joints["r_ankle"]) / 2
    middle = stacked(joints).mean(1)
    assert (ankles[:, 2] - middle[:, 2]).abs().mean() < 0.25


def test_sitters_have_level_thighs_and_an_upright_trunk(family_poses, place):
    joints = place(family_poses("sit"))
    for side in SIDES:
        thigh = joints[f"{side}_knee"] - joints[f"{side}_hip"]
        assert (thigh[:, 1] / thigh.norm(dim=-1)).asin().rad2deg().abs().median() < 25
    assert trunk_elevation(joints).median() > 60


def test_kneelers_have_a_knee_lowest_or_nearly(family_poses, place):
    joints = place(family_poses("kneel"))
    height = stacked(joints)[..., 1]
    knee = torch.minimum(joints["l_knee"][:, 1], joints["r_knee"][:, 1])
    assert share(knee - height.amin(1) < 0.25) > 0.9
    assert trunk_elevation(joints).median() > 50


def test_crawlers_have_a_level_trunk_and_hands_as_low_as_knees_or_feet(family_poses, place):
    joints = place(family_poses("crawl"))
    assert trunk_elevation(joints).abs().median() < 25
    hands = torch.stack([joints["l_hand"][:, 1], joints["r_hand"][:, 1]], 1).mean(1)
    others = stacked(joints)[..., 1]
    assert (hands - others.amin(1)).median() < 0.15
    assert share(joints["pelvis"][:, 1] - hands > 0.25) > 0.9


def test_who_lies_is_level_and_low(family_poses, place):
    joints = place(family_poses("lie"))
    assert trunk_elevation(joints).abs().quantile(0.9) < 20
    trunk = torch.stack([joints[name][:, 1] for name in ("pelvis", "neck", "head")], 1)
    assert ((trunk.mean(1) - stacked(joints)[..., 1].amin(1)) < 0.35).double().mean() > 0.8


def test_hands_stay_in_reach_of_the_shoulders(family, family_poses, place, offsets):
    joints = place(family_poses(family))
    for side in SIDES:
        length = sum(offsets[JOINT_INDEX[f"{side}_{name}"]].norm() for name in ("elbow", "wrist"))
        distance = (joints[f"{side}_wrist"] - joints[f"{side}_shoulder"]).norm(dim=-1) / length
        assert distance.min() > 0.3
        assert distance.max() < 1.0


def test_goals_come_in_their_shares_and_often_alike():
    names = list(GOALS)
    goals = Draw(np.random.default_rng(0), 5000).goals({"hang": 3, "wide": 1})
    assert set(np.unique(goals)) == {names.index("hang"), names.index("wide")}
    assert (goals == names.index("wide")).mean() == pytest.approx(0.25, abs=0.02)
    by_chance = 0.75**2 + 0.25**2
    assert (goals[:, 0] == goals[:, 1]).mean() == pytest.approx(0.35 + 0.65 * by_chance, abs=0.03)
