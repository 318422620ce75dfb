import numpy as np
import pytest

from ljn.body.skeleton import BONES, JOINT_INDEX
from ljn.geometry.camera import Camera
from ljn.pipeline import keypoint_checks as checks


@pytest.fixture
def truth(samples):
    """The 24 joints of a sample, projected `(24, 2)`, pixels."""
    return samples[0][0]["true_keypoints"][0].numpy().astype(np.float64)


@pytest.fixture
def body(samples, kinect):
    return checks.seen_body(samples[0][1], kinect)


def to_segment(point, start, end):
    share = np.clip((point - start) @ (end - start) / ((end - start) ** 2).sum(), 0, 1)
    return np.linalg.norm(point - start - share * (end - start))


def test_the_fit_is_what_slow_loops_say(truth, body):
    found = checks.fit(truth + 15, body)
    places = body.places(truth + 15)
    off = [min(0.5, np.linalg.norm(body.cells - place, axis=1).min()) for place in places]
    bare = [
        min(0.5, min(to_segment(cell, places[a], places[b]) for a, b in BONES)) for cell in body.cells[::7]
    ]
    assert found.off_m == pytest.approx(np.mean(off))
    assert found.share == np.mean(np.array(off) < 0.1)
    assert found.bare_m == pytest.approx(np.mean(bare), rel=0.1)
    assert not found.is_impossible
    assert not found.is_few


def test_distances_are_metres_at_the_body_s_depth(samples, kinect, truth):
    depth, step = samples[0][1], 3
    camera = Camera(**{name: step * value for name, value in vars(kinect).items()})
    fine = checks.seen_body(np.kron(depth, np.ones((step, step), np.float32)), camera)
    assert max(np.ptp(fine.cells, 0)) == pytest.approx(
        max(np.ptp(checks.seen_body(depth, kinect).cells, 0)), rel=0.05
    )
    assert len(fine.cells) < 64 * 64
    expected, found = checks.fit(truth, checks.seen_body(depth, kinect)), checks.fit(step * truth + 1, fine)
    np.testing.assert_allclose(found[:4], expected[:4], atol=0.02)


def test_a_body_of_few_pixels_has_some_left(kinect):
    for rows, columns in (([100], [50]), ([3, 400], [7, 300])):
        depth = np.zeros((512, 424), np.float32)
        depth[rows, columns] = 2
        found = checks.seen_body(depth, kinect)
        assert 1 <= len(found.cells) <= len(rows)
        assert found.depth_m == 2


def test_at_most_a_quarter_of_the_keypoints_are_wild(truth, body):
    given = truth.copy()
    joints = [JOINT_INDEX[name] for name in ("r_wrist", "l_foot", "head")]
    given[joints] = [[10, 10], [400, 20], [20, 500]]
    found, is_wild = checks.fit_without_wild(given, body)
    assert set(np.flatnonzero(is_wild)) == set(joints)
    assert not found.is_doubtful
    rng = np.random.default_rng(0)
    found, is_wild = checks.fit_without_wild(rng.random((24, 2)) * [424, 512], body)
    assert is_wild.sum() <= 6
    assert found.is_impossible


def test_few_keypoints_are_judged_by_their_places_alone(truth, body):
    given = np.full((24, 2), np.nan)
    given[20:22] = truth[20:22]
    found = checks.fit(given, body)
    assert found.is_few
    assert not found.is_doubtful
    assert checks.fit(given + 300, body).is_impossible


def test_a_reading_that_fits_is_found_and_none_where_none_does(truth, body):
    words, found = checks.better_reading(truth[:, ::-1], body, is_refused=False)
    assert words == "with u and v swapped"
    assert not found.is_doubtful
    assert checks.better_reading(0 * truth + truth.mean(0), body, is_refused=True) is None
