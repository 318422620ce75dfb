import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ljn.geometry.alignment import procrustes_align, root_align


def random_points(*shape, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).normal(size=(*shape, 3)))


def random_rotation(seed=0):
    return torch.from_numpy(Rotation.random(random_state=seed).as_matrix())


def reference_align(source, target):
    """Kabsch's rotation from SciPy, then the scale and translation that are best for it."""
    x, y = source - source.mean(0), target - target.mean(0)
    rotated = Rotation.align_vectors(y, x)[0].apply(x)
    return (rotated * y).sum() / (x * x).sum() * rotated + target.mean(0)


@pytest.mark.parametrize("num_points", [4, 24])
def test_agrees_with_scipy(num_points):
    source, target = random_points(8, num_points, seed=1), random_points(8, num_points, seed=2)
    aligned = procrustes_align(source, target).numpy()
    for index in range(8):
        expected = reference_align(source[index].numpy(), target[index].numpy())
        np.testing.assert_allclose(aligned[index], expected, atol=1e-9)


def test_undoes_any_similarity():
    target = random_points(24)
    for seed in range(10):
        source = 0.3 * (seed + 1) * target @ random_rotation(seed).T + random_points(1, seed=seed)
        torch.testing.assert_close(procrustes_align(source, target), target)


def test_a_mirror_image_is_not_reflected_back():
    target = random_points(24)
    mirrored = target * torch.tensor([-1.0, 1.0, 1.0])
    aligned = procrustes_align(mirrored, target)
    assert (aligned - target).norm(dim=-1).mean() > 0.1

    def handedness(points):
        return torch.linalg.det(points[1:4] - points[0]).sign()

    assert handedness(aligned) == handedness(mirrored)


def test_equal_source_points_land_on_the_targets_mean():
    target = random_points(2, 24)
    aligned = procrustes_align(torch.full_like(target, 0.1), target)
    torch.testing.assert_close(aligned, target.mean(-2, keepdim=True).expand_as(target))


def test_equal_target_points_draw_the_source_together():
    source, target = random_points(24), torch.full((24, 3), 0.1, dtype=torch.float64)
    torch.testing.assert_close(procrustes_align(source, target), target)


def test_collinear_and_planar_points_align():
    line = torch.linspace(-1, 1, 24, dtype=torch.float64)[:, None] * torch.tensor([1.0, 2.0, 3.0])
    plane = random_points(24) * torch.tensor([1.0, 1.0, 0.0])
    for target in (line, plane):
        source = 3 * target @ random_rotation().T + 5
        torch.testing.assert_close(procrustes_align(source, target), target)


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
@pytest.mark.parametrize("which", [0, 1])
def test_a_non_finite_sample_is_nan_and_leaves_the_others_alone(value, which):
    pair = [random_points(3, 24, seed=1), random_points(3, 24, seed=2)]
    clean = procrustes_align(*pair)
    pair[which][1, 7, 2] = value
    aligned = procrustes_align(*pair)
    assert aligned[1].isnan().all()
    torch.testing.assert_close(aligned[[0, 2]], clean[[0, 2]])


@pytest.mark.parametrize("shape", [(24,), (1, 24), (2, 3, 24), (0, 24)])
def test_leading_dimensions_are_samples(shape):
    source, target = random_points(*shape, seed=1), random_points(*shape, seed=2)
    aligned = procrustes_align(source, target)
    assert aligned.shape == source.shape
    for a, s, t in zip(aligned.view(-1, 24, 3), source.view(-1, 24, 3), target.view(-1, 24, 3)):
        torch.testing.assert_close(a, procrustes_align(s, t))


def test_float32_is_computed_in_float64():
    source, target = random_points(4, 24, seed=1).float(), random_points(4, 24, seed=2).float()
    aligned = procrustes_align(source, target)
    assert aligned.dtype == torch.float32
    assert torch.equal(aligned, procrustes_align(source.double(), target.double()).float())


@pytest.mark.parametrize("shape", [(2, 23, 3), (24, 3), (2, 24, 2)])
def test_procrustes_rejects_shapes_that_do_not_match(shape):
    with pytest.raises(ValueError, match=r"source and target .* got \(2, 24, 3\)"):
        procrustes_align(torch.zeros(2, 24, 3), torch.zeros(shape))


@pytest.mark.parametrize("root_index", [0, 5, -1])
def test_root_align_puts_the_root_at_the_origin_and_keeps_differences(root_index):
    joints = random_points(2, 24)
    aligned = root_align(joints, root_index)
    assert (aligned[:, root_index] == 0).all()
    torch.testing.assert_close(aligned - aligned[:, :1], joints - joints[:, :1])
