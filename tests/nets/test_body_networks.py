import pytest
import torch
from torch import nn
from torch.nn import functional

from ljn.body.skeleton import JOINT_INDEX, JOINT_NAMES, LEVELS, PARENTS
from ljn.geometry.rotations import BODY_TO_OPENGL
from ljn.nets.body_network import DirectBodyNetwork, HierarchicalBodyNetwork
from ljn.nets.layers import StackedPReLU
from ljn.nets.pointnet import PointNet
from ljn.nets.pointnet2 import PointNet2

CHANNELS = 6 + 72


def pointnet2(**changes):
    return PointNet2(CHANNELS, (12, 4), (0.3, 0.6), (8, 4), ((6, 8), (8, 10)), (8, 12), **changes)


def hierarchical(trunk=None, **changes):
    sizes = {"head_channels": (8,), "regressor_channels": (8, 7)}
    return HierarchicalBodyNetwork(trunk or pointnet2(), **sizes, **changes)


def direct(**changes):
    return DirectBodyNetwork(pointnet2(), head_channels=(8,), regressor_channels=(9,), **changes)


NETWORKS = {
    "proposed": hierarchical,
    "single": lambda **changes: hierarchical(passes_ancestors=False, **changes),
    "pointnet": lambda **changes: hierarchical(PointNet(CHANNELS, (6, 6), (8, 10)), **changes),
    "basic": direct,
    "carried": lambda **changes: hierarchical(pointnet2(carried_channels=72), **changes),
    "carried on pointnet": lambda **changes: hierarchical(
        PointNet(CHANNELS, (6, 6), (8, 10), carried_channels=72), **changes
    ),
}


@pytest.fixture(params=NETWORKS)
def make(request):
    torch.manual_seed(0)
    return NETWORKS[request.param]


def batch(size=2, num_points=40, dtype=torch.float64):
    generator = torch.Generator().manual_seed(1)
    points = torch.randn(size, num_points, 6, generator=generator, dtype=dtype) * 0.3
    joints = torch.randn(size, 24, 3, generator=generator, dtype=dtype) * 0.3
    return points, joints


def randomised(net):
    """Larger weights than at the start make a difference visible."""
    net = net.double()
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.copy_(torch.randn_like(parameter) * 0.3)
    return net


@pytest.mark.parametrize("rotation", ["rotvec", "rot6d"])
def test_every_iteration_gives_rotations_and_a_shape(make, rotation):
    rotmats, betas = make(rotation=rotation, num_iterations=2).double()(*batch())
    assert rotmats.shape == (2, 2, 24, 3, 3)
    assert betas.shape == (2, 2, 10)
    torch.testing.assert_close(rotmats @ rotmats.mT, torch.eye(3, dtype=torch.float64).expand_as(rotmats))


@pytest.mark.parametrize("rotation", ["rotvec", "rot6d"])
def test_without_residuals_the_estimate_is_a_frontal_t_pose(make, rotation):
    net = make(rotation=rotation).double()
    with torch.no_grad():
        for name, parameter in net.named_parameters():
            if not name.startswith("mean_"):
                parameter.zero_()
        rotmats, betas = net(*batch())
    expected = torch.eye(3, dtype=torch.float64).repeat(24, 1, 1)
    expected[0] = BODY_TO_OPENGL.T
    torch.testing.assert_close(rotmats, expected.expand_as(rotmats))
    assert betas.abs().max() == 0


