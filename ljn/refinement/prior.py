"""How far a regressor's guess is from the truth, as measured: what a refinement weighs against the depth."""

from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ljn.body.files import NUM_BETAS
from ljn.body.skeleton import NUM_JOINTS
from ljn.refinement.surface import NUM_CHANGES

PATH = Path(__file__).parent / "data" / "guess_errors.npz"
"""The covariance of the shipped weights' errors, made and described by `python -m tests.benchmarks.refinement`."""
_RIDGE = 0.02  # of each variance, added to it: keeps the inverse moderate
_SHAPE_VARIANCE = 1.0  # of another body's coefficients, whose errors were not measured


def guess_precision(body_hash: str, covariance: np.ndarray | None = None) -> Tensor:
    """The inverse `(85, 85)` float64 of the covariance of a guess's errors, as a change of `BodyState`.

    Args:
        body_hash: Of the body that is fitted. The shape coefficients of another one than the measured mean something
            else: theirs are taken to be independent of pose and place, with a variance of 1.
        covariance: `(85, 85)`, another one; None: the measured.
    """
    measured, measured_hash = (covariance, body_hash) if covariance is not None else _measured()
    covariance = measured.astype(np.float64)
    covariance[np.diag_indices(NUM_CHANGES)] *= 1 + _RIDGE
    if body_hash != measured_hash:
        shape = slice(3 * NUM_JOINTS, 3 * NUM_JOINTS + NUM_BETAS)
        covariance[shape] = 0
        covariance[:, shape] = 0
        covariance[shape, shape] = _SHAPE_VARIANCE * np.eye(NUM_BETAS)
    return torch.linalg.inv(torch.from_numpy(covariance))


@cache
def _measured() -> tuple[np.ndarray, str]:
    with np.load(PATH, allow_pickle=False) as arrays:
        return arrays["covariance"], str(arrays["body"])
