"""Skinning: SMPL's joints' weights, their transforms, linear and dual-quaternion blending, the T-pose."""

import numpy as np
from numpy.typing import NDArray

from ljn.body.build.surface import neighbour_mean, smoothed
from ljn.body.build.topology import Topology
from ljn.body.skeleton import JOINT_INDEX, MIRROR, NUM_JOINTS, PARENTS

Array = NDArray[np.float64]

_MAX_JOINTS = 4
"""Joints that move a vertex, as in SMPL."""
_MIN_WEIGHT = 5e-3
_PASSES = 4
_SHOULDER_PASSES = 12
"""Of smoothing the weights over the surface."""
_FLANK_POWER = 2.0
"""The arm's share of what arm and spine pull together is raised to this power."""
_COLLAR_DEGREES = 10.0
_LEG_DEGREES = 2.0
_LR = list(MIRROR)


def clean_weights(weights: Array, topology: Topology) -> Array:
    """Weights `(V, 24)` smoothed over the surface, exactly symmetric, of at most four joints, rows summing to 1.

    The shoulders are smoothed further than the rest, and the flank goes less with the arm: else a raised arm
    carries a bulge of the armpit with it.
    """
    weights = weights / weights.sum(1, keepdims=True)
    mean = neighbour_mean(topology.faces)
    usual, soft = smoothed(weights, mean, _PASSES), smoothed(weights, mean, _SHOULDER_PASSES)
    arms = [JOINT_INDEX[side + joint] for side in ("l_", "r_") for joint in ("collar", "shoulder")]
    arm = soft[:, arms].sum(1)
    forearm = soft[:, [JOINT_INDEX["l_elbow"], JOINT_INDEX["r_elbow"]]].sum(1)
    at_shoulder = ((arm > 0.02) & (arm < 0.995) & (forearm < 0.002)).astype(np.float64)[:, None]
    at_shoulder = smoothed(at_shoulder, mean, _SHOULDER_PASSES)
    weights = _relieve_flanks(at_shoulder * soft + (1 - at_shoulder) * usual)
    return _sparse_symmetric(smoothed(weights, mean, 1), topology.mirror)


def _relieve_flanks(weights: Array) -> Array:
    """Moves weight from the arms to the spine where both pull at a vertex, which is only below the shoulder."""
    weights = weights.copy()
    spine = [JOINT_INDEX[name] for name in ("pelvis", "spine1", "spine2", "spine3")]
    for name in ("l_shoulder", "r_shoulder"):
        arm, trunk = weights[:, JOINT_INDEX[name]].copy(), weights[:, spine].sum(1)
        both = trunk > 1e-9
        total = arm[both] + trunk[both]
        less = total * (arm[both] / total) ** _FLANK_POWER
        weights[both, JOINT_INDEX[name]] = less
        weights[np.ix_(both, spine)] *= ((total - less) / trunk[both])[:, None]
    return weights


def _sparse_symmetric(weights: Array, mirror: NDArray[np.int64]) -> Array:
    weights = (weights + weights[mirror][:, _LR]) / 2
    weights[weights < _MIN_WEIGHT] = 0
    for vertex in np.flatnonzero(np.arange(len(mirror)) <= mirror):
        row = weights[vertex]
        # Pairs of limbs tie on the midline, where both of a pair go or stay. Rounding keeps ties equal.
        on_midline = mirror[vertex] == vertex
        ranks = np.argsort(-np.round(row + (row[_LR] if on_midline else 0), 9), kind="stable")
        cut = ranks[_MAX_JOINTS:]
        row[np.union1d(cut, np.array(_LR)[cut]) if on_midline else cut] = 0
        row /= row.sum()
        weights[mirror[vertex]] = (row + row[_LR]) / 2 if on_midline else row[_LR]
    return weights


def joint_transforms(rotmats: Array, joints: Array) -> tuple[Array, Array]:
    """How each joint moves what is fixed to it: rotations `(24, 3, 3)` and translations `(24, 3)`; x goes to R x + t.

    From rotations `(24, 3, 3)` relative to the parent and rest positions `(24, 3)`, metres.
    """
    rotations, positions = np.empty((NUM_JOINTS, 3, 3)), np.empty((NUM_JOINTS, 3))
    for joint, parent in enumerate(PARENTS):
        if parent < 0:
            rotations[joint], positions[joint] = rotmats[joint], joints[joint]
        else:
            rotations[joint] = rotations[parent] @ rotmats[joint]
            positions[joint] = positions[parent] + rotations[parent] @ (joints[joint] - joints[parent])
    return rotations, positions - np.einsum("jab,jb->ja", rotations, joints)


def blend_linear(weights: Array, rotations: Array, translations: Array) -> tuple[Array, Array]:
    """Linear blend skinning: each vertex's mean matrix `(V, 3, 3)` and translation `(V, 3)`."""
    return (weights @ rotations.reshape(-1, 9)).reshape(-1, 3, 3), weights @ translations


