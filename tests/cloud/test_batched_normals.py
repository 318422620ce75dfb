import dataclasses

import numpy as np
import pytest
import torch

from ljn.cloud.normals.batched import knn_normals, smallest_eigenvectors, window_normals
from ljn.cloud.normals.eigenvector import smallest_eigenvector
from ljn.cloud.normals.neighbours import knn_normals as numba_knn_normals
from ljn.cloud.normals.window import window_normals as numba_window_normals
from ljn.cloud.sampling import Cloud
from ljn.geometry.camera import Camera

CAMERA = Camera(fx=180.0, fy=184.0, cx=50.3, cy=41.8, width=100, height=80)
on_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


def degrees_between(one, other):
    one, other = torch.as_tensor(one).double().cpu(), torch.as_tensor(other).double().cpu()
    sine = torch.linalg.cross(one, other).norm(dim=-1)
    return torch.rad2deg(torch.atan2(sine, (one * other).sum(-1)))


@pytest.fixture(scope="module")
def clouds(noisy_body):
    """Four clouds with their depth images."""
    return [noisy_body(number, num_points=1024) for number in range(4)]


@pytest.fixture(scope="module")
def points(clouds):
    """`(4, 1024, 3)` float32."""
    return torch.from_numpy(np.stack([cloud.points for cloud, _ in clouds]))


@pytest.fixture(scope="module")
def images(clouds, kinect):
    """Depth `(4, H, W)`, pixel ids `(4, N)` and intrinsics `(4, 4)`."""
    depth = torch.from_numpy(np.stack([noisy for _, noisy in clouds]))
    pixels = torch.from_numpy(np.stack([cloud.pixels for cloud, _ in clouds]))
    ids = pixels[..., 1] * kinect.width + pixels[..., 0]
    return depth, ids, kinect.intrinsics(torch.float64).expand(4, 4)


# Nearest neighbours


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("num_neighbours", [3, 10, 30])
def test_knn_normals_equal_those_of_one_cloud_at_a_time(clouds, points, dtype, num_neighbours):
    normals = knn_normals(points.to(dtype), num_neighbours)
    assert normals.dtype == dtype
    expected = [numba_knn_normals(cloud, noisy, None, num_neighbours) for cloud, noisy in clouds]
    difference = degrees_between(normals, np.stack(expected)).flatten()
    # In float32, two points may be equally far that in float64 are not.
    assert torch.quantile(difference, 0.999) < 1e-4
    if dtype == torch.float64:
        assert difference.max() < 1e-4


def test_knn_normals_do_not_depend_on_the_batch(points):
    together = knn_normals(points)
    for cloud, normals in zip(points, together):
        assert torch.equal(knn_normals(cloud[None])[0], normals)


@pytest.mark.parametrize("max_pairs", [1, 30_000, 1_000_000])
def test_the_number_of_pairs_at_a_time_changes_no_knn_normal(points, max_pairs):
    few = points[:2, :200]
    torch.testing.assert_close(knn_normals(few, 10, max_pairs), knn_normals(few, 10), atol=1e-6, rtol=0)


def test_repeated_points_have_the_knn_normals_of_one_cloud_at_a_time(points):
    index = np.random.default_rng(0).integers(200, size=800)
    repeated = points[:1, index]
    expected = numba_knn_normals(Cloud(repeated[0].numpy(), None), None, None)
    assert degrees_between(knn_normals(repeated)[0], expected).quantile(0.999) < 1e-4


@pytest.mark.parametrize("num_points", [1, 2, 30, 100])
@pytest.mark.parametrize("direction", [(0, 0, 0), (1, 0, 0), (0.3, -0.7, 0.2)])
def test_one_place_or_a_line_looks_straight_at_the_camera(num_points, direction):
    along = torch.linspace(0, 0.5, num_points)[:, None] * torch.tensor(direction)
    points = (torch.tensor([0.3, -0.2, 1.7]) + along)[None]
    expected = -points / points.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(knn_normals(points), expected, atol=1e-6, rtol=0)


def test_one_place_at_the_camera_itself_has_a_finite_normal():
    assert torch.equal(knn_normals(torch.zeros(1, 4, 3)), torch.tensor([0.0, 0, -1]).expand(1, 4, 3))


@pytest.mark.parametrize("shape", [(0, 10, 3), (2, 0, 3)])
def test_no_points_have_no_knn_normals(shape):
    assert knn_normals(torch.zeros(shape)).shape == shape


def test_impossible_knn_arguments_are_errors():
    with pytest.raises(ValueError, match=r"points: expected \(B, N, 3\), got \(5, 3\)"):
        knn_normals(torch.ones(5, 3))
    with pytest.raises(ValueError, match="num_neighbours: expected at least 3, got 2"):
        knn_normals(torch.ones(1, 5, 3), 2)


@pytest.mark.gpu
@on_cuda
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_gpu_gives_the_knn_normals_of_the_cpu(points, dtype):
    points = points.to(dtype)
    normals = knn_normals(points.cuda())
    assert normals.device.type == "cuda"
    assert degrees_between(normals, knn_normals(points)).quantile(0.999) < 1e-4


