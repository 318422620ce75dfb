"""Shape components: a PCA of sampled bodies, scaled so that beta ~ N(0, 1) draws bodies like the samples."""

import numpy as np
from numpy.typing import NDArray

from ljn.body.build.surface import vertex_areas, volume
from ljn.body.build.topology import symmetrised
from ljn.body.files import NUM_BETAS

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_TALLER = 0.02
"""Metres: a component that changes the stature by more than this points to taller bodies, others to heavier."""


def fit_shapes(bodies: Array, faces: Index, mirror: Index) -> tuple[Array, Array]:
    """Mean `(V, 3)` and principal components of bodies `(n, V, 3)`, vertices weighted by the area around them.

    Components `(V, 3, 10)` are the offsets of one standard deviation; metres, exactly symmetric.
    """
    mean = symmetrised(bodies.mean(0), mirror)
    root = np.sqrt(vertex_areas(mean, faces))[:, None]
    weighted = ((bodies - mean) * root).reshape(len(bodies), -1)
    # The n x n Gram matrix: far smaller than the covariance of all coordinates.
    values, vectors = np.linalg.eigh(weighted @ weighted.T)
    values, vectors = values[::-1][:NUM_BETAS], vectors[:, ::-1][:, :NUM_BETAS]
    deviations = (vectors.T @ weighted).reshape(NUM_BETAS, -1, 3) / root / np.sqrt(len(bodies) - 1)
    signed = [_pointing_up(mean, symmetrised(deviation, mirror), faces) for deviation in deviations]
    return mean, np.stack(signed, axis=-1)


def fit_betas(bodies: Array, mean: Array, components: Array, faces: Index) -> Array:
    """The betas `(n, 10)` that come closest to bodies `(n, V, 3)`, vertices weighted by area."""
    root = np.sqrt(vertex_areas(mean, faces))[:, None]
    basis = (components * root[..., None]).reshape(-1, NUM_BETAS)
    targets = ((bodies - mean) * root).reshape(len(bodies), -1)
    return np.asarray(np.linalg.lstsq(basis, targets.T, rcond=None)[0].T, dtype=np.float64)


def _pointing_up(mean: Array, component: Array, faces: Index) -> Array:
    taller = component[mean[:, 1].argmax(), 1] - component[mean[:, 1].argmin(), 1]
    heavier = volume(mean + component, faces) - volume(mean - component, faces)
    sign = taller if abs(taller) > _TALLER else heavier
    return component if sign >= 0 else -component
