import numpy as np
import pytest

from ljn.body.skeleton import JOINT_INDEX, JOINT_NAMES
from ljn.pipeline.filling import conditional_misfit, fill_missing, joint_covariance, log_likelihood

NOISE_M = 0.05
VAGUE = 1e5  # variance of a mean that is as good as unknown, m^2


@pytest.fixture
def truth(samples):
    """The 24 joints of a sample, projected `(24, 2)`, pixels."""
    return samples[0][0]["true_keypoints"][0].numpy().astype(np.float64)


def test_filling_moves_turns_and_scales_with_the_body(truth):
    is_missing = np.isin(JOINT_NAMES, ["l_hand", "spine2", "r_knee", "head"])
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    given = np.where(is_missing[:, None], np.nan, truth)
    filled = fill_missing(given)
    np.testing.assert_array_equal(filled[~is_missing], truth[~is_missing])
    np.testing.assert_allclose(fill_missing(3 * given @ turn.T + [5, -7]), 3 * filled @ turn.T + [5, -7])


@pytest.mark.parametrize("joint", ["pelvis", "spine2", "l_collar", "l_wrist", "r_foot", "head"])
def test_a_single_missing_joint_is_filled_in_nearby(joint, truth):
    given = truth.copy()
    given[JOINT_INDEX[joint]] = np.nan
    error = np.linalg.norm(fill_missing(given)[JOINT_INDEX[joint]] - truth[JOINT_INDEX[joint]])
    assert error < 0.1 * np.ptp(truth[:, 1])


def test_a_joint_s_deviation_is_that_from_what_all_others_expect(truth):
    places = truth / 150
    places[[3, 11]] = np.nan
    _, deviations = conditional_misfit(places, NOISE_M)
    known = np.flatnonzero(np.isfinite(places[:, 0]))
    assert np.isnan(deviations[[3, 11]]).all()
    covariance = joint_covariance() + NOISE_M**2 * np.eye(24) + VAGUE
    for joint in known:
        others = known[known != joint]
        weights = np.linalg.solve(covariance[np.ix_(others, others)], covariance[others, joint])
        variance = covariance[joint, joint] - weights @ covariance[others, joint]
        residual = places[joint] - weights @ places[others]
        expected = np.sqrt((residual**2).mean() / variance)
        assert deviations[joint] == pytest.approx(expected, rel=1e-2, abs=1e-3)


def test_of_places_drawn_by_the_covariance_the_misfit_is_one():
    rng = np.random.default_rng(0)
    root = np.linalg.cholesky(joint_covariance() + NOISE_M**2 * np.eye(24))
    misfits = [
        conditional_misfit(root @ rng.standard_normal((24, 2)) + [3, -1], NOISE_M)[0] for _ in range(500)
    ]
    assert np.mean(misfits) == pytest.approx(1, abs=0.05)


def test_the_likelihood_is_a_gaussian_s_of_unknown_mean():
    stats = pytest.importorskip("scipy.stats")
    rng = np.random.default_rng(0)
    covariances = [joint_covariance()[:9, :9] + noise**2 * np.eye(9) for noise in (0.05, 0.2)]
    for _ in range(5):
        places = rng.standard_normal((9, 2)) * 0.3
        expected = [
            stats.multivariate_normal(np.zeros(9), covariance + VAGUE).logpdf(places.T).sum()
            for covariance in covariances
        ]
        found = [log_likelihood(places, covariance) for covariance in covariances]
        assert found[0] - found[1] == pytest.approx(expected[0] - expected[1], rel=1e-3, abs=1e-2)
