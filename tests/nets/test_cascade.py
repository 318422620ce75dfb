import pytest
import torch

from ljn.body import SMPL
from ljn.geometry.rotations import BODY_TO_OPENGL
from ljn.nets.cascade import PatchCascade
from ljn.nets.kinematic import KinematicNetwork

SMALL = {
    "patch_sizes_m": (0.5, 0.4), "patch_px": 8, "square_channels": 8, "joint_channels": (8, 8), "crop_channels": 8,
    "context_channels": 8, "encoder_channels": (4, 8, 8, 8),
}  # fmt: skip


def observation(size=3, crop_px=64):
    """Tilted planes before the camera, and joints near them."""
    generator = torch.Generator().manual_seed(0)
    joints = 0.3 * torch.randn(size, 24, 3, generator=generator) + torch.tensor([0.0, 0.0, 2.0])
    rows = torch.arange(crop_px) - crop_px / 2
    crop = 2 + 0.002 * rows[:, None] + 0.001 * rows + 0.1 * torch.arange(size)[:, None, None]
    crop[:, :5] = crop[:, :, :8] = 0
    return crop, torch.tensor([60.0, 60, 31.5, 31.5]).expand(size, 4), joints, torch.ones(size, 24)


@pytest.mark.parametrize(("start", "steps", "trained"), [("keypoints", 2, 2), ("either", 4, 6)])
def test_every_step_is_estimated_and_every_parameter_gets_a_gradient(start, steps, trained):
    torch.manual_seed(0)
    net = PatchCascade(start, **SMALL)
    arguments = observation()[: len(net.takes)]
    estimates = net.estimates(*arguments)
    assert estimates.shape == (trained, 3, 24, 3)
    estimates.square().sum().backward()
    assert [name for name, p in net.named_parameters() if p.grad is None or not p.grad.any()] == []
    estimates = net.eval().estimates(*arguments)
    assert estimates.shape == (steps, 3, 24, 3)
    assert torch.equal(net(*arguments), estimates[-1])


def test_a_missing_keypoint_says_nothing_and_one_that_is_there_says_much():
    torch.manual_seed(0)
    net = PatchCascade(**SMALL).eval()
    crop, camera, joints, confidences = observation()
    confidences[0], confidences[1, 5:] = 0, 0
    moved = joints + 0.1 * (confidences[..., None] == 0)
    assert torch.equal(net(crop, camera, joints, confidences), net(crop, camera, moved, confidences))
    moved = joints + 0.1 * (confidences[..., None] > 0)
    steps = net(crop, camera, moved, confidences) - net(crop, camera, joints, confidences)
    assert (steps[1, :5] - 0.1).abs().max() < 0.05
    assert not steps[0].any()


def test_training_learns_each_sample_without_keypoints_and_with_some():
    torch.manual_seed(0)
    net = PatchCascade(keypoint_dropout=1.0, **SMALL)
    crop, camera, joints, confidences = observation(400)
    *_, bare, bare_last, some, _ = net.estimates(crop, camera, joints, confidences)
    blind = net.eval().estimates(crop, camera, joints, 0 * confidences)
    torch.testing.assert_close(torch.stack([bare, bare_last]), blind[-2:])
    kept = ((some - joints).norm(dim=-1) < (some - blind[1]).norm(dim=-1)).float().mean(1)
    assert 0.4 < kept.mean() < 0.6
    assert kept.min() < 0.1
    assert kept.max() > 0.9


def test_steps_start_small_and_keep_their_size():
    torch.manual_seed(0)
    crop, camera, joints, _ = observation()
    steps = PatchCascade("keypoints").estimates(crop, camera, joints) - joints
    assert 0.01 < steps[0].norm(dim=-1).mean() < 0.1


def test_moving_body_and_joints_in_depth_moves_the_prediction_with_them():
    torch.manual_seed(0)
    net = PatchCascade(**SMALL).eval()
    crop, camera, joints, _ = observation()
    # Twice as far with twice the focal length: the same picture of a body twice as deep only in position.
    moved = net(torch.where(crop > 0, crop + 1, 0), camera, joints + torch.tensor([0.0, 0, 1]))
    assert (moved[..., 2] - net(crop, camera, joints)[..., 2] - 1).abs().max() < 0.05


@pytest.mark.parametrize(
    "change", [{"start": "rgb"}, {"patch_px": 10}, {"patch_sizes_m": ()}, {"keypoint_dropout": 2}]
)
def test_impossible_settings_are_errors(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        PatchCascade(**change)


def test_the_kinematic_network_begins_with_the_observed_bones():
    torch.manual_seed(0)
    body = SMPL.load()
    net = KinematicNetwork(channels=16)
    net.use_body(body)
    pose, upright = 0.3 * torch.randn(5, 72), torch.tensor([1.0, -1, -1])
    joints = body(pose, torch.zeros(5, 10)).joints
    rotmats, betas = net(joints * upright + torch.tensor([0.1, 0.2, 3.0]))
    assert (rotmats.shape, betas.shape) == ((2, 5, 24, 3, 3), (2, 5, 10))
    torch.testing.assert_close(rotmats @ rotmats.mT, torch.eye(3).expand_as(rotmats), atol=1e-5, rtol=0)
    made = body.from_rotmats(rotmats[-1], betas[-1]).joints @ BODY_TO_OPENGL.float().T
    for start, end in ((1, 4), (4, 7), (16, 18), (18, 20), (12, 15), (0, 3)):
        bones = [torch.nn.functional.normalize(x[:, end] - x[:, start], dim=-1) for x in (made, joints)]
        torch.testing.assert_close(*bones, atol=1e-4, rtol=0)


def test_a_layer_on_some_vertices_gives_those_and_all_joints(body_models):
    layer = SMPL(body_models)
    chosen = torch.tensor([5, 700, 6889])
    pose, betas, gender = 0.2 * torch.randn(4, 72), torch.randn(4, 10), torch.tensor([0, 1, 1, 0])
    vertices, joints = layer(pose, betas, gender)
    some = layer.on_vertices(chosen)(pose, betas, gender)
    torch.testing.assert_close(some.vertices, vertices[:, chosen])
    torch.testing.assert_close(some.joints, joints)
