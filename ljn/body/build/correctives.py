"""Pose correctives: offsets, linear in the joints' rotations, that make linear skinning look like better skinning.

Linear skinning flattens the buttocks of a sitting body and pinches bent elbows; dual-quaternion skinning keeps
their volume but blows up raised shoulders, where smoothing the result as delta mush does (Mancewicz et al. 2014)
comes closest to a shoulder. The target is a mixture by region; the posedirs are its best linear fit.
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ljn.body.build.skinning import (
    apply,
    apply_inverse,
    blend_dual_quaternions,
    blend_linear,
    joint_transforms,
)
from ljn.body.build.surface import face_normals, neighbour_mean, smoothed
from ljn.body.build.topology import Topology
from ljn.body.skeleton import JOINT_NAMES, MIRROR, NUM_JOINTS, PARENTS

Array = NDArray[np.float64]

_DUAL_QUATERNION_SHARE = {
    "collar": 0.2,
    "shoulder": 0.2,
    "elbow": 0.7,
    "wrist": 0.7,
    "hand": 0.7,
    "neck": 0.6,
}
"""Share of dual-quaternion skinning in the target around a joint, the rest is linear; 1 for joints not named."""
_MUSH_SHARE = {"collar": 1.0, "shoulder": 1.0, "spine3": 1.0}
"""How far the target is smoothed around a joint; 0 for joints not named."""
_MUSH_PASSES = 15
_RIDGE = 1.5e-3
_PASSES = 3
"""Of smoothing the fitted offsets over the surface."""
_SMALLEST = 5e-5
"""Metres for a unit of R - I: smaller offsets are left out."""

_LIMITS: dict[str, tuple[float, float, float, float, float, float]] = {
    "hip": (-120, 30, -45, 45, -20, 50),
    "knee": (0, 145, -10, 10, -5, 5),
    "ankle": (-30, 45, -20, 20, -20, 20),
    "foot": (-30, 30, -5, 5, -5, 5),
    "spine1": (-15, 30, -20, 20, -15, 15),
    "spine2": (-15, 30, -20, 20, -15, 15),
    "spine3": (-15, 25, -20, 20, -15, 15),
    "neck": (-30, 35, -40, 40, -25, 25),
    "head": (-30, 30, -40, 40, -20, 20),
    "collar": (-10, 10, -15, 15, -15, 25),
    "shoulder": (-70, 70, -110, 25, -80, 85),
    "elbow": (-70, 70, -145, 5, -10, 10),
    "wrist": (-60, 60, -25, 25, -65, 65),
    "hand": (-10, 10, -10, 10, -30, 30),
}
"""Least and greatest Euler angles x, y, z in degrees, left side, within which the fit's poses lie."""
_LR = list(MIRROR)


