import pytest
import torch

from ljn.losses import joint_loss, mesh_loss


def test_joint_loss_sums_over_joints_and_averages_over_the_batch():
    generator = torch.Generator().manual_seed(0)
    pred, target = torch.randn(2, 5, 24, 3, generator=generator, dtype=torch.float64)
    expected = 0.0
    for sample in range(5):
        for joint in range(24):
            expected += sum((p - t) ** 2 for p, t in zip(pred[sample, joint], target[sample, joint])) / 5
    torch.testing.assert_close(joint_loss(pred, target), expected)


def test_joint_loss_gradient():
    pred, target = torch.randn(2, 3, 24, 3, dtype=torch.float64)
    assert torch.autograd.gradcheck(joint_loss, (pred.requires_grad_(), target))


def test_joint_loss_rejects_shapes_that_would_broadcast():
    with pytest.raises(ValueError, match=r"same shape, got \(2, 24, 3\) and \(24, 3\)"):
        joint_loss(torch.zeros(2, 24, 3), torch.zeros(24, 3))


def test_mesh_loss_averages_over_vertices_and_samples_and_sums_over_iterations():
    generator = torch.Generator().manual_seed(0)
    pred = torch.randn(3, 2, 7, 3, generator=generator, dtype=torch.float64)
    target = torch.randn(2, 7, 3, generator=generator, dtype=torch.float64)
    expected = 0.0
    for iteration in range(3):
        for sample in range(2):
            for vertex in range(7):
                difference = pred[iteration, sample, vertex] - target[sample, vertex]
                expected += float(difference @ difference) / (2 * 7)
    assert float(mesh_loss(pred, target)) == pytest.approx(expected)


def test_mesh_loss_rejects_shapes_that_would_broadcast():
    with pytest.raises(ValueError, match=r"expected pred \(T, B, V, 3\).*got \(2, 7, 3\) and \(2, 7, 3\)"):
        mesh_loss(torch.zeros(2, 7, 3), torch.zeros(2, 7, 3))