@pytest.mark.parametrize("rotation", ["rotvec", "rot6d"])
def test_every_parameter_gets_a_gradient(make, rotation):
    net = randomised(make(rotation=rotation))
    rotmats, betas = net(*batch())
    weights = torch.randn(rotmats.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    ((rotmats * weights).sum() + betas.square().sum()).backward()
    assert [name for name, p in net.named_parameters() if p.grad is None or not p.grad.any()] == []


WIDE = {
    "proposed": lambda: HierarchicalBodyNetwork(wide_pointnet2(), 3, "rotvec", (256,), (128, 128)),
    "pointnet": lambda: HierarchicalBodyNetwork(PointNet(CHANNELS, (64, 64), (64, 128, 256)), 3),
    "carried": lambda: HierarchicalBodyNetwork(wide_pointnet2(72), 3, "rot6d", (256,), (128, 128)),
    "basic": lambda: DirectBodyNetwork(wide_pointnet2(), 3, "rotvec", (256,), (256, 256)),
}


def wide_pointnet2(carried=None):
    return PointNet2(
        CHANNELS, (64, 16), (0.2, 0.4), (16, 16), ((64, 64), (64, 128)), (128, 256), carried_channels=carried
    )


def observed_bodies(size=16, num_points=256):
    """Points on ellipsoids of a body's size with their normals, 2.5 m away, and joints inside."""
    generator = torch.Generator().manual_seed(1)
    axes = torch.tensor([0.3, 0.8, 0.2])
    directions = functional.normalize(torch.randn(size, num_points, 3, generator=generator), dim=-1)
    normals = functional.normalize(directions / axes, dim=-1)
    joints = 0.6 * axes * torch.randn(size, 24, 3, generator=generator)
    away = torch.tensor([0.0, 0.0, 2.5])
    return torch.cat([axes * directions + away, normals], -1), joints + away


@pytest.mark.parametrize("name", WIDE)
def test_at_the_start_all_hidden_layers_are_heard_and_residuals_are_small(name):
    torch.manual_seed(0)
    net = WIDE[name]()
    spreads = {}
    for layer, module in net.named_modules():
        if isinstance(module, nn.PReLU | StackedPReLU):
            module.register_forward_hook(
                lambda _, __, out, layer=layer: spreads.setdefault(layer, []).append(float(out.std()))
            )
    with torch.no_grad():
        rotmats, betas = net(*observed_bodies())
    values = [value for layer in spreads.values() for value in layer]
    assert max(values) < 2 * min(values), spreads

    mean = torch.eye(3).repeat(24, 1, 1)
    mean[0] = BODY_TO_OPENGL.T
    turns = torch.stack([rotmats[0] - mean, *rotmats.diff(dim=0)])  # (T, B, 24, 3, 3)
    assert turns.flatten(-2).norm(dim=-1).mean((1, 2)).max() < 0.5  # of 2.8 for half a turn
    assert turns.abs().max() > 0
    assert betas.abs().mean() < 0.5


@pytest.mark.parametrize("name", ["proposed", "pointnet"])
def test_every_point_carries_the_initial_joints(name):
    net, (points, joints) = randomised(NETWORKS[name]()), batch()
    offsets = joints - joints[:, :1]
    carried = offsets.flatten(1)[:, None].expand(-1, points.shape[1], -1)
    centred = torch.cat([points[..., :3] - joints[:, :1], points[..., 3:]], -1)
    expected = net.trunk.global_feature(torch.cat([centred, carried], -1))
    torch.testing.assert_close(net.feature(points, joints), expected)


def test_where_the_person_stands_does_not_matter(make):
    net, (points, joints) = randomised(make()), batch()
    shift = torch.tensor([0.4, -0.2, 2.1], dtype=torch.float64)
    moved = torch.cat([points[..., :3] + shift, points[..., 3:]], -1)
    for here, there in zip(net(points, joints), net(moved, joints + shift)):
        torch.testing.assert_close(here, there)


def test_a_sample_does_not_depend_on_its_batch(make):
    net, (points, joints) = randomised(make()), batch(size=3)
    for together, alone in zip(net(points, joints), net(points[1:2], joints[1:2])):
        torch.testing.assert_close(together[:, 1:2], alone)


def test_the_hierarchical_network_equals_a_loop_over_joints_and_ancestors():
    torch.manual_seed(0)
    net = randomised(hierarchical(num_iterations=2))
    points, joints = batch()
    feature = net.feature(points, joints)
    pose = torch.randn(2, 24, 3, dtype=torch.float64)
    betas = torch.randn(2, 10, dtype=torch.float64)
    estimates = net.refine(feature, pose, betas)

    places = [(level, k) for level, joints in enumerate(LEVELS) for k in range(len(joints))]
    for refined_pose, refined_betas in estimates:
        refined = {}
        for joint, (level, k) in enumerate(places):
            regressors = net.joint_regressors[level]
            ancestors, ancestor = [], PARENTS[joint]
            while ancestor >= 0:
                ancestors.append(ancestor)
                ancestor = PARENTS[ancestor]
            x = torch.cat([pose[:, joint], *(refined[a] for a in ancestors), betas, feature], -1)
            x = functional.linear(x, regressors.first.weight[k], regressors.first.bias[k])
            x = functional.prelu(x, regressors.first_activation.weight[k, None])
            for layer in regressors.rest:
                if hasattr(layer, "bias"):
                    x = functional.linear(x, layer.weight[k], layer.bias[k])
                else:
                    x = functional.prelu(x, layer.weight[k, None])
            refined[joint] = pose[:, joint] + x
        pose = torch.stack([refined[joint] for joint in range(24)], 1)
        betas = betas + net.beta_regressor(torch.cat([feature, pose.flatten(1), betas], -1))
        torch.testing.assert_close(refined_pose, pose)
        torch.testing.assert_close(refined_betas, betas)


@pytest.mark.parametrize(
    ("passes_ancestors", "hear"), [(True, ["l_knee", "l_ankle", "l_foot"]), (False, ["l_knee"])]
)
def test_a_joint_hears_of_its_ancestors_and_of_no_other_joint(passes_ancestors, hear):
    torch.manual_seed(0)
    net = randomised(hierarchical(num_iterations=1, passes_ancestors=passes_ancestors))
    feature, betas = torch.randn(1, 12, dtype=torch.float64), torch.randn(1, 10, dtype=torch.float64)
    pose = torch.randn(1, 24, 3, dtype=torch.float64)
    changed = pose.clone()
    changed[:, JOINT_INDEX["l_knee"]] += 1
    (before, _), (after, _) = net.refine(feature, pose, betas)[0], net.refine(feature, changed, betas)[0]
    differs = (before != after).any(-1)[0]
    assert [name for name, d in zip(JOINT_NAMES, differs.tolist()) if d] == hear


def test_iterations_share_their_weights(make):
    assert make(num_iterations=1).state_dict().keys() == make(num_iterations=3).state_dict().keys()


def test_bad_arguments_are_refused(make):
    with pytest.raises(ValueError, match="rotation: expected one of rotvec, rot6d, got 'quaternion'"):
        make(rotation="quaternion")
    with pytest.raises(ValueError, match="num_iterations: expected 1 to 100, got 0"):
        make(num_iterations=0)
