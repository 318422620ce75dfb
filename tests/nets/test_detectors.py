import itertools

import pytest
import torch
from torch import nn

from ljn.nets.basic_detector import BasicDetector
from ljn.nets.joint_network import LocalJointNetwork
from ljn.nets.layers import StackedLinear, StackedPReLU
from ljn.nets.simple_baseline import SimpleBaseline
from ljn.nets.yardsticks import MeanOffset, Ridge

SIZES = {"local_channels": (6, 6), "global_channels": (6, 8, 10), "head_channels": (8, 6)}
RADII = [0.3] * 24


def joint_network(**changes):
    sizes = {"radii_m": RADII, "group_size": 8, "group_channels": (6, 8, 10), **SIZES}
    return LocalJointNetwork(**{**sizes, **changes})


NETWORKS = {
    "proposed": joint_network,
    "no_edm": lambda **changes: joint_network(edm=False, **changes),
    "basic": lambda **changes: BasicDetector(**SIZES, **changes),
}


@pytest.fixture(params=NETWORKS)
def make(request):
    torch.manual_seed(0)
    return NETWORKS[request.param]


def batch(size=3, num_points=40, dtype=torch.float32):
    generator = torch.Generator().manual_seed(1)
    points = torch.randn(size, num_points, 6, generator=generator, dtype=dtype) * 0.3
    points[..., 2] += 2
    joints = torch.randn(size, 24, 3, generator=generator, dtype=dtype) * 0.3
    joints[..., 2] += 2
    return points, joints


def test_every_parameter_gets_a_gradient(make):
    net = make()
    with torch.no_grad():
        net.trunk.lift[-1].bias -= 1  # of some channels all values are negative, and the last slope matters
    net(*batch()).square().sum().backward()
    without = [name for name, p in net.named_parameters() if p.grad is None or not p.grad.any()]
    assert without == []


def test_the_prediction_moves_with_the_person(make):
    net = make().double()
    points, joints = batch(dtype=torch.float64)
    shift = torch.tensor([0.4, -0.2, 0.9], dtype=torch.float64)
    moved = torch.cat([points[..., :3] + shift, points[..., 3:]], -1)
    torch.testing.assert_close(net(moved, joints + shift), net(points, joints) + shift)


def test_the_order_of_the_points_does_not_matter_without_an_overfull_ball():
    net = joint_network(group_size=64, radii_m=[0.5] * 24).double()
    points, joints = batch(dtype=torch.float64)
    order = torch.randperm(points.shape[1], generator=torch.Generator().manual_seed(2))
    torch.testing.assert_close(net(points[:, order], joints), net(points, joints))


def test_the_basic_detector_ignores_the_order_of_the_points():
    net = NETWORKS["basic"]().double()
    points, joints = batch(dtype=torch.float64)
    torch.testing.assert_close(net(points.flip(1), joints), net(points, joints))


def test_a_sample_does_not_depend_on_its_batch(make):
    net = make().double()
    points, joints = batch(dtype=torch.float64)
    torch.testing.assert_close(net(points, joints)[1:2], net(points[1:2], joints[1:2]))


@pytest.mark.parametrize("output", ["offset", "absolute"])
def test_a_few_samples_can_be_overfitted(make, output):
    net = make(output=output)
    points, joints = batch(4)
    target = joints + 0.1 * torch.randn(joints.shape, generator=torch.Generator().manual_seed(3))
    optimizer = torch.optim.Adam(net.parameters(), lr=5e-3)
    for _ in range(300):
        optimizer.zero_grad()
        loss = (net(points, joints) - target).square().sum(-1).sum(-1).mean()
        loss.backward()
        optimizer.step()
    assert loss < 0.02 * 24 * 3 * 0.1**2


SMALL = {"local_channels": (32, 32), "global_channels": (32, 64, 128), "head_channels": (128, 64)}
THESIS = {
    "proposed": lambda: LocalJointNetwork(RADII),
    "proposed, small": lambda: LocalJointNetwork(RADII, 64, group_channels=(32, 64, 128), **SMALL),
    "no_edm": lambda: LocalJointNetwork(RADII, edm=False),
    "basic": BasicDetector,
    "basic, small": lambda: BasicDetector(**SMALL),
    "simple_baseline": SimpleBaseline,
}


