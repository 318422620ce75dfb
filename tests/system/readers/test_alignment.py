import cv2
import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

from ljn.geometry.camera import Camera
from ljn.system.readers.alignment import Alignment
from ljn.system.readers.cameras import LensCamera
from tests.system.readers.conftest import DEPTH_CAMERA, RGB_CAMERA, as_tuples, cast, hit, turned

BARREL = (-0.28, 0.09, 0.002, -0.001, -0.01)
AZURE = (0.52, -2.7, 0.0005, -0.0002, 1.5, 0.4, -2.5, 1.46)


def reference(depth, rgb_camera, rgb_from_depth, lens):
    """By ray casting: whether the colour camera sees each depth pixel's point, and where."""
    v, u = np.indices(depth.shape)
    points = np.stack(
        [(u - DEPTH_CAMERA.cx) / DEPTH_CAMERA.fx, (v - DEPTH_CAMERA.cy) / DEPTH_CAMERA.fy, 1 + 0 * u], -1
    )
    points = points * depth[..., None]
    origin = -rgb_from_depth[:3, :3].T @ rgb_from_depth[:3, 3]
    blocked = hit(origin, points - origin) < 0.98
    matrix = np.array([[rgb_camera.fx, 0, rgb_camera.cx], [0, rgb_camera.fy, rgb_camera.cy], [0, 0, 1]])
    turn = cv2.Rodrigues(rgb_from_depth[:3, :3])[0]
    coefficients = np.array(lens or [0.0] * 4)
    places = cv2.projectPoints(points.reshape(-1, 3), turn, rgb_from_depth[:3, 3], matrix, coefficients)[0]
    places = places.reshape(*depth.shape, 2)
    size = np.array([rgb_camera.width, rgb_camera.height])
    inside = ((places >= -0.5) & (places < size - 0.5)).all(-1)
    inner = ((places >= 0) & (places <= size - 1)).all(-1)  # between the middles of its pixels
    return inside, inner, blocked


@pytest.mark.parametrize("lens", [(), BARREL, AZURE])
@pytest.mark.parametrize("rgb_camera", [RGB_CAMERA, Camera(60, 60, 40, 30, 80, 60)])
def test_colours_come_from_where_the_colour_camera_sees_each_point(scene, rgb_camera, lens):
    depth, expected = scene
    rgb_from_depth = turned(4, [-0.15, 0.02, 0.03])
    # What a camera with this lens would take: each distorted pixel shows the direction that lands there.
    straight = straight_places(rgb_camera, lens)
    rgb = cast(rgb_camera, np.linalg.inv(rgb_from_depth), straight)[2]
    align = Alignment(LensCamera(DEPTH_CAMERA), LensCamera(rgb_camera, lens, as_tuples(rgb_from_depth)))
    same, colours = align(depth, rgb)
    np.testing.assert_array_equal(same, depth)
    assert colours.dtype == np.uint8
    is_black = (colours == 0).all(-1)
    inside, inner, blocked = reference(depth, rgb_camera, rgb_from_depth, lens)
    assert 20 < np.count_nonzero(blocked & inside) < 0.2 * depth.size
    # Away from the edges of what is hidden and of the images, all pixels agree.
    near = maximum_filter(blocked, 7) != minimum_filter(blocked, 7)
    near |= maximum_filter(depth, 7) - minimum_filter(depth, 7) > 0.1
    border = maximum_filter(inside, 3) != minimum_filter(inside, 3)
    sure = ~near & ~border
    np.testing.assert_array_equal(is_black[sure & blocked], True)
    np.testing.assert_array_equal(is_black[sure & inside & ~blocked], False)
    assert (is_black != (blocked | ~inside))[~border].mean() < 0.01
    difference = np.abs(colours.astype(int) - expected)[sure & inner & ~blocked]
    assert difference.max() <= 6
    assert difference.mean() < 0.7


def straight_places(camera, lens):
    """For each pixel of the distorted image its place in the straight one, by OpenCV."""
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1).astype(np.float64)
    if not lens:
        return pixels
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    found = cv2.undistortPoints(
        pixels.reshape(-1, 1, 2), matrix, np.array(lens), R=None, P=matrix, criteria=criteria
    )
    return found.reshape(pixels.shape)


def test_a_camera_in_the_same_place_gives_each_pixel_its_own_colour(scene):
    depth, colours = scene
    found = Alignment(LensCamera(DEPTH_CAMERA), LensCamera(DEPTH_CAMERA))(depth, colours)[1]
    np.testing.assert_array_equal(found, colours)


def test_without_depth_there_is_no_colour(scene):
    depth, colours = scene
    depth = depth.copy()
    depth[20:40] = 0
    found = Alignment(LensCamera(DEPTH_CAMERA), LensCamera(DEPTH_CAMERA))(depth, colours)[1]
    assert not found[20:40].any()


@pytest.mark.parametrize("lens", [BARREL, BARREL[:4], AZURE])
def test_a_distorted_image_becomes_that_of_the_pinhole_camera(scene, lens):
    depth, colours = scene
    distorted_depth, _, distorted = cast(DEPTH_CAMERA, np.eye(4), straight_places(DEPTH_CAMERA, lens))
    align = Alignment(LensCamera(DEPTH_CAMERA, lens))
    found, rgb = align(distorted_depth.astype(np.float32), distorted)
    known = (found > 0) & (maximum_filter(depth, 5) - minimum_filter(depth, 5) < 0.1)
    assert known.mean() > 0.6
    # Half a pixel beside, on a wall that is tilted.
    assert np.abs(found - depth)[known].max() < 0.02
    inner = minimum_filter(known, 3)
    assert np.abs(rgb.astype(int) - colours)[inner].max() <= 6
    assert set(np.unique(found)) <= {0, *np.unique(distorted_depth.astype(np.float32))}, (
        "depths are not mixed"
    )


def test_places_in_a_distorted_image_are_those_of_opencv():
    camera = DEPTH_CAMERA
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    for lens in (BARREL, (0.1, -0.05, 0.001, 0.002), (0.1, 0.02, 0.001, 0.002, 0.01, 0.05, 0.01, 0.002)):
        size = (camera.width, camera.height)
        u, v = cv2.initUndistortRectifyMap(matrix, np.array(lens), None, matrix, size, cv2.CV_32FC1)
        places = Alignment(LensCamera(camera, lens))._straight
        np.testing.assert_allclose(places, np.stack([u, v]), atol=1e-3)


def test_what_lies_beyond_the_edge_of_the_lens_is_not_folded_into_the_image():
    # The polynomial turns back at a radius of 0.58: directions beyond it would land inside the image again.
    lens = LensCamera(Camera(40, 40, 60, 50, 121, 101), (-1.0, 0, 0, 0))
    places = Alignment(lens)._straight
    assert places[:, 50, 60].tolist() == [60, 50]
    assert places[0, 50, 60 + 22] < 80
    assert (places[:, 50, 60 + 24 :] < -1000).all()


def test_registration_says_what_it_does():
    still = LensCamera(RGB_CAMERA)
    moved = LensCamera(RGB_CAMERA, (), as_tuples(turned(1, [0.05, 0, 0])))
    bent = LensCamera(DEPTH_CAMERA, BARREL)
    assert Alignment(LensCamera(DEPTH_CAMERA)).facts == {}
    assert Alignment(bent).facts == {"undistorted": "depth and colour"}
    assert "same place" in Alignment(bent, still).facts["registration"]
    assert "extrinsics" in Alignment(bent, moved).facts["registration"]
