import numpy as np
import pytest
import torch

from datamodules.sources.embedded.arms import GOALS, draw_targets, pose_arms, reach
from ljn.body.kinematics import SIDES
from ljn.body.skeleton import JOINT_INDEX, NUM_JOINTS
from ljn.geometry.rotations import rotmat_to_euler

DTYPE = torch.float64


def bones(offsets, side):
    return offsets[JOINT_INDEX[f"{side}_elbow"]], offsets[JOINT_INDEX[f"{side}_wrist"]]


def random_directions(n, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(n, 3, dtype=DTYPE, generator=generator), dim=-1)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("crooked", [False, True])
def test_the_wrist_reaches_its_target_and_the_elbow_lies_towards_the_pole(offsets, side, crooked):
    n, sign = 200, SIDES[side]
    to_elbow, to_wrist = bones(offsets, side)
    if crooked:  # bones that are not in line at rest, as in other bodies
        to_elbow = to_elbow + torch.tensor([0.0, -0.02, -0.025])
        to_wrist = to_wrist + torch.tensor([0.0, 0.015, 0.01])
    length = (to_elbow.norm() + to_wrist.norm()).item()
    generator = torch.Generator().manual_seed(1)
    distance = length * (0.36 + 0.62 * torch.rand(n, 1, dtype=DTYPE, generator=generator))
    target, pole = random_directions(n) * distance, random_directions(n, seed=2)
    turn = torch.linspace(-1, 1, n, dtype=DTYPE)
    shoulder, elbow = reach(to_elbow, to_wrist, target, pole, turn, torch.tensor(float(sign), dtype=DTYPE))
    at_elbow = shoulder @ to_elbow
    at_wrist = at_elbow + (shoulder @ elbow @ to_wrist[:, None]).squeeze(-1)
    torch.testing.assert_close(at_wrist, target, atol=1e-9, rtol=0)
    along = (target * at_elbow).sum(-1, keepdim=True) / target.square().sum(-1, keepdim=True) * target
    across_pole = (
        pole - (target * pole).sum(-1, keepdim=True) / target.square().sum(-1, keepdim=True) * target
    )
    cosine = torch.cosine_similarity(at_elbow - along, across_pole, dim=-1)
    torch.testing.assert_close(cosine, torch.ones(n, dtype=DTYPE), atol=1e-6, rtol=0)
    angles = rotmat_to_euler("yzx", elbow).rad2deg()
    assert (sign * angles[:, 0] < 10).all()  # bends the way that elbows bend
    torch.testing.assert_close(angles[:, 1], torch.zeros(n, dtype=DTYPE), atol=1e-9, rtol=0)
    torch.testing.assert_close(angles[:, 2], turn.rad2deg())


def test_what_is_out_of_reach_is_reached_for(offsets):
    to_elbow, to_wrist = bones(offsets, "l")
    target = torch.tensor([[0.0, 2.0, 0.0]], dtype=DTYPE)
    pole, turn, side = torch.tensor([[1.0, 0, 0]]).double(), torch.zeros(1).double(), torch.ones(1).double()
    shoulder, elbow = reach(to_elbow, to_wrist, target, pole, turn, side)
    wrist = (shoulder @ (to_elbow[:, None] + elbow @ to_wrist[:, None])).squeeze(-1)
    assert torch.cosine_similarity(wrist, target).item() == pytest.approx(1)
    assert 0.98 < wrist.norm() / (to_elbow.norm() + to_wrist.norm()) <= 1


def test_targets_are_scattered_about_their_goals_within_reach():
    names = list(GOALS)
    for name, goal in GOALS.items():
        goals = np.full((2000, 2), names.index(name))
        target = draw_targets(np.random.default_rng(0), goals, np.zeros(2000), np.zeros(2000)).numpy()
        distance = np.linalg.norm(target, axis=-1)
        assert distance.min() >= 0.36 - 1e-9
        assert distance.max() <= 0.985 + 1e-9
        mean = target.mean((0, 1))
        assert np.dot(mean, goal.mean) / np.linalg.norm(mean) / np.linalg.norm(goal.mean) > 0.95


def test_arms_swing_against_each_other_and_drop_together():
    goals = np.full((500, 2), list(GOALS).index("hang"))
    swing, drop = np.full(500, 0.3), np.zeros(500)
    left, right = draw_targets(np.random.default_rng(0), goals, swing, drop).mean(0)
    assert left[2] - right[2] > 0.4
    goals = np.full((500, 2), list(GOALS).index("support"))
    left, right = draw_targets(np.random.default_rng(0), goals, 0 * swing, np.full(500, 90.0)).mean(0)
    for target in (left, right):  # from forward to down
        assert target[1] < -0.8


@pytest.mark.parametrize("name", ["front", "overhead", "wide", "support"])
def test_posed_hands_are_where_they_should_be(offsets, place, name):
    rng = np.random.default_rng(0)
    goals = np.full((300, 2), list(GOALS).index(name))
    target = draw_targets(rng, goals, np.zeros(300), np.zeros(300))
    rotmat = torch.eye(3, dtype=DTYPE).repeat(300, NUM_JOINTS, 1, 1)
    pose_arms(rng, target, offsets, rotmat)
    joints = place(rotmat)
    for number, (side, sign) in enumerate(SIDES.items()):
        length = sum(bone.norm() for bone in bones(offsets, side))
        wrist = (joints[f"{side}_wrist"] - joints[f"{side}_shoulder"]) / length
        expected = target[:, number] * torch.tensor([float(sign), 1.0, 1.0])
        torch.testing.assert_close(wrist, expected, atol=1e-3, rtol=0)
