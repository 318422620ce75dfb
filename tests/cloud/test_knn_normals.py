import numpy as np
import pytest

from ljn.cloud.normals.neighbours import knn_normals, open3d_normals
from ljn.cloud.sampling import Cloud


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def degrees_between(one, other):
    one, other = one.astype(np.float64), other.astype(np.float64)
    sine = np.linalg.norm(np.cross(one, other), axis=-1)
    return np.degrees(np.arctan2(sine, (one * other).sum(-1)))


def normals_of(points, neighbours=30):
    """The estimator's normals of points `(N, 3)`; it needs neither pixels, nor depth, nor camera."""
    points = np.asarray(points, np.float32)
    normals = knn_normals(Cloud(points, None), None, None, neighbours)
    assert normals.dtype == np.float32
    assert normals.shape == points.shape
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-6)
    assert (normals * points).sum(-1).max() <= 1e-6 * np.abs(points).max()
    return normals


def naive_normals(points, neighbours=30):
    """Point by point; and `(N,)`: whether rounding and equal distances leave the normal alone."""
    points = np.asarray(points, np.float32).astype(np.float64)
    normals, is_clear = np.empty(points.shape), np.empty(len(points), bool)
    for i, point in enumerate(points):
        squared = ((points - point) ** 2).sum(-1)
        order = np.argsort(squared, kind="stable")
        near = points[order[:neighbours]]
        values, vectors = np.linalg.eigh(np.cov(near.T, bias=True))
        normals[i] = -np.sign(vectors[:, 0] @ point) * vectors[:, 0]
        is_clear[i] = values[1] - values[0] > 1e-3 * values[2] and abs(unit(point) @ normals[i]) > 1e-6
        if len(points) > neighbours:
            last, following = order[neighbours - 1], order[neighbours]
            is_tied = squared[following] - squared[last] <= 1e-12 * squared[last]
            is_clear[i] &= not is_tied or (points[last] == points[following]).all()
    return normals, is_clear


def assert_equal_to_naive(points, neighbours=30, share=0.9):
    expected, is_clear = naive_normals(points, neighbours)
    assert is_clear.mean() >= share
    assert degrees_between(normals_of(points, neighbours), expected)[is_clear].max() < 1e-3


def sheet(num_points, rng):
    """A wavy surface with noise, two metres away."""
    x, y = rng.uniform(-0.4, 0.4, (2, num_points))
    return np.stack([x, y, 2 + 0.1 * np.sin(7 * x) + 0.05 * y + 0.001 * rng.standard_normal(num_points)], -1)


@pytest.mark.parametrize("neighbours", [3, 10, 30])
def test_normals_of_a_body_equal_a_plain_loops(noisy_body, neighbours):
    cloud, _ = noisy_body(0, num_points=1500)
    assert_equal_to_naive(cloud.points, neighbours)


@pytest.mark.parametrize("num_points", [3, 10, 29, 30, 31, 100])
def test_small_clouds_take_the_neighbours_that_there_are(num_points):
    assert_equal_to_naive(sheet(num_points, np.random.default_rng(num_points)), share=0.6)


def thin(axis, rng):
    points = 0.002 * rng.standard_normal((600, 3)) + [0.1, 0.1, 2]
    points[:, axis] += np.sort(rng.uniform(0, 1, 600))
    return points


CLOUDS = {
    "a cloud of millimetres": lambda rng: 1e-3 * sheet(600, rng),
    "a cloud of kilometres": lambda rng: 1e3 * sheet(600, rng),
    "a cloud that fills space": lambda rng: rng.uniform(1, 2, (1000, 3)),
    "a few points far away": lambda rng: np.concatenate([sheet(600, rng), rng.uniform(50, 1000, (5, 3))]),
    "a dense part": lambda rng: np.concatenate(
        [sheet(400, rng), (sheet(400, rng) - [0, 0, 2]) * 0.003 + [0.3, 0.3, 1]]
    ),
    "points that come twice": lambda rng: np.repeat(sheet(300, rng), rng.integers(1, 5, 300), 0),
    **{f"thin along {axis}": lambda rng, axis=axis: thin(axis, rng) for axis in range(3)},
}


