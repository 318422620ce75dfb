"""The joint regressor: each joint as a weighted mean of few vertices around it."""

import numpy as np
from numpy.typing import NDArray

from ljn.body.build.requirements import import_scipy
from ljn.body.skeleton import JOINT_NAMES, MIRROR, NUM_JOINTS, PARENTS

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_REACH = dict.fromkeys(("pelvis", "spine1", "spine2", "spine3", "neck", "collar", "hip"), 0.30)
_REACH_OF_OTHERS = 0.16
"""Metres around a joint within which its vertices lie."""
_MAX_CANDIDATES = 900
_RIDGE = 2e-4
_SUM_WEIGHT = 2.0


def fit_regressor(bodies: Array, joints: Array, weights: Array, mirror: Index, count: int = 250) -> Array:
    """Non-negative least squares from vertices to joints, near each joint only, exactly symmetric.

    Args:
        bodies: `(n, V, 3)`, metres.
        joints: `(n, 24, 3)`, metres.
        weights: `(V, 24)`, skinning weights: a joint's vertices are moved by it, its parent or its children.
        mirror: `(V,)`, left-right counterparts.
        count: How many of the bodies to fit, evenly chosen.

    Returns:
        `(24, V)`, at least 0, rows summing to 1.
    """
    chosen = np.unique(np.linspace(0, len(bodies) - 1, count).astype(int))
    bodies, joints = bodies[chosen], joints[chosen]
    distance = np.linalg.norm(bodies.mean(0) - joints.mean(0)[:, None], axis=-1)  # (24, V)
    regressor = np.zeros((NUM_JOINTS, len(mirror)))
    for joint, name in enumerate(JOINT_NAMES):
        if MIRROR[joint] < joint:
            regressor[joint] = regressor[MIRROR[joint]][mirror]
            continue
        relatives = [j for j, parent in enumerate(PARENTS) if joint in (j, parent) or j == PARENTS[joint]]
        reach = _REACH.get(name.removeprefix("l_"), _REACH_OF_OTHERS)
        near = np.flatnonzero((distance[joint] < reach) & (weights[:, relatives].sum(1) > 0.2))
        if len(near) > _MAX_CANDIDATES:
            near = near[np.linspace(0, len(near) - 1, _MAX_CANDIDATES).astype(int)]
        if MIRROR[joint] == joint:
            near = np.union1d(near, mirror[near])
        row = regressor[joint]
        row[near] = mean_of_points(bodies[:, near], joints[:, joint])
        if MIRROR[joint] == joint:
            regressor[joint] = (row + row[mirror]) / 2
    return regressor


def mean_of_points(points: Array, targets: Array) -> Array:
    """The weights `(N,)`, at least 0 and summing to 1, whose mean of points `(n, N, 3)` is nearest to targets."""
    scale = np.sqrt(len(points))
    coordinates = points.swapaxes(1, 2).reshape(-1, points.shape[1])
    ridge = _RIDGE * scale * np.eye(points.shape[1])
    matrix = np.concatenate([coordinates, np.full((1, points.shape[1]), _SUM_WEIGHT * scale), ridge])
    right = np.concatenate([targets.ravel(), [_SUM_WEIGHT * scale], np.zeros(points.shape[1])])
    weights, _ = import_scipy("optimize").nnls(matrix, right, maxiter=20_000)
    weights[weights < 1e-4] = 0
    return weights / weights.sum()
