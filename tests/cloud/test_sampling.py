import numpy as np
import pytest
import torch

from datamodules.noise import add_depth_noise
from ljn.cloud.sampling import sample_cloud
from ljn.geometry.camera import Camera, project

CAMERA = Camera(fx=50.0, fy=52.0, cx=31.2, cy=23.9, width=64, height=48)


def ellipse(camera=CAMERA, radius=0.4):
    """A depth image `(H, W)` with a body-like blob that slopes in depth, and its mask."""
    v, u = np.mgrid[: camera.height, : camera.width]
    mask = ((u / camera.width - 0.5) ** 2 + (v / camera.height - 0.5) ** 2) < radius**2
    depth = np.where(mask, 2.0 + 0.01 * u - 0.004 * v, 0).astype(np.float32)
    return depth, mask


def rng(seed=0):
    return np.random.default_rng(seed)


# Depth noise


def test_noise_stays_on_the_body_and_leaves_the_image_it_was_given():
    depth, mask = ellipse()
    before = depth.copy()
    noisy = add_depth_noise(depth, 0.001, rng())
    np.testing.assert_array_equal(depth, before)
    assert noisy.dtype == np.float32
    assert (noisy[~mask] == 0).all()
    assert (noisy[mask] != depth[mask]).mean() > 0.99


def test_noise_is_gaussian_with_the_standard_deviation_asked_for(kinect):
    stats = pytest.importorskip("scipy.stats", reason="SciPy is not installed")
    depth, mask = ellipse(kinect)
    noise = (add_depth_noise(depth, 0.001, rng()).astype(np.float64) - depth)[mask]
    assert len(noise) > 50_000
    assert noise.std() == pytest.approx(0.001, rel=0.02)
    assert abs(noise.mean()) < 2e-5
    assert stats.kstest(noise[:5000] / 0.001, "norm").pvalue > 0.001


def test_no_noise_leaves_the_image_and_an_image_in_column_order_has_the_same_noise():
    depth, _ = ellipse()
    np.testing.assert_array_equal(add_depth_noise(depth, 0.0, rng()), depth)
    expected = add_depth_noise(depth, 0.001, rng())
    np.testing.assert_array_equal(add_depth_noise(np.asfortranarray(depth), 0.001, rng()), expected)


# Sampling


@pytest.mark.parametrize("num_points", [1, 100, 5000])
def test_points_fall_back_on_their_pixels_with_the_depth_of_those(num_points):
    depth, mask = ellipse()
    cloud = sample_cloud(depth, CAMERA, num_points, rng())
    assert cloud.points.shape == (num_points, 3)
    assert cloud.points.dtype == np.float32
    assert cloud.pixels.shape == (num_points, 2)
    pixels = project(torch.from_numpy(cloud.points), CAMERA.intrinsics()).numpy()
    np.testing.assert_allclose(pixels, cloud.pixels, atol=1e-4)
    u, v = cloud.pixels.T
    assert mask[v, u].all()
    np.testing.assert_array_equal(cloud.points[:, 2], depth[v, u])


def test_no_pixel_comes_twice_while_there_are_enough():
    depth, mask = ellipse()
    for num_points in (500, np.count_nonzero(mask)):
        pixels = sample_cloud(depth, CAMERA, num_points, rng()).pixels
        assert len(np.unique(pixels, axis=0)) == num_points


def test_every_pixel_comes_at_least_once_where_there_are_too_few():
    depth, mask = ellipse(radius=0.1)
    num_pixels = np.count_nonzero(mask)
    cloud = sample_cloud(depth, CAMERA, 3 * num_pixels, rng())
    assert len(np.unique(cloud.pixels, axis=0)) == num_pixels
    assert len(np.unique(cloud.pixels[:num_pixels], axis=0)) == num_pixels
    # The rest is drawn, not repeated in order.
    assert (cloud.pixels[num_pixels : 2 * num_pixels] != cloud.pixels[:num_pixels]).any()


@pytest.mark.parametrize("radius", [0.4, 0.1])
def test_fewer_points_are_the_first_ones_of_more(kinect, radius):
    depth, mask = ellipse(kinect, radius)
    assert (np.count_nonzero(mask) < 8000) == (radius == 0.1)
    many = sample_cloud(depth, kinect, 9000, rng())
    for num_points in (2048, 4096, 8500):
        few = sample_cloud(depth, kinect, num_points, rng())
        np.testing.assert_array_equal(few.pixels, many.pixels[:num_points])
        np.testing.assert_array_equal(few.points, many.points[:num_points])


def test_pixels_come_in_random_order_and_evenly_from_the_whole_body():
    depth, mask = ellipse()
    u, v = sample_cloud(depth, CAMERA, 800, rng()).pixels.T
    row, column = np.nonzero(mask)
    for drawn, all_of_them in ((u, column), (v, row)):
        assert np.corrcoef(drawn, np.arange(800))[0, 1] == pytest.approx(0, abs=0.15)
        assert drawn.mean() == pytest.approx(all_of_them.mean(), abs=1.5)
        assert drawn.std() == pytest.approx(all_of_them.std(), rel=0.1)


def test_an_empty_mask_and_an_image_of_another_size_than_the_cameras_are_errors():
    with pytest.raises(ValueError, match=r"depth: the mask is empty.*check the segmentation, the depth unit"):
        sample_cloud(np.zeros((CAMERA.height, CAMERA.width), np.float32), CAMERA, 10, rng())
    depth, _ = ellipse()
    with pytest.raises(ValueError, match=r"expected the camera's 48 x 64 \(height x width\), got \(64, 48\)"):
        sample_cloud(depth.T, CAMERA, 10, rng())
