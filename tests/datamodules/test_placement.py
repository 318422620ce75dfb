import dataclasses
import math

import numpy as np
import pytest
import torch

from datamodules.placement import HEADINGS, draw_heading, place
from ljn.body import SMPL
from ljn.geometry.camera import project
from ljn.geometry.rotations import CAMERA_FROM_BODY, smpl_pose_to_body_world

ALMOST_ONE = np.nextafter(1.0, 0.0)


@pytest.fixture(scope="module")
def t_pose(body):
    """`(V, 3)`: the body with its arms out, facing the camera."""
    pose = smpl_pose_to_body_world(torch.zeros(72, dtype=torch.float64))
    vertices = SMPL(body).double()(pose, torch.zeros(10, dtype=torch.float64)).vertices
    return (vertices @ CAMERA_FROM_BODY.T).numpy()


@pytest.fixture(scope="module")
def small_object():
    """`(V, 3)`: some points within half a metre, off the origin and not symmetric."""
    return np.random.default_rng(0).uniform((-0.1, 0.2, -0.3), (0.2, 0.6, 0.1), (12, 3))


def to_pixels(points, camera):
    return project(torch.from_numpy(points), camera.intrinsics(torch.float64)).numpy()


def centre_depth(points):
    return (points[:, 2].min() + points[:, 2].max()) / 2


def depth_range_left(mesh, camera, **changes):
    return [
        centre_depth(mesh + place(mesh, camera, np.array([0.5, 0.5, draw]), **changes))
        for draw in (0, ALMOST_ONE)
    ]


# Placement


@pytest.mark.parametrize("margin_px", [0.0, 8.0, 40.0])
def test_every_vertex_lies_inside_the_image_with_the_margin_to_spare(bodies, kinect, margin_px):
    rng = np.random.default_rng(0)
    for mesh in bodies[0]:
        for uniform in (
            *rng.random((4, 3)),
            np.zeros(3),
            np.full(3, ALMOST_ONE),
            np.array([0, ALMOST_ONE, 0]),
        ):
            placed = mesh + place(mesh, kinect, uniform, margin_px=margin_px)
            pixels = to_pixels(placed, kinect)
            assert placed[:, 2].min() > 0
            assert pixels.min() >= margin_px - 1e-9
            assert (pixels.max(0) <= np.array([kinect.width, kinect.height]) - 1 - margin_px + 1e-9).all()


def test_depth_follows_its_draw_from_the_nearest_to_the_farthest(small_object, kinect):
    assert depth_range_left(small_object, kinect) == pytest.approx([1.5, 3.0])
    assert depth_range_left(small_object, kinect, distance_m=(2.0, 2.0)) == pytest.approx([2.0, 2.0])


def test_a_body_that_does_not_fit_is_moved_back_until_it_just_does(t_pose, kinect):
    nearest, farthest = depth_range_left(t_pose, kinect)
    assert 1.5 < nearest < 1.8
    assert farthest == pytest.approx(3.0)
    for draw in (0.0, 0.4, ALMOST_ONE):  # nothing is left to choose: both borders are touched
        u = to_pixels(t_pose + place(t_pose, kinect, np.array([draw, 0.5, 0.0])), kinect)[:, 0]
        assert u.min() == pytest.approx(8)
        assert u.max() == pytest.approx(kinect.width - 1 - 8)


def test_a_body_taller_than_the_image_is_moved_back_too(t_pose, kinect):
    tall = t_pose * [0.3, 2.0, 1.0]
    v = to_pixels(tall + place(tall, kinect, np.array([0.5, 0.5, 0.0])), kinect)[:, 1]
    assert (v.min(), v.max()) == (pytest.approx(8), pytest.approx(kinect.height - 1 - 8))


@pytest.mark.parametrize("axis", [0, 1])
def test_sideways_and_upright_places_reach_both_borders(small_object, kinect, axis):
    size = (kinect.width, kinect.height)[axis]
    for draw, border, outermost in ((0.0, 8, np.min), (ALMOST_ONE, size - 1 - 8, np.max)):
        uniform = np.full(3, 0.5)
        uniform[axis] = draw
        pixels = to_pixels(small_object + place(small_object, kinect, uniform), kinect)[:, axis]
        assert outermost(pixels) == pytest.approx(border)


def test_where_the_mesh_came_from_does_not_matter(small_object, kinect):
    uniform = np.array([0.2, 0.7, 0.4])
    there = small_object + np.array([3.0, -2.0, 5.0])
    expected = small_object + place(small_object, kinect, uniform)
    np.testing.assert_allclose(there + place(there, kinect, uniform), expected, atol=1e-12)


def test_margins_that_leave_nothing_of_the_image_are_an_error(small_object, kinect):
    with pytest.raises(
        ValueError, match=r"margin_px: a clear border of 212 px leaves nothing of .* 424 x 512"
    ):
        place(small_object, kinect, np.zeros(3), margin_px=212)
    narrow = dataclasses.replace(kinect, cx=5.0, width=12)
    with pytest.raises(ValueError, match="margin_px"):
        place(small_object, narrow, np.zeros(3))


# Headings


def draw_headings(kind, number=20_000):
    rng = np.random.default_rng(0)
    return np.array([draw_heading(kind, rng) for _ in range(number)])


def test_the_histogram_has_the_shares_of_recorded_headings_and_is_flat_in_each_of_its_parts():
    stats = pytest.importorskip("scipy.stats", reason="SciPy is not installed")
    away = np.abs(draw_headings("histogram"))
    front, back = away <= math.pi / 4, away >= 3 * math.pi / 4
    assert front.mean() == pytest.approx(0.62, abs=0.01)
    assert back.mean() == pytest.approx(0.21, abs=0.01)
    for low, high in ((0, 1), (1, 3), (3, 4)):
        part = away[(away >= low * math.pi / 4) & (away < high * math.pi / 4)]
        uniform = stats.uniform(low * math.pi / 4, (high - low) * math.pi / 4)
        assert stats.kstest(part, uniform.cdf).pvalue > 0.01


@pytest.mark.parametrize("kind", ["histogram", "uniform"])
def test_left_and_right_headings_are_equally_likely(kind):
    stats = pytest.importorskip("scipy.stats", reason="SciPy is not installed")
    headings = draw_headings(kind)
    left, right = headings[headings > 0], -headings[headings < 0]
    assert len(left) / len(headings) == pytest.approx(0.5, abs=0.01)
    assert stats.ks_2samp(left, right).pvalue > 0.01


def test_uniform_headings_are_uniform_all_round_and_the_sources_own_is_left_as_it_is():
    stats = pytest.importorskip("scipy.stats", reason="SciPy is not installed")
    headings = draw_headings("uniform")
    assert stats.kstest(headings, stats.uniform(-math.pi, 2 * math.pi).cdf).pvalue > 0.01
    assert (draw_headings("source", 50) == 0).all()


def test_every_kind_of_heading_takes_the_same_number_of_draws():
    after = []
    for kind in HEADINGS:
        rng = np.random.default_rng(0)
        draw_heading(kind, rng)
        after.append(rng.random())
    assert len(set(after)) == 1
