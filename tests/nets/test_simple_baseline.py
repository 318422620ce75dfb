import pytest
import torch

from ljn.nets.simple_baseline import SimpleBaseline


@pytest.fixture
def net():
    torch.manual_seed(0)
    return SimpleBaseline(channels=16, num_blocks=2, dropout=0.2)


def batch(size=6):
    generator = torch.Generator().manual_seed(1)
    joints = 0.3 * torch.randn(size, 24, 3, generator=generator)
    joints[..., 2] += 2
    return joints


def test_every_parameter_gets_a_gradient(net):
    net(batch()).square().sum().backward()
    assert [name for name, p in net.named_parameters() if p.grad is None or not p.grad.any()] == []


def test_only_the_rays_of_the_joints_are_seen(net):
    net.eval()
    joints = batch()
    relative = net(joints) - joints[:, :1]
    farther = joints * torch.linspace(0.8, 1.5, 24)[:, None]
    torch.testing.assert_close(net(farther) - farther[:, :1], relative)
    moved = joints + torch.tensor([0.1, 0.0, 0.0])
    assert not torch.allclose(net(moved) - moved[:, :1], relative)


def test_a_few_samples_can_be_overfitted():
    torch.manual_seed(0)
    net = SimpleBaseline(channels=32, dropout=0.0)
    joints = batch()
    target = joints - joints[:, :1]
    optimizer = torch.optim.Adam(net.parameters(), lr=5e-3)
    for _ in range(200):
        optimizer.zero_grad()
        loss = (net(joints) - joints[:, :1] - target).square().sum(-1).mean()
        loss.backward()
        optimizer.step()
    assert loss < 1e-3
