import numpy as np
import pytest
import torch

from ljn.cloud.observation import ObservationRecipe, crop_body, observe
from ljn.geometry.camera import Camera, back_project

CAMERA = Camera(fx=100.0, fy=110.0, cx=32.0, cy=40.0, width=64, height=80)
KEYPOINTS = np.tile([30.0, 40.0], (24, 1))


@pytest.fixture
def depth():
    """A tilted plane in a part of the image, metres."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    inside = (u >= 20) & (u < 45) & (v >= 10) & (v < 70)
    return np.where(inside, 2 + 0.01 * (u - 32) + 0.005 * (v - 40), 0).astype(np.float32)


def seen(depth, *takes, keypoints=KEYPOINTS, **recipe):
    recipe = ObservationRecipe(num_points=32, crop_px=48, **recipe)
    return observe(depth, CAMERA, keypoints, recipe, takes, np.random.default_rng(0))


def test_just_what_is_taken_is_made(depth):
    assert set(seen(depth, "points")) == {"points"}
    assert set(seen(depth, "crop", "crop_camera", keypoints=None)) == {"crop", "crop_camera"}
    assert set(seen(depth, "initial_joints")) == {"keypoints", "initial_joints"}
    assert seen(depth, "points", "crop")["points"].shape == (32, 6)


def test_keypoints_beyond_the_image_are_moved_to_its_border(depth):
    keypoints = KEYPOINTS + np.linspace(-100, 100, 24)[:, None]
    moved = seen(depth, "keypoints", keypoints=keypoints)["keypoints"]
    np.testing.assert_array_equal(moved, keypoints.clip(0, [63, 79]).astype(np.float32))


def test_what_cannot_be_made_is_an_error(depth):
    with pytest.raises(ValueError, match=r"takes: expected some of points, crop, .*got rgb"):
        seen(depth, "points", "rgb")
    with pytest.raises(
        ValueError, match="keypoints: expected those of the 24 joints, which this network takes"
    ):
        seen(depth, "initial_joints", keypoints=None)
    for takes in ("points", "crop", "initial_joints"):
        with pytest.raises(ValueError, match="the mask is empty"):
            seen(0 * depth, takes)


@pytest.mark.parametrize("size_px", [16, 48, 200])
def test_a_crop_and_its_camera_show_the_surface_of_the_image(depth, size_px):
    crop, intrinsics = crop_body(depth, CAMERA, size_px)
    assert crop.shape == (size_px, size_px)
    v, u = np.nonzero(crop)
    pixels = torch.from_numpy(np.stack([u, v], -1)).float()
    points = back_project(pixels, torch.from_numpy(crop[v, u]), torch.from_numpy(intrinsics)).numpy()
    # The plane through the image's own points, within a pixel of the nearest neighbour's sampling.
    x, y, z = points.T
    expected = 2 + 0.01 * (x / z * CAMERA.fx + CAMERA.cx - 32) + 0.005 * (y / z * CAMERA.fy + CAMERA.cy - 40)
    np.testing.assert_allclose(z, expected, atol=0.008)
    # The body's box lies in the middle, the border around it is free.
    rows, columns = np.flatnonzero(crop.any(1)), np.flatnonzero(crop.any(0))
    assert abs(rows[0] - (size_px - 1 - rows[-1])) <= 1
    assert abs(columns[0] - (size_px - 1 - columns[-1])) <= 1
    assert rows[0] > 0


def test_a_crop_beyond_the_images_border_is_background():
    depth = np.full((CAMERA.height, CAMERA.width), 1.5, np.float32)
    crop, _ = crop_body(depth, CAMERA, 50)
    assert not crop[0].any()
    assert not crop[:, 0].any()
    assert crop[25, 25] == 1.5
