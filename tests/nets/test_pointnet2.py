import pytest
import torch
from torch.nn import functional

from ljn.geometry.points import ball_group, farthest_point_sampling, gather_points
from ljn.nets.pointnet2 import PointNet2, SetAbstraction

SIZES = {
    "num_centres": (16, 4),
    "radii_m": (0.3, 0.6),
    "group_sizes": (8, 4),
    "channels": ((6, 8), (8, 10)),
    "global_channels": (8, 12),
}


def cloud(num_points=64, dtype=torch.float64, size=2, channels=6):
    generator = torch.Generator().manual_seed(1)
    return 0.3 * torch.randn(size, num_points, channels, generator=generator, dtype=dtype)


@pytest.fixture
def make():
    torch.manual_seed(0)
    return lambda **changes: PointNet2(**{**SIZES, **changes}).double()


@pytest.mark.parametrize("relative_to_radius", [True, False])
def test_set_abstraction_equals_its_definition_group_by_group(relative_to_radius):
    torch.manual_seed(0)
    layer = SetAbstraction(5, 0.4, 6, 7, (8, 9), relative_to_radius).double()
    positions, features = cloud(channels=3), cloud(channels=7)
    centres, pooled = layer(positions, features)
    index = farthest_point_sampling(positions, 5)
    assert torch.equal(centres, gather_points(positions, index))
    groups = ball_group(positions, centres, torch.full((5,), 0.4), 6)
    weight = torch.cat([layer.position.weight, layer.feature.weight], -1)
    for b in range(2):
        for m in range(5):
            members = groups[b, m]
            relative = (positions[b, members] - centres[b, m]) / (0.4 if relative_to_radius else 1)
            inputs = torch.cat([relative, features[b, members]], -1)
            hidden = layer.first_activation(functional.linear(inputs, weight, layer.feature.bias))
            expected = layer.last_activation(layer.rest(hidden)).amax(0)
            torch.testing.assert_close(pooled[b, m], expected)


def test_the_order_of_the_points_does_not_matter_without_an_overfull_ball(make):
    net = make(group_sizes=(64, 16))
    points = cloud()
    order = torch.randperm(64, generator=torch.Generator().manual_seed(2))
    torch.testing.assert_close(net(points[:, order]), net(points))


def test_every_parameter_gets_a_gradient(make):
    net = make()
    net(cloud()).square().sum().backward()
    assert [name for name, p in net.named_parameters() if p.grad is None or not p.grad.any()] == []


def test_a_sample_does_not_depend_on_its_batch(make):
    net = make()
    points = cloud(size=3)
    torch.testing.assert_close(net(points)[1:2], net(points[1:2]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"radii_m": (0.3,)}, "one entry for each set abstraction, got 2, 1, 2 and 2"),
        ({"group_sizes": (0, 4)}, "group_size: expected at least 1, got 0"),
        ({"num_centres": (16, 0)}, "num_centres: expected at least 1, got 0"),
    ],
)
def test_impossible_sizes_are_refused(changes, message, make):
    with pytest.raises(ValueError, match=message):
        make(**changes)
    with pytest.raises(ValueError, match="num_samples: expected 1 to 8, the number of points, got 16"):
        make()(cloud(num_points=8))


@pytest.mark.parametrize("carried", [None, 4])
def test_the_last_centres_carry_what_all_points_share_only_where_they_are_to(make, carried):
    net, points = make(in_channels=10, carried_channels=carried), cloud(channels=10)
    points[..., 6:] = points[:, :1, 6:]
    positions, features = points[..., :3], points
    for abstraction in net.abstractions:
        positions, features = abstraction(positions, features)
    if carried:
        features = torch.cat([features, points[:, : positions.shape[1], 6:]], -1)
    lifted = net.lift(torch.cat([positions, features], -1))
    torch.testing.assert_close(net(points[..., :6], points[:, 0, 6:]), net.lift_activation(lifted).amax(1))