def random_rotations(rng: np.random.Generator, count: int) -> Array:
    """Poses `(count, 24, 3, 3)` within the joints' limits: half spread evenly, half nearer to the T-pose."""
    rotmats = np.tile(np.eye(3), (count, NUM_JOINTS, 1, 1))
    scale = np.where(np.arange(count)[:, None] < count // 2, 1.0, rng.beta(1, 2, (count, 1)))
    for joint, name in enumerate(JOINT_NAMES[1:], start=1):
        low, high = np.array(_LIMITS[name.rpartition("_")[2]]).reshape(3, 2).T
        angles = np.radians(rng.uniform(low, high, (count, 3)) * scale)
        if name.startswith("r_"):
            angles[:, 1:] *= -1
        rotmats[:, joint] = _from_euler(angles)
    return rotmats


def _from_euler(angles: Array) -> Array:
    """Rz Ry Rx `(n, 3, 3)` of radians `(n, 3)`."""
    result = np.eye(3)
    for axis, angle in enumerate(angles.T):
        turn = np.tile(np.eye(3), (len(angle), 1, 1))
        j, k = (axis + 1) % 3, (axis + 2) % 3
        turn[:, j, j] = turn[:, k, k] = np.cos(angle)
        turn[:, k, j], turn[:, j, k] = np.sin(angle), -np.sin(angle)
        result = turn @ result
    return result


class DeltaMush:
    """Smooths a posed mesh and gives it back the rest mesh's detail, in frames that turn with the surface."""

    def __init__(self, rest: Array, topology: Topology, passes: int) -> None:
        """Builds it for a rest mesh `(V, 3)`, metres."""
        self._faces, self._passes = topology.faces, passes
        self._mean = neighbour_mean(topology.faces, rest)
        base = smoothed(rest, self._mean, passes)
        self._neighbour = self._farthest_neighbours(base)
        self._detail = np.einsum("vij,vi->vj", self._frames(base), rest - base)

    def __call__(self, vertices: Array) -> Array:
        """The smoothed mesh `(V, 3)` of a posed one."""
        base = smoothed(vertices, self._mean, self._passes)
        return base + np.einsum("vij,vj->vi", self._frames(base), self._detail)

    def _farthest_neighbours(self, vertices: Array) -> NDArray[np.int64]:
        pointers, columns = self._mean.indptr, self._mean.indices
        lengths = np.linalg.norm(vertices[columns] - np.repeat(vertices, np.diff(pointers), axis=0), axis=1)
        return np.array(
            [columns[a:b][lengths[a:b].argmax()] for a, b in pairwise(pointers.tolist())], dtype=np.int64
        )

    def _frames(self, vertices: Array) -> Array:
        corners, parts = self._faces.ravel(), face_normals(vertices, self._faces).T
        sums = [np.bincount(corners, np.repeat(part, 3), minlength=len(vertices)) for part in parts]
        normals: Array = np.stack(sums, axis=-1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        tangents = vertices[self._neighbour] - vertices
        tangents -= (tangents * normals).sum(1, keepdims=True) * normals
        tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
        return np.stack([tangents, normals, np.cross(tangents, normals)], axis=-1)


def target_skinning(
    template: Array, weights: Array, joints: Array, topology: Topology
) -> Callable[[Array], tuple[Array, tuple[Array, Array]]]:
    """The skinning that the correctives imitate, of a template `(V, 3)` in T-pose and joints `(24, 3)`, metres.

    Returns:
        A function of relative rotations `(24, 3, 3)`: the posed vertices `(V, 3)`, and linear skinning's
        transforms for the same pose.
    """
    share = weights @ _by_joint(_DUAL_QUATERNION_SHARE, otherwise=1.0)
    mush_share = weights @ _by_joint(_MUSH_SHARE, otherwise=0.0)
    mush = DeltaMush(template, topology, _MUSH_PASSES)

    def skin(rotmats: Array) -> tuple[Array, tuple[Array, Array]]:
        transforms = joint_transforms(rotmats, joints)
        linear = blend_linear(weights, *transforms)
        dual = apply(blend_dual_quaternions(weights, *transforms), template)
        mixed = share[:, None] * dual + (1 - share[:, None]) * apply(linear, template)
        return mixed + mush_share[:, None] * (mush(mixed) - mixed), linear

    return skin


def fit_posedirs(
    template: Array,
    weights: Array,
    joints: Array,
    topology: Topology,
    rng: np.random.Generator,
    count: int = 500,
) -> Array:
    """Offsets that bring linear skinning nearest to `target_skinning` over random poses, exactly symmetric.

    `(V, 3, 207)`, metres for a unit of each entry of R_1 - I ... R_23 - I.
    """
    skin = target_skinning(template, weights, joints, topology)
    left = np.flatnonzero(np.arange(len(template)) <= topology.mirror)
    poses = random_rotations(rng, count)
    offsets = np.empty((count, len(left), 3))
    for pose, offset in zip(poses, offsets):
        target, (matrices, shifts) = skin(pose)
        offset[:] = apply_inverse((matrices[left], shifts[left]), target[left]) - template[left]

    features = (poses[:, 1:] - np.eye(3)).reshape(count, NUM_JOINTS - 1, 9)
    active = _active_joints(weights, topology)[left]
    posedirs = np.zeros((len(template), 3, NUM_JOINTS - 1, 9))
    for pattern in np.unique(active, axis=0):
        members, chosen = np.flatnonzero((active == pattern).all(1)), np.flatnonzero(pattern)
        if not len(chosen):
            continue
        x = features[:, chosen - 1].reshape(count, -1)
        y = offsets[:, members].reshape(count, -1)
        solution = np.linalg.solve(x.T @ x + _RIDGE * count * np.eye(x.shape[1]), x.T @ y)
        solution = solution.reshape(len(chosen), 9, len(members), 3).transpose(2, 3, 0, 1)
        posedirs[left[members][:, None], :, chosen - 1] = solution.swapaxes(1, 2)

    posedirs = mirrored_from_left(posedirs.reshape(len(template), 3, -1), topology)
    posedirs = smoothed(posedirs.reshape(len(template), -1), neighbour_mean(topology.faces), _PASSES)
    posedirs[np.abs(posedirs) < _SMALLEST] = 0
    return posedirs.reshape(len(template), 3, -1)


def mirrored_from_left(posedirs: Array, topology: Topology) -> Array:
    """Posedirs `(V, 3, 207)` whose right half is the left one's exact mirror image, and the midline its own."""
    flip = np.array([-1.0, 1.0, 1.0])
    joints = [joint - 1 for joint in _LR[1:]]
    shaped = posedirs.reshape(len(posedirs), 3, NUM_JOINTS - 1, 3, 3)
    image = shaped[topology.mirror][:, :, joints] * flip[:, None, None, None] * flip[:, None] * flip
    number = np.arange(len(posedirs))
    result = np.where((number < topology.mirror)[:, None, None, None, None], shaped, image)
    middle = number == topology.mirror
    result[middle] = (shaped[middle] + image[middle]) / 2
    return result.reshape(posedirs.shape)


def _active_joints(weights: Array, topology: Topology) -> NDArray[np.bool_]:
    """`(V, 24)`: whether turning a joint changes the shape around a vertex, rather than moving it as a whole."""
    below = weights.copy()
    for joint in range(NUM_JOINTS - 1, 0, -1):
        below[:, PARENTS[joint]] += below[:, joint]
    mush_share = weights @ _by_joint(_MUSH_SHARE, otherwise=0.0)
    spread = smoothed(below, neighbour_mean(topology.faces), _MUSH_PASSES)
    below = np.where(mush_share[:, None] > 0, spread, below)
    active = (below > 5e-3) & (below < 1 - 5e-3)
    active[:, 0] = False
    return active | active[topology.mirror][:, _LR]


def _by_joint(shares: dict[str, float], otherwise: float) -> Array:
    return np.array([shares.get(name.rpartition("_")[2], otherwise) for name in JOINT_NAMES])
