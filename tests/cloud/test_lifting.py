import numpy as np
import pytest
import torch

from ljn.cloud.lifting import lift_keypoints
from ljn.geometry.camera import Camera, project

CAMERA = Camera(fx=50.0, fy=52.0, cx=16.2, cy=11.9, width=32, height=24)


def random_image(rng, share):
    depth = rng.uniform(1.5, 3.0, (CAMERA.height, CAMERA.width)).astype(np.float32)
    depth[rng.random(depth.shape) >= share] = 0
    depth[rng.integers(CAMERA.height), rng.integers(CAMERA.width)] = 2.0  # at least one pixel
    return depth


def image_with(*pixels):
    depth = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    for u, v, value in pixels:
        depth[v, u] = value
    return depth


def test_a_keypoint_on_the_body_takes_the_depth_of_its_pixel():
    rng = np.random.default_rng(0)
    depth = random_image(rng, 0.5)
    v, u = np.nonzero(depth)
    keypoints = np.stack([u, v], -1) + rng.uniform(-0.49, 0.49, (len(u), 2))
    lifted = lift_keypoints(keypoints, depth, CAMERA)
    assert lifted.dtype == np.float32
    np.testing.assert_array_equal(lifted[:, 2], depth[v, u])


@pytest.mark.parametrize("share", [0.0, 0.002, 0.05, 0.6])
def test_a_keypoint_beside_the_body_borrows_the_depth_of_the_nearest_body_pixel(share):
    rng = np.random.default_rng(1)
    for _ in range(20):
        depth = random_image(rng, share)
        keypoints = rng.uniform((-40, -30), (72, 54), (40, 2))
        v, u = np.nonzero(depth)
        lifted = lift_keypoints(keypoints, depth, CAMERA)
        for (ku, kv), z in zip(keypoints, lifted[:, 2]):
            distance = np.hypot(u - ku, v - kv)
            own = (u == round(ku)) & (v == round(kv))
            expected = depth[v, u][own] if own.any() else depth[v, u][distance < distance.min() + 1e-9]
            assert z in expected


def test_a_keypoint_keeps_its_place_in_the_image():
    rng = np.random.default_rng(2)
    keypoints = rng.uniform((-40, -30), (72, 54), (40, 2))
    lifted = torch.from_numpy(lift_keypoints(keypoints, random_image(rng, 0.05), CAMERA))
    np.testing.assert_allclose(project(lifted, CAMERA.intrinsics()).numpy(), keypoints, atol=1e-3)


def test_keypoints_do_not_touch_each_other():
    rng = np.random.default_rng(3)
    depth, keypoints = random_image(rng, 0.02), rng.uniform(0, 24, (10, 2))
    together = lift_keypoints(keypoints, depth, CAMERA)
    alone = [lift_keypoints(keypoint[None], depth, CAMERA)[0] for keypoint in keypoints]
    np.testing.assert_array_equal(together, alone)


def test_an_empty_mask_is_an_error():
    with pytest.raises(ValueError, match="depth: the mask is empty, there is no depth to lift"):
        lift_keypoints(np.ones((24, 2)), image_with(), CAMERA)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_keypoint_that_is_not_finite_is_an_error(value):
    with pytest.raises(ValueError, match="keypoints: NaN or infinite values"):
        lift_keypoints(np.array([[1.0, 2.0], [3.0, value]]), image_with((3, 2, 1.0)), CAMERA)