def people(size=4, num_points=512):
    """Initial joints spread as a person's, points and normals around them."""
    generator = torch.Generator().manual_seed(1)
    joints = torch.randn(size, 24, 3, generator=generator) * torch.tensor([0.25, 0.45, 0.15])
    joints += torch.tensor([0.3, 0.1, 2.2])
    points = joints.repeat(1, -(-num_points // 24), 1)[:, :num_points]
    points = points + 0.08 * torch.randn(points.shape, generator=generator)
    normals = nn.functional.normalize(torch.randn(points.shape, generator=generator), dim=-1)
    return torch.cat([points, normals], -1), joints


def size(x):
    return float(x.detach().square().mean().sqrt())


def sizes_at_the_start(net):
    """Sizes of the centred input, of each activation's output in turn with its name, and of the predicted offsets."""
    sizes = []
    for name, module in net.named_modules():
        if isinstance(module, nn.PReLU | StackedPReLU | nn.ReLU):
            module.register_forward_hook(
                lambda module, inputs, output, name=name: sizes.append((name, size(output)))
            )
    points, joints = people()
    with torch.no_grad():
        pred = net(*(points, joints) if "points" in net.takes else (joints,))
    start = joints[:, :1] if net.is_root_relative else joints
    given = torch.cat([points[..., :3] - points[..., :3].mean(1, keepdim=True), points[..., 3:]], -1)
    return size(given), sizes, size(pred - start)


def is_well_conditioned(net):
    """Whether each layer's output is half to twice as large as the one before it, but for pooling's: a maximum over
    many points is larger than they are by nature."""
    given, sizes, offset = sizes_at_the_start(net)
    sound = [
        1 / 2 < after / before < (3.2 if name in ("trunk.lift_activation", "group_activation") else 2)
        for (_, before), (name, after) in itertools.pairwise([("", given), *sizes])
    ]
    return all(sound) and 1 / 2 < sizes[-1][1] / given < 4 and offset < 0.3


@pytest.mark.parametrize("name", THESIS)
def test_at_the_start_no_layer_drowns_or_blows_up_its_input_and_offsets_are_small(name):
    torch.manual_seed(0)
    assert is_well_conditioned(THESIS[name]())


@pytest.mark.parametrize("name", THESIS)
def test_with_the_default_initialisation_of_pytorch_they_would(name):
    torch.manual_seed(0)
    net = THESIS[name]()
    for module in net.modules():
        if isinstance(module, nn.Linear):
            module.reset_parameters()
        elif isinstance(module, StackedLinear):
            bound = module.weight.shape[-1] ** -0.5
            nn.init.uniform_(module.weight, -bound, bound)
            nn.init.uniform_(module.bias, -bound, bound)
    assert not is_well_conditioned(net)


def of_joint(layer, joint, x):
    """What a stacked layer makes of one joint's rows."""
    if layer.weight.ndim == 3:
        return x @ layer.weight[joint].T + layer.bias[joint]
    return torch.nn.functional.prelu(x, layer.weight[joint : joint + 1])


def test_the_first_layer_equals_one_product_over_concatenated_inputs():
    """A loop over joints and points, each point with its 1115-like input written out."""
    net = joint_network(group_size=5).double()
    points, joints = batch(2, dtype=torch.float64)
    centre = points[..., :3].mean(1, keepdim=True)
    points = torch.cat([points[..., :3] - centre, points[..., 3:]], -1)
    joints = joints - centre
    local, pooled = net.trunk(points)
    out = net.regress(points, joints)
    for b in range(2):
        edm = torch.cdist(joints[b], joints[b])
        for j in range(24):
            inside = (points[b, :, :3] - joints[b, j]).norm(dim=-1) <= 0.3
            chosen = inside.nonzero()[:5, 0]
            if len(chosen) == 0:
                chosen = (points[b, :, :3] - joints[b, j]).norm(dim=-1).argsort()[:5]
            x = torch.stack(
                [
                    torch.cat([(points[b, p, :3] - joints[b, j]) / 0.3, local[b, p], pooled[b], edm[j]])
                    for p in chosen
                ]
            )
            for layer in (net.first, net.first_activation, *net.group, net.group_activation):
                x = of_joint(layer, j, x)
            x = x.amax(0, keepdim=True)
            for layer in net.head:
                x = of_joint(layer, j, x)
            torch.testing.assert_close(out[b, j], x[0])


def test_sizes_of_the_thesis_give_1115_inputs():
    net = LocalJointNetwork(RADII)
    assert net.first.weight.shape == (24, 64, 1115)


def test_radii_of_the_wrong_number_and_an_unknown_output_are_refused():
    with pytest.raises(ValueError, match=r"radii_m: expected 24 positive numbers.*got 3"):
        joint_network(radii_m=[0.2] * 3)
    with pytest.raises(ValueError, match="output: expected one of offset, absolute, got 'relative'"):
        BasicDetector(output="relative")


def fit(yardstick, batches):
    for points, initial, joints in batches:
        yardstick.accumulate(points, initial, joints)
    yardstick.solve()
    return yardstick


def yardstick_batches():
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        shapes = (16, 30, 6), (16, 24, 3), (16, 24, 3)
        points, initial, noise = (torch.randn(shape, generator=generator) for shape in shapes)
        yield points, initial, initial + torch.arange(72).view(24, 3) * 0.01 + 0.05 * noise


def test_mean_offset_is_the_mean_over_all_batches():
    batches = list(yardstick_batches())
    yardstick = fit(MeanOffset(), batches)
    offset = torch.cat([joints - initial for _, initial, joints in batches]).double().mean(0)
    torch.testing.assert_close(yardstick.bias.view(24, 3), offset)
    points, initial, _ = batches[0]
    torch.testing.assert_close(yardstick(points, initial), (initial + offset).float())


def test_ridge_equals_least_squares_over_all_batches():
    batches = list(yardstick_batches())
    yardstick = fit(Ridge(penalty=1e-9), batches)
    inputs = torch.cat([(i - p[..., :3].mean(1, keepdim=True)).flatten(1) for p, i, _ in batches]).double()
    inputs = torch.cat([inputs, torch.ones(len(inputs), 1, dtype=torch.float64)], -1)
    targets = torch.cat([(joints - i).flatten(1) for _, i, joints in batches]).double()
    expected = torch.linalg.lstsq(inputs, targets).solution
    torch.testing.assert_close(yardstick.weight, expected[:-1], atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(yardstick.bias, expected[-1], atol=1e-6, rtol=1e-6)


def test_the_penalty_shrinks_the_weights_but_not_the_bias():
    batches = list(yardstick_batches())
    yardstick = fit(Ridge(penalty=1e6), batches)
    assert yardstick.weight.abs().max() < 1e-5
    torch.testing.assert_close(yardstick.bias, fit(MeanOffset(), batches).bias, atol=1e-4, rtol=1e-4)
