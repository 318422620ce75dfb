"""Joints that are not known, predicted from those that are; and how far known ones lie from where others expect them.

A missing joint is the linear combination of the known ones, with weights that sum to one, whose expected error over the
embedded training poses is least. It depends on the joints' covariance alone, turns and scales with the body, and keeps
left and right apart only as far as the known joints do.
"""

import math
from functools import cache, lru_cache
from pathlib import Path

import numpy as np

KEYPOINT_NOISE_M = 0.03
"""What is expected of the known keypoints' errors on the body, standard deviation: keeps the weights moderate."""
COVARIANCE_PATH = Path(__file__).parent / "data" / "joint_covariance.npz"

_MOST_PATTERNS = 4096  # of known joints whose weights are kept


def fill_missing(positions: np.ndarray) -> np.ndarray:
    """Positions `(24, 2)` whose NaN rows are predicted from the others, which stay as they are."""
    is_known = np.isfinite(positions).all(1)
    filled = positions.copy()
    filled[~is_known] = _weights(tuple(is_known.tolist())) @ positions[is_known]
    return filled


def conditional_misfit(places: np.ndarray, noise_m: float) -> tuple[float, np.ndarray]:
    """How unlike a body's the known places are: squared, 1 on average; and of each by itself, `(24,)`.

    The second is how many standard deviations a place is from where all others expect it (NaN where not known).

    Args:
        places: `(24, 2)`, metres in any plane, NaN where not known; at least two are.
        noise_m: Standard deviation of their noise.
    """
    is_known = np.isfinite(places).all(1)
    known = np.flatnonzero(is_known)
    precision = np.linalg.inv(joint_covariance()[np.ix_(known, known)] + noise_m**2 * np.eye(len(known)))
    # With an unknown mean: what moves all places alike counts for nothing.
    of_mean = precision.sum(1)
    precision -= np.outer(of_mean, of_mean) / of_mean.sum()
    moved = precision @ places[known]
    diagonal = precision.diagonal()
    deviations = np.full(len(places), np.nan)
    deviations[known] = np.sqrt((moved**2).sum(1) / (2 * diagonal))
    total = float((places[known] * moved).sum()) / (2 * (len(known) - 1))
    return max(total, 0.0), deviations


def log_likelihood(places: np.ndarray, covariance: np.ndarray) -> float:
    """The log of the likelihood of places `(K, 2)`, metres in any plane, with an unknown mean; but for a constant."""
    solved = np.linalg.solve(covariance, np.concatenate([places, np.ones((len(places), 1))], 1))
    totals = solved.sum(0)
    squares = float((places * solved[:, :2]).sum() - (totals[:2] ** 2).sum() / totals[2])
    return -float(np.linalg.slogdet(covariance)[1]) - math.log(totals[2]) - squares / 2


@cache
def joint_covariance() -> np.ndarray:
    """`(24, 24)`, m^2: of the joints' positions along any direction, over poses."""
    with np.load(COVARIANCE_PATH) as arrays:
        return arrays["covariance"].astype(np.float64)


@lru_cache(_MOST_PATTERNS)
def _weights(is_known: tuple[bool, ...]) -> np.ndarray:
    """Of each known joint in each missing one, `(missing, known)`; rows sum to one."""
    known, missing = np.flatnonzero(is_known), np.flatnonzero(~np.array(is_known))
    covariance, size = joint_covariance(), len(known)
    # Least squares with a Lagrange multiplier for the sum: best linear prediction with an unknown mean.
    system = np.ones((size + 1, size + 1))
    system[:size, :size] = covariance[np.ix_(known, known)] + KEYPOINT_NOISE_M**2 * np.eye(size)
    system[size, size] = 0
    target = np.ones((size + 1, len(missing)))
    target[:size] = covariance[np.ix_(known, missing)]
    return np.linalg.solve(system, target)[:size].T