def blend_dual_quaternions(weights: Array, rotations: Array, translations: Array) -> tuple[Array, Array]:
    """Dual-quaternion skinning (Kavan et al. 2007): each vertex's rotation `(V, 3, 3)` and translation `(V, 3)`."""
    real = _quaternions(rotations)
    for joint, parent in enumerate(PARENTS):
        # q and -q are one rotation; neighbours must take the nearer ones, or the mean goes the long way round.
        if parent >= 0 and real[joint] @ real[parent] < 0:
            real[joint] = -real[joint]
    dual = _times(np.pad(translations, ((0, 0), (1, 0))), real) / 2
    blended, shift = weights @ real, weights @ dual
    norm = np.linalg.norm(blended, axis=1, keepdims=True)
    blended /= norm
    shift /= norm
    conjugate = blended * [1.0, -1.0, -1.0, -1.0]
    return _matrices(blended), 2 * _times(shift, conjugate)[:, 1:]


def apply(transform: tuple[Array, Array], vertices: Array) -> Array:
    """R x + t for each vertex: `(V, 3, 3)` and `(V, 3)` on `(V, 3)`."""
    return np.einsum("vab,vb->va", transform[0], vertices) + transform[1]


def apply_inverse(transform: tuple[Array, Array], vertices: Array) -> Array:
    """The x of which R x + t is `vertices`."""
    solved = np.linalg.solve(transform[0], (vertices - transform[1])[..., None])
    return np.asarray(solved[..., 0], dtype=np.float64)


def to_tpose(vertices: Array, joints: Array, weights: Array) -> tuple[Array, Array]:
    """Vertices `(V, 3)` and joints `(24, 3)`, metres, from MakeHuman's rest pose (arms at 45 degrees) in the T-pose.

    It is the T-pose that dual-quaternion skinning carries exactly onto the sculpted body.
    """
    rotations = _tpose_rotations(joints)
    moved = joints.copy()
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            moved[joint] = moved[parent] + rotations[parent] @ (joints[joint] - joints[parent])
    back = rotations.swapaxes(1, 2)
    transform = blend_dual_quaternions(weights, back, joints - np.einsum("jab,jb->ja", back, moved))
    return apply_inverse(transform, vertices), moved


def _tpose_rotations(joints: Array) -> Array:
    """World rotations `(24, 3, 3)` from MakeHuman's rest pose to the T-pose: arms along x, legs nearly down."""
    place = JOINT_INDEX
    rotations = np.tile(np.eye(3), (NUM_JOINTS, 1, 1))
    upper = _unit(joints[place["l_elbow"]] - joints[place["l_shoulder"]])
    lower = _unit(joints[place["l_wrist"]] - joints[place["l_elbow"]])
    hinge = _unit(np.cross(upper, lower))
    # The arm goes to +x and the elbow's axis to -y, so that the elbow bends forward about y.
    target = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    forearm = target.T @ np.stack([lower, hinge, np.cross(lower, hinge)])
    leg = joints[place["l_ankle"]] - joints[place["l_hip"]]
    thigh = _about_z(np.radians(_LEG_DEGREES) - np.arctan2(leg[0], -leg[1]))
    left = {
        "l_collar": _about_z(np.radians(_COLLAR_DEGREES)),
        "l_shoulder": target.T @ np.stack([upper, hinge, np.cross(upper, hinge)]),
        **dict.fromkeys(("l_elbow", "l_wrist", "l_hand"), forearm),
        **dict.fromkeys(("l_hip", "l_knee", "l_ankle", "l_foot"), thigh),
    }
    flip = np.diag([-1.0, 1, 1])
    for name, rotation in left.items():
        rotations[place[name]] = rotation
        rotations[MIRROR[place[name]]] = flip @ rotation @ flip
    return rotations


def _about_z(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)


def _quaternions(rotations: Array) -> Array:
    """`(..., 4)`, real part first, of rotation matrices `(..., 3, 3)`."""
    m = rotations
    # 4 q q^T; the row of the largest component is far from zero.
    products = np.empty((*m.shape[:-2], 4, 4))
    trace = np.trace(m, axis1=-2, axis2=-1)
    products[..., 0, 0] = 1 + trace
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        products[..., i + 1, i + 1] = 1 - trace + 2 * m[..., i, i]
        products[..., 0, i + 1] = products[..., i + 1, 0] = m[..., k, j] - m[..., j, k]
        products[..., j + 1, k + 1] = products[..., k + 1, j + 1] = m[..., j, k] + m[..., k, j]
    largest = np.diagonal(products, axis1=-2, axis2=-1).argmax(-1)
    rows = np.take_along_axis(products, largest[..., None, None], axis=-2)[..., 0, :]
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


def _matrices(quaternions: Array) -> Array:
    w, vector = quaternions[..., 0, None, None], quaternions[..., 1:]
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*x.shape, 3, 3)
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def _times(a: Array, b: Array) -> Array:
    """Hamilton's product of quaternions, real part first."""
    real = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(-1, keepdims=True)
    imaginary = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    return np.concatenate([real, imaginary], -1)