@pytest.mark.parametrize("name", CLOUDS)
def test_odd_clouds_have_the_plain_loops_normals(name):
    assert_equal_to_naive(CLOUDS[name](np.random.default_rng(0)), share=0.8 if "thin" in name else 0.9)


@pytest.mark.parametrize("num_places", [4, 5, 20])
def test_a_few_places_hundreds_of_times_give_finite_normals(num_places):
    rng = np.random.default_rng(0)
    points = sheet(num_places, rng).astype(np.float32)[rng.integers(num_places, size=2000)]
    # Each point's 30 neighbours are itself again and again.
    np.testing.assert_allclose(normals_of(points), -unit(points), atol=1e-6)


def test_neighbours_beyond_a_crowd_of_repeated_points_are_found():
    rng = np.random.default_rng(0)
    crowd = np.repeat(sheet(1, rng), 25, axis=0)
    points = np.concatenate([crowd, sheet(200, rng)]).astype(np.float32)
    expected, _ = naive_normals(points)
    assert degrees_between(normals_of(points)[:25], expected[:25]).max() < 1e-3


@pytest.mark.parametrize("num_points", [1, 2, 29, 30, 500])
def test_one_place_looks_straight_at_the_camera(num_points):
    points = np.tile([0.3, -0.2, 1.7], (num_points, 1))
    np.testing.assert_allclose(normals_of(points), -unit(points), atol=1e-6)


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, 0, 1), (0.3, -0.7, 0.2)])
@pytest.mark.parametrize("num_points", [2, 3, 100])
def test_a_line_looks_straight_at_the_camera(direction, num_points):
    points = [0.3, -0.2, 1.7] + np.linspace(0, 0.5, num_points)[:, None] * np.array(direction)
    np.testing.assert_allclose(normals_of(points), -unit(points), atol=1e-6)


def test_one_place_at_the_camera_itself_has_a_finite_normal():
    np.testing.assert_array_equal(normals_of(np.zeros((4, 3))), np.tile([0, 0, -1], (4, 1)))


def test_a_regular_grid_of_equal_distances_lies_in_its_plane():
    x, y = np.meshgrid(np.arange(40) / 64, np.arange(40) / 64)
    points = np.stack([x, y, np.full(x.shape, 2.0)], -1).reshape(-1, 3)
    np.testing.assert_allclose(normals_of(points), np.tile([0, 0, -1], (1600, 1)), atol=1e-6)


def test_the_order_of_points_does_not_matter():
    rng = np.random.default_rng(0)
    points, order = sheet(500, rng), rng.permutation(500)
    np.testing.assert_allclose(normals_of(points[order]), normals_of(points)[order], atol=1e-6)
    assert knn_normals(Cloud(np.empty((0, 3), np.float32), None), None, None).shape == (0, 3)


def test_points_that_are_not_finite_and_fewer_than_three_neighbours_are_errors():
    with pytest.raises(ValueError, match="points: NaN or infinite values"):
        normals_of(np.full((5, 3), np.nan))
    with pytest.raises(ValueError, match="neighbours: expected at least 3, got 2"):
        normals_of(np.ones((5, 3)), 2)


@pytest.mark.render
@pytest.mark.parametrize("num_points", [2048, 4096, 20_000])
def test_normals_equal_open3ds(noisy_body, open3d, num_points):
    # 20,000 are more than the body has pixels: some come twice.
    differences = []
    for number in range(4):
        cloud, _ = noisy_body(number, num_points)
        differences.append(degrees_between(knn_normals(cloud, None, None), open3d_normals(cloud, None, None)))
    # But for points whose last neighbour is as far as the next, or whose cloud has no single plane.
    assert np.quantile(differences, 0.999) < 1e-4
