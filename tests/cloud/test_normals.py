import numpy as np
import pytest

from ljn.cloud.normals import NORMALS, get_normal_estimator
from ljn.cloud.normals.eigenvector import smallest_eigenvector as scalar_smallest_eigenvector
from ljn.cloud.normals.neighbours import knn_normals, open3d_normals
from ljn.cloud.normals.window import window_normals
from ljn.cloud.sampling import Cloud
from ljn.geometry.camera import Camera

CAMERA = Camera(fx=180.0, fy=184.0, cx=50.3, cy=41.8, width=100, height=80)


def rays(camera=CAMERA):
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)


def plane_depth(normal, distance):
    """Depth of the plane through (0, 0, distance)."""
    return (distance * normal[2] / (rays() @ normal)).astype(np.float32)


def cloud_of(depth, camera=CAMERA):
    """Every pixel of the body as a point, row by row."""
    v, u = np.nonzero(depth)
    points = rays(camera)[v, u] * depth[v, u, None]
    return Cloud(points.astype(np.float32), np.stack([u, v], -1))


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def degrees_between(one, other):
    one, other = unit(one.astype(np.float64)), unit(other.astype(np.float64))
    sine = np.linalg.norm(np.cross(one, other), axis=-1)
    return np.degrees(np.arctan2(sine, (one * other).sum(-1)))


@pytest.mark.parametrize("normal", [(0, 0, -1), (0.5, 0, -1), (-0.3, 0.8, -1), (1.5, 0.2, -1)])
@pytest.mark.parametrize("radius_px", [1, 2, 4])
def test_a_plane_has_its_own_normal(normal, radius_px):
    normal = unit(np.array(normal, np.float64))
    depth = plane_depth(normal, 2.0)
    normals = window_normals(cloud_of(depth), depth, CAMERA, radius_px, max_jump_m=1.0)
    assert normals.dtype == np.float32
    assert degrees_between(normals, normal[None]).max() < 0.05


def test_a_sphere_has_normals_along_its_radius():
    centre, radius = np.array([0.02, -0.03, 1.5]), 0.3
    direction = unit(rays())
    along = direction @ centre
    inside = radius**2 - (centre @ centre - along**2)
    length = np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), 0)
    depth = (length * direction[..., 2]).astype(np.float32)
    cloud = cloud_of(depth)
    expected = unit(cloud.points - centre)
    facing = -(expected * unit(cloud.points)).sum(-1)
    error = degrees_between(window_normals(cloud, depth, CAMERA), expected)
    assert (facing > 0.4).mean() > 0.8
    assert error[facing > 0.4].max() < 3
    assert np.median(error) < 0.4


@pytest.mark.parametrize("number", range(3))
def test_normals_of_a_body_have_unit_length_and_look_towards_the_camera(noisy_body, kinect, number):
    cloud, noisy = noisy_body(number)
    normals = window_normals(cloud, noisy, kinect)
    assert np.isfinite(normals).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-6)
    assert (normals * unit(cloud.points)).sum(-1).max() < 1e-6


def line_image(pixels, noise_m):
    depth = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    noise = np.random.default_rng(0).standard_normal(len(pixels))
    for number, (u, v) in enumerate(pixels):
        depth[v, u] = 2.0 + 0.002 * number + noise_m * noise[number]
    return depth


@pytest.mark.parametrize("noise_m", [0.0, 0.001, 0.01])
@pytest.mark.parametrize(
    "pixels",
    [
        [(40, 30)],
        [(40, 30), (41, 31)],
        [(40 + i, 30) for i in range(5)],
        [(40, 30 + i) for i in range(5)],
        [(40 + i, 30 - i) for i in range(5)],
        [(40 + i, 30 + 2 * i) for i in range(3)],
        [(0, 0), (1, 0)],
        [(99, 79), (98, 79)],
    ],
)
def test_pixels_that_span_no_plane_look_straight_at_the_camera(pixels, noise_m):
    depth = line_image(pixels, noise_m)
    cloud = cloud_of(depth)
    normals = window_normals(cloud, depth, CAMERA)
    np.testing.assert_allclose(normals, -unit(cloud.points), atol=1e-6)


def test_three_pixels_that_are_no_line_have_the_normal_of_their_plane():
    depth = line_image([(40, 30), (41, 30), (40, 31)], 0.001)
    cloud = cloud_of(depth)
    a, b, c = cloud.points.astype(np.float64)
    normal = np.cross(b - a, c - a)
    normal *= -np.sign(normal @ a)
    assert degrees_between(window_normals(cloud, depth, CAMERA), normal[None]).max() < 0.05


def test_surfaces_on_both_sides_of_a_jump_do_not_mix():
    left, right = unit(np.array([0.4, 0.1, -1.0])), unit(np.array([-0.5, 0.3, -1.0]))
    is_left = np.arange(CAMERA.width) < 50
    depth = np.where(is_left, plane_depth(left, 1.5), plane_depth(right, 2.2)).astype(np.float32)
    cloud = cloud_of(depth)
    expected = np.where(is_left[cloud.pixels[:, 0], None], left, right)
    assert degrees_between(window_normals(cloud, depth, CAMERA), expected).max() < 0.05


