import numpy as np
import pytest
import torch

from ljn.geometry.points import (
    _ball_group_as_tensors,
    _farthest_points_as_tensors,
    ball_group,
    distance_matrix,
    farthest_point_sampling,
    gather_points,
    squared_distances,
)


def draw(*shape, dtype=torch.float64, seed=0):
    return torch.randn(*shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def naive_ball_group(points, centres, radii, group_size):
    groups = np.empty((*centres.shape[:2], group_size), np.int64)
    for b, cloud in enumerate(points.numpy()):
        for m, (centre, radius) in enumerate(zip(centres[b].numpy(), radii.numpy())):
            distances = [float(np.sqrt(((point - centre) ** 2).sum())) for point in cloud]
            found = [i for i, distance in enumerate(distances) if distance <= radius]
            if not found:
                found = sorted(range(len(cloud)), key=distances.__getitem__)[:group_size]
            for slot in range(group_size):
                groups[b, m, slot] = found[slot % len(found)]
    return groups


# The distance matrix


@pytest.mark.parametrize("shape", [(1,), (5,), (2, 7), (2, 3, 4)])
def test_distance_matrix_equals_scipy(shape):
    cdist = pytest.importorskip("scipy.spatial.distance", reason="SciPy is not installed").cdist
    points = draw(*shape, 3)
    flat = points.reshape(-1, shape[-1], 3).numpy()
    expected = np.stack([cdist(cloud, cloud) for cloud in flat]).reshape(*shape, shape[-1])
    np.testing.assert_allclose(distance_matrix(points).numpy(), expected, atol=1e-12)


def test_distance_matrix_is_symmetric_with_an_exactly_zero_diagonal():
    matrix = distance_matrix(draw(4, 6, 3, dtype=torch.float32))
    assert matrix.dtype == torch.float32
    assert torch.equal(matrix, matrix.mT)
    assert (matrix.diagonal(dim1=-2, dim2=-1) == 0).all()


def test_distance_matrix_has_a_zero_gradient_where_points_coincide():
    points = torch.tensor([[0.0, 0, 0], [0, 0, 0], [1, 0, 0]], requires_grad=True)
    distance_matrix(points)[:2, :2].sum().backward()
    assert torch.equal(points.grad, torch.zeros(3, 3))


def test_distance_matrix_passes_gradcheck():
    assert torch.autograd.gradcheck(distance_matrix, (draw(2, 4, 3).requires_grad_(),))


# Gathering


@pytest.mark.parametrize("index_shape", [(5,), (4, 2), (2, 3, 2)])
def test_gather_points_equals_a_loop(index_shape):
    features = draw(3, 6, 4)
    index = torch.randint(6, (3, *index_shape), generator=torch.Generator().manual_seed(1))
    gathered = gather_points(features, index)
    assert gathered.shape == (3, *index_shape, 4)
    for b in range(3):
        for place in np.ndindex(*index_shape):
            assert torch.equal(gathered[b][place], features[b, index[b][place]])


# Squared distances


def test_squared_distances_equal_a_loop():
    centres, points = draw(2, 3, 3), draw(2, 5, 3, seed=1)
    squared = squared_distances(centres, points)
    for b, m, n in np.ndindex(2, 3, 5):
        expected = float(((centres[b, m] - points[b, n]) ** 2).sum())
        assert float(squared[b, m, n]) == pytest.approx(expected, rel=1e-14)


def test_squared_distances_do_not_cancel_far_from_the_origin():
    far = torch.tensor([[[1000.0, 1000.0, 1000.0]]])
    near_by = far + torch.tensor([0.0, 0.0, 2**-12])
    assert float(squared_distances(far, near_by)) == 2**-24


def test_squared_distances_pass_gradcheck():
    inputs = (draw(2, 3, 3).requires_grad_(), draw(2, 4, 3, seed=1).requires_grad_())
    assert torch.autograd.gradcheck(squared_distances, inputs)


# Ball grouping

LINE = torch.stack([torch.arange(6.0), torch.zeros(6), torch.zeros(6)], -1)[None]  # x = 0 to 5


def group_on_line(x, radius, group_size, order=range(6)):
    centre = torch.tensor([[[x, 0.0, 0.0]]])
    return ball_group(LINE[:, list(order)], centre, torch.tensor([radius]), group_size)[0, 0].tolist()


def test_an_overfull_ball_gives_its_first_points_in_the_order_of_the_cloud():
    assert group_on_line(2.0, 2.5, 3) == [0, 1, 2]
    # Positions of the coordinates 4, 3 and 2: the first three of the cloud that lie inside.
    assert group_on_line(2.0, 2.5, 3, order=[5, 4, 3, 2, 1, 0]) == [1, 2, 3]


def test_an_empty_ball_takes_the_nearest_points_of_all():
    assert group_on_line(-3.0, 1.0, 3) == [0, 1, 2]
    assert group_on_line(9.0, 1.0, 2) == [5, 4]


def test_a_point_on_the_surface_of_the_ball_belongs_to_it():
    assert group_on_line(2.0, 1.0, 3) == [1, 2, 3]


@pytest.mark.parametrize("group_size", [0, -1])
def test_a_group_of_no_points_is_refused(group_size):
    with pytest.raises(ValueError, match=f"group_size: expected at least 1, got {group_size}"):
        group_on_line(2.0, 1.0, group_size)


def test_every_centre_needs_a_radius():
    with pytest.raises(ValueError, match=r"radii: expected one for each of 2 centres, got \(3,\)"):
        ball_group(torch.zeros(1, 4, 3), torch.zeros(1, 2, 3), torch.ones(3), 4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("group_size", [1, 4, 16, 50])
def test_ball_group_equals_a_loop_in_every_case_at_once(dtype, group_size):
    points, centres = draw(2, 40, 3, dtype=dtype), draw(2, 6, 3, dtype=dtype, seed=1)
    centres[:, 0] += 20  # empty
    radii = torch.tensor([0.5, 0.05, 0.8, 1.2, 2.0, 9.0], dtype=dtype)
    index = ball_group(points, centres, radii, group_size)
    assert index.dtype == torch.int64
    np.testing.assert_array_equal(index.numpy(), naive_ball_group(points, centres, radii, group_size))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_compiled_and_the_tensor_form_of_ball_group_agree(dtype):
    points, centres = draw(3, 400, 3, dtype=dtype), draw(3, 40, 3, dtype=dtype, seed=1)
    centres[:, ::7] += 20  # empty
    radii = torch.linspace(0.1, 3.0, 40, dtype=dtype)
    expected = _ball_group_as_tensors(points, centres, radii, 24)
    assert torch.equal(ball_group(points, centres, radii, 24), expected)


def test_without_an_overfull_ball_the_set_of_points_does_not_depend_on_their_order():
    points, centres = draw(1, 60, 3), draw(1, 8, 3, seed=1)
    centres[:, 0] += 20  # empty: the nearest, in any order
    radii = torch.full((8,), 0.6, dtype=torch.float64)
    assert (squared_distances(centres, points) <= 0.36).sum(-1).max() <= 16, "no ball is to be overfull"
    order = torch.randperm(60, generator=torch.Generator().manual_seed(2))
    straight = gather_points(points, ball_group(points, centres, radii, 16))[0]
    shuffled = gather_points(points[:, order], ball_group(points[:, order], centres, radii, 16))[0]
    for one, other in zip(straight.tolist(), shuffled.tolist()):
        assert set(map(tuple, one)) == set(map(tuple, other))


def test_ball_group_takes_inputs_that_need_gradients():
    points = draw(1, 20, 3).requires_grad_()
    radii = torch.tensor([0.5, 0.5])
    index = ball_group(points, points[:, :2], radii, 4)
    assert torch.equal(index, ball_group(points.detach(), points[:, :2].detach(), radii, 4))


# Farthest point sampling


def naive_farthest_points(cloud, num_samples):
    chosen = [int(((cloud - cloud.mean(0)) ** 2).sum(-1).argmax())]
    while len(chosen) < num_samples:
        to_chosen = ((cloud[:, None] - cloud[chosen]) ** 2).sum(-1).min(1)
        chosen.append(int(to_chosen.argmax()))
    return chosen


@pytest.mark.parametrize("num_samples", [1, 2, 17, 40])
def test_farthest_point_sampling_equals_a_loop(num_samples):
    points = draw(3, 40, 3)
    index = farthest_point_sampling(points, num_samples)
    assert index.dtype == torch.int64
    assert index.tolist() == [naive_farthest_points(cloud, num_samples) for cloud in points.numpy()]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_compiled_and_the_tensor_form_of_farthest_point_sampling_agree(dtype):
    points = draw(2, 500, 3, dtype=dtype)
    points[:, 300:] = points[:, :200]  # repeated points
    expected = _farthest_points_as_tensors(points, points.double().mean(1).to(points), 250)
    assert torch.equal(farthest_point_sampling(points, 250), expected)


def test_farthest_point_sampling_takes_the_same_points_whatever_their_order():
    points = draw(1, 200, 3)
    order = torch.randperm(200, generator=torch.Generator().manual_seed(3))
    straight = gather_points(points, farthest_point_sampling(points, 50))
    shuffled = gather_points(points[:, order], farthest_point_sampling(points[:, order], 50))
    assert torch.equal(straight, shuffled)


@pytest.mark.parametrize("num_samples", [0, 41])
def test_a_sample_larger_than_the_cloud_is_refused(num_samples):
    with pytest.raises(ValueError, match=f"num_samples: expected 1 to 40.*got {num_samples}"):
        farthest_point_sampling(draw(1, 40, 3), num_samples)
