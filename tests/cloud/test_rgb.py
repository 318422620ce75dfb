import numpy as np
import pytest

from ljn.cloud.rgb import RgbRecipe, crop_rgb
from ljn.geometry.camera import Camera

CAMERA = Camera(fx=300, fy=320, cx=150.5, cy=90.25, width=400, height=240)
RECIPE = RgbRecipe(height_px=64, width_px=32)


@pytest.fixture(scope="module")
def ramp():
    """An image whose red grows with the column and whose green with the row."""
    columns, rows = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    return np.stack([columns / 2, rows, np.full_like(rows, 200)], -1).round().astype(np.uint8)


def box_mask(top, bottom, left, right):
    mask = np.zeros((CAMERA.height, CAMERA.width), bool)
    mask[top:bottom, left:right] = True
    return mask


@pytest.mark.parametrize(
    "box", [(40, 200, 150, 190), (90, 110, 200, 215), (30, 60, 100, 300), (0, 240, 0, 30)]
)
def test_a_pixel_of_the_crop_shows_what_its_camera_says(ramp, box):
    crop, intrinsics = crop_rgb(ramp, box_mask(*box), CAMERA, RECIPE, is_black=False)
    assert crop.shape == (3, 64, 32)
    assert crop.dtype == np.uint8
    assert intrinsics.shape == (4,)
    assert intrinsics.dtype == np.float32
    fx, fy, cx, cy = intrinsics
    u = (np.arange(32) - cx) / fx * CAMERA.fx + CAMERA.cx
    v = (np.arange(64) - cy) / fy * CAMERA.fy + CAMERA.cy
    shown = (
        np.flatnonzero((u > 2) & (u < CAMERA.width - 3)),
        np.flatnonzero((v > 2) & (v < CAMERA.height - 3)),
    )
    inner = crop[:, shown[1][1:-1]][:, :, shown[0][1:-1]]
    # The ramp's rounding to whole numbers, and the crop's.
    np.testing.assert_allclose(inner[0], np.broadcast_to(u[shown[0][1:-1]] / 2, inner[0].shape), atol=1.01)
    np.testing.assert_allclose(
        inner[1], np.broadcast_to(v[shown[1][1:-1]][:, None], inner[1].shape), atol=1.01
    )


def test_the_person_fills_ten_elevenths_of_the_crop(ramp):
    crop, _ = crop_rgb(ramp, box_mask(40, 200, 150, 190), CAMERA, RECIPE)
    rows, columns = crop.any((0, 2)).nonzero()[0], crop.any((0, 1)).nonzero()[0]
    assert len(rows) == pytest.approx(64 / 1.1, abs=2)
    assert (rows[0] + rows[-1]) / 2 == pytest.approx(31.5, abs=0.6)
    assert (columns[0] + columns[-1]) / 2 == pytest.approx(15.5, abs=0.6)
    assert len(columns) == pytest.approx(64 / 1.1 / 4, abs=2)


def test_what_is_outside_of_the_mask_or_of_the_image_is_black(ramp):
    mask = box_mask(0, 240, 0, 30)
    masked, kept = (crop_rgb(ramp, mask, CAMERA, RECIPE, is_black)[0] for is_black in (True, False))
    assert (masked[:, :, :10] == 0).all()
    assert (kept[:, :, :10] == 0).all()
    assert masked[2].max() == kept[2].max() == 200
    assert (masked[2] > 0).mean() < (kept[2] > 0).mean() - 0.1
    np.testing.assert_array_equal(masked, crop_rgb(ramp, 255 * mask.astype(np.uint8), CAMERA, RECIPE)[0])


def test_a_crop_is_a_mean_over_areas():
    stripes = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    stripes[:, ::2] = 200
    crop, _ = crop_rgb(stripes, np.ones(stripes.shape[:2]), CAMERA, RgbRecipe(32, 32))
    inside = crop[:, 13:19, 8:-8]
    assert abs(inside.astype(int) - 100).max() <= 10


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mask": np.zeros((240, 400))}, "mask: it is empty"),
        ({"mask": np.ones((240, 401))}, r"mask: expected shape \(240, 400\)"),
        ({"rgb": np.zeros((240, 400, 3))}, r"rgb: expected uint8 of shape \(240, 400, 3\).*got float64"),
        ({"rgb": np.zeros((240, 400), np.uint8)}, r"rgb: .* got uint8 of shape \(240, 400\)"),
    ],
)
def test_images_that_do_not_fit_are_refused(ramp, change, message):
    given = {"rgb": ramp, "mask": box_mask(0, 9, 0, 9), **change}
    with pytest.raises(ValueError, match=message):
        crop_rgb(camera=CAMERA, recipe=RECIPE, **given)


@pytest.mark.parametrize("size", [0, 31, 100, -32, 64.0, True])
def test_a_crop_of_another_size_than_multiples_of_32_is_refused(size):
    with pytest.raises(ValueError, match="width_px: expected a positive multiple of 32"):
        RgbRecipe(width_px=size)