def test_the_background_does_not_take_part():
    normal = unit(np.array([0.4, 0.1, -1.0]))
    depth = plane_depth(normal, 1.5)
    depth[:, ::3] = 0
    depth[::4] = 0
    assert degrees_between(window_normals(cloud_of(depth), depth, CAMERA), normal[None]).max() < 0.05


def test_normals_equal_the_direct_fit_of_a_plane(noisy_body, kinect):
    cloud, noisy = noisy_body(0, num_points=100)
    normals = window_normals(cloud, noisy, kinect)
    lifted = rays(kinect) * noisy[..., None].astype(np.float64)
    for (u, v), normal in zip(cloud.pixels, normals):
        near = lifted[v - 2 : v + 3, u - 2 : u + 3].reshape(-1, 3)
        near = near[(near[:, 2] > 0) & (np.abs(near[:, 2] - noisy[v, u]) <= 0.05)]
        values, vectors = np.linalg.eigh(np.cov(near.T))
        if len(near) < 6 or values[0] > 0.9 * values[1]:
            continue
        expected = -np.sign(vectors[:, 0] @ lifted[v, u]) * vectors[:, 0]
        assert degrees_between(normal, expected) < 0.1


# The eigenvector of the smallest eigenvalue


def smallest_eigenvector(matrix):
    return np.array(scalar_smallest_eigenvector(*matrix[np.triu_indices(3)]))


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e6])
def test_the_smallest_eigenvector_equals_numpys(scale):
    rng = np.random.default_rng(0)
    for _ in range(300):
        axes = np.linalg.qr(rng.normal(size=(3, 3))).Q
        values = np.sort(10 ** rng.uniform(-5, 0, 3))
        if values[1] - values[0] < 1e-4 * values[2]:
            continue
        vector = smallest_eigenvector(scale * (axes * values) @ axes.T)
        assert np.linalg.norm(vector) == pytest.approx(1)
        expected = np.linalg.eigh((axes * values) @ axes.T).eigenvectors[:, 0]
        assert abs(vector @ expected) == pytest.approx(1, abs=1e-6)


def test_the_smallest_eigenvector_of_points_in_a_plane_is_its_normal():
    rng = np.random.default_rng(0)
    for _ in range(100):
        axes = np.linalg.qr(rng.normal(size=(3, 3))).Q
        vector = smallest_eigenvector((axes * [0, *rng.uniform(0.01, 1, 2)]) @ axes.T)
        assert abs(vector @ axes[:, 0]) == pytest.approx(1, abs=1e-9)


def test_there_is_no_smallest_eigenvector_where_two_are_equal():
    rng = np.random.default_rng(0)
    assert not smallest_eigenvector(np.zeros((3, 3))).any()
    assert not smallest_eigenvector(np.eye(3)).any()
    for _ in range(100):
        direction = rng.normal(size=3)
        assert not smallest_eigenvector(np.outer(direction, direction)).any(), "points on a line"


# Names, and Open3D


def test_an_unknown_estimator_is_an_error_that_names_the_known_ones():
    with pytest.raises(ValueError, match="normals: expected one of window, knn, open3d, got 'pca'"):
        get_normal_estimator("pca")
    assert NORMALS == ("window", "knn", "open3d")
    assert get_normal_estimator("window") is window_normals
    assert get_normal_estimator("knn") is knn_normals


@pytest.mark.render
def test_open3ds_normals_are_planes_through_the_30_nearest_points(noisy_body, kinect, open3d):
    spatial = pytest.importorskip("scipy.spatial", reason="SciPy is not installed")
    cloud, noisy = noisy_body(1)
    normals = get_normal_estimator("open3d")(cloud, noisy, kinect)
    assert normals.dtype == np.float32

    points = cloud.points.astype(np.float64)
    near = points[spatial.cKDTree(points).query(points, 30)[1]]  # (N, 30, 3)
    near = near - near.mean(1, keepdims=True)
    values, vectors = np.linalg.eigh(near.swapaxes(1, 2) @ near)
    is_clear = values[:, 0] < 0.5 * values[:, 1]
    assert is_clear.mean() > 0.8
    expected = vectors[..., 0]
    expected = np.where((expected * points).sum(-1, keepdims=True) > 0, -expected, expected)
    assert (degrees_between(normals, expected)[is_clear] < 1).mean() > 0.99


@pytest.mark.render
def test_open3ds_normals_have_unit_length_and_look_towards_the_camera(noisy_body, kinect, open3d):
    cloud, noisy = noisy_body(2)
    normals = open3d_normals(cloud, noisy, kinect)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-6)
    assert (normals * unit(cloud.points)).sum(-1).max() < 1e-6