# Windows of the depth image


@pytest.mark.parametrize(("radius_px", "max_jump_m"), [(1, 0.05), (2, 0.05), (4, 0.02)])
def test_window_normals_equal_those_of_one_image_at_a_time(clouds, images, kinect, radius_px, max_jump_m):
    normals = window_normals(*images, radius_px, max_jump_m)
    assert normals.dtype == torch.float32
    expected = [numba_window_normals(cloud, noisy, kinect, radius_px, max_jump_m) for cloud, noisy in clouds]
    assert degrees_between(normals, np.stack(expected)).max() < 1e-3


def test_window_normals_take_the_cameras_of_a_batch_in_float32(clouds, images, kinect):
    depth, ids, intrinsics = images
    expected = [numba_window_normals(cloud, noisy, kinect) for cloud, noisy in clouds]
    normals = window_normals(depth, ids, intrinsics.float())
    assert degrees_between(normals, np.stack(expected)).quantile(0.999) < 1e-3


def test_each_image_has_its_own_camera(clouds, images, kinect):
    other = dataclasses.replace(kinect, fx=300.0, cy=200.0)
    depth, ids, _ = images
    cameras = [kinect, other, kinect, other]
    normals = window_normals(depth, ids, torch.stack([c.intrinsics(torch.float64) for c in cameras]))
    expected = [numba_window_normals(cloud, noisy, c) for (cloud, noisy), c in zip(clouds, cameras)]
    assert degrees_between(normals, np.stack(expected)).max() < 1e-3


@pytest.mark.parametrize("max_values", [1, 5_000, 100_000])
def test_the_number_of_values_at_a_time_changes_no_window_normal(images, max_values):
    depth, ids, intrinsics = images
    few = ids[:, :150]
    expected = window_normals(depth, few, intrinsics)
    normals = window_normals(depth, few, intrinsics, max_values=max_values)
    torch.testing.assert_close(normals, expected, atol=1e-6, rtol=0)


def test_borders_gaps_and_lines_are_those_of_one_image_at_a_time():
    rng = np.random.default_rng(0)
    depth = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    kept = rng.random(depth.shape) < 0.08  # single pixels, pairs, lines, and some that span a plane
    kept[[0, -1]] = kept[:, [0, -1]] = True
    depth[kept] = 2 + 0.03 * rng.standard_normal(kept.sum())
    v, u = np.nonzero(kept)
    expected = numba_window_normals(Cloud(None, np.stack([u, v], -1)), depth, CAMERA)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(len(u))], -1)
    looks_straight = np.abs((expected * rays).sum(-1) + np.linalg.norm(rays, axis=-1)) < 1e-6
    assert 0.1 < looks_straight.mean() < 0.9
    ids = torch.from_numpy(v * CAMERA.width + u)[None]
    normals = window_normals(torch.from_numpy(depth)[None], ids, CAMERA.intrinsics(torch.float64)[None])
    assert degrees_between(normals[0], expected).max() < 1e-3


def test_no_pixels_have_no_window_normals(images):
    depth, ids, intrinsics = images
    assert window_normals(depth, ids[:, :0], intrinsics).shape == (4, 0, 3)
    assert window_normals(depth[:0], ids[:0], intrinsics[:0]).shape == (0, 1024, 3)


@pytest.mark.gpu
@on_cuda
def test_a_gpu_gives_the_window_normals_of_the_cpu(images):
    normals = window_normals(*(x.cuda() for x in images))
    assert normals.device.type == "cuda"
    assert degrees_between(normals, window_normals(*images)).max() < 1e-3


# The eigenvector of the smallest eigenvalue


def elements(matrices):
    return [matrices[..., i, j] for i, j in zip(*np.triu_indices(3))]


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e6])
def test_smallest_eigenvectors_equal_eighs(scale):
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(2000, 3, 3))).Q
    values = np.sort(10 ** rng.uniform(-5, 0, (2000, 3)))
    is_clear = torch.from_numpy(values[:, 1] - values[:, 0] > 1e-4 * values[:, 2])
    matrices = torch.from_numpy(scale * (axes * values[:, None]) @ axes.swapaxes(1, 2))
    vectors = smallest_eigenvectors(*elements(matrices))
    expected = torch.linalg.eigh(matrices).eigenvectors[..., 0]
    assert ((vectors * expected).sum(-1).abs() - 1).abs()[is_clear].max() < 1e-6


def test_smallest_eigenvectors_equal_the_scalar_solution_where_there_is_none_too():
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(50, 3))
    rank_one = directions[:, :, None] * directions[:, None]
    full = rng.normal(size=(50, 3, 3))
    full = full @ full.swapaxes(1, 2)
    matrices = np.concatenate([rank_one, full, np.zeros((1, 3, 3)), np.eye(3)[None]])
    vectors = smallest_eigenvectors(*elements(torch.from_numpy(matrices))).numpy()
    expected = np.array([smallest_eigenvector(*elements(matrix)) for matrix in matrices])
    assert not vectors[:50].any()
    assert not vectors[-2:].any()
    np.testing.assert_allclose(vectors, expected, atol=1e-12)
