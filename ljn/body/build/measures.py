"""What is measured of a body: population, chest, self-intersections, and volume in extreme poses."""

import numba
import numpy as np
import torch
from numpy.typing import NDArray

from ljn.body.build.poses import EXTREME_POSES, pose_vector
from ljn.body.build.surface import edges, face_normals, volume
from ljn.body.files import NUM_BETAS, BodyModel
from ljn.body.smpl import SMPL

Array = NDArray[np.float64]
Index = NDArray[np.int64]

DENSITY = 985.0
"""Kilograms a cubic metre of a living body with air in its lungs."""


def stature_and_bmi(bodies: Array, faces: Index) -> tuple[Array, Array]:
    """Statures `(n,)` in metres and body mass indices `(n,)` of T-posed bodies `(n, V, 3)`."""
    stature = np.ptp(bodies[..., 1], axis=-1)
    return stature, volume(bodies, faces) * DENSITY / stature**2


def shaped(model: BodyModel, betas: Array) -> Array:
    """T-posed bodies `(n, V, 3)`, metres, of betas `(n, 10)`."""
    return model.v_template + np.einsum("vdk,nk->nvd", model.shapedirs.astype(np.float64), betas)


def posed(model: BodyModel, pose: Array, betas: Array | None = None) -> Array:
    """The body `(V, 3)`, metres, SMPL's rest frame, in a pose `(72,)`, with betas `(10,)`."""
    shape = np.zeros(NUM_BETAS) if betas is None else betas
    return SMPL(model).double()(torch.from_numpy(pose), torch.from_numpy(shape)).vertices.numpy()


def chest_bulge(bodies: Array, faces: Index) -> Array:
    """How far the breasts stand out before the breast bone, `(n,)` metres, of T-posed bodies `(n, V, 3)`.

    Both are looked for on the first body at 71.5 % of its stature, the breast at a twentieth of it to the left.
    """
    first = bodies[0]
    normals = face_normals(first, faces)
    faces_front = faces[normals[:, 2] > 0.5 * np.linalg.norm(normals, axis=1)]
    front = np.unique(faces_front)
    stature = np.ptp(first[:, 1])
    height = first[:, 1].min() + 0.715 * stature
    depths = []
    for side in (0.05 * stature, 0.0):
        distance = np.hypot(first[front, 0] - side, first[front, 1] - height)
        depths.append(bodies[:, front[np.argsort(distance, kind="stable")[:6]], 2].mean(1))
    return depths[0] - depths[1]


def crossing_faces(vertices: Array, faces: Index) -> NDArray[np.bool_]:
    """`(F,)`: which faces of a mesh `(V, 3)` pass through another one that they share no vertex with."""
    corners = np.ascontiguousarray(vertices, dtype=np.float64)[faces]
    low, high = corners.min(1), corners.max(1)
    hit = np.zeros(len(faces), dtype=np.bool_)
    order = np.argsort(low[:, 1], kind="stable")
    _sweep(corners, np.ascontiguousarray(faces), order, low, high, face_normals(vertices, faces), hit)
    return hit


@numba.njit(cache=True)
def _sweep(
    corners: Array,
    faces: Index,
    order: Index,
    low: Array,
    high: Array,
    normals: Array,
    hit: NDArray[np.bool_],
) -> None:
    for place in range(len(order)):
        i = order[place]
        for other in range(place + 1, len(order)):
            j = order[other]
            if low[j, 1] > high[i, 1]:
                break
            if (hit[i] and hit[j]) or low[j, 0] > high[i, 0] or high[j, 0] < low[i, 0]:
                continue
            if low[j, 2] > high[i, 2] or high[j, 2] < low[i, 2]:
                continue
            is_neighbour = False
            for a in faces[i]:
                for b in faces[j]:
                    is_neighbour |= a == b
            if is_neighbour:
                continue
            for k in range(3):
                if _pierces(corners[i, k], corners[i, (k + 1) % 3], corners[j], normals[j]) or _pierces(
                    corners[j, k], corners[j, (k + 1) % 3], corners[i], normals[i]
                ):
                    hit[i] = hit[j] = True
                    break


@numba.njit(cache=True)
def _pierces(start: Array, end: Array, triangle: Array, normal: Array) -> bool:
    """Whether the segment goes through the triangle's inside."""
    before, after = 0.0, 0.0
    for d in range(3):
        before += (start[d] - triangle[0, d]) * normal[d]
        after += (end[d] - triangle[0, d]) * normal[d]
    if before * after >= 0:
        return False
    t = before / (before - after)
    for k in range(3):
        a, b = triangle[k], triangle[(k + 1) % 3]
        side = 0.0
        for d in range(3):
            e, g = (d + 1) % 3, (d + 2) % 3
            point_e = start[e] + t * (end[e] - start[e]) - a[e]
            point_g = start[g] + t * (end[g] - start[g]) - a[g]
            side += ((b[e] - a[e]) * point_g - (b[g] - a[g]) * point_e) * normal[d]
        if side <= 0:
            return False
    return True


def pose_measures(model: BodyModel, vertices: Array) -> dict[str, float]:
    """How a pose changes the mean body: `vertices` `(V, 3)` is that body posed.

    The change of volume, and the edges that shrink below half or stretch beyond 1.7 times their length, in percent; and
    the number of faces that pass through others.
    """
    rest, pairs = model.v_template.astype(np.float64), edges(model.faces)
    lengths, rest_lengths = (np.linalg.norm(np.subtract(*body[pairs.T]), axis=1) for body in (vertices, rest))
    ratio = lengths / rest_lengths
    return {
        "volume": 100 * float(volume(vertices, model.faces) / volume(rest, model.faces) - 1),
        "squeezed": 100 * float((ratio < 0.5).mean()),
        "stretched": 100 * float((ratio > 1.7).mean()),
        "crossing": int(crossing_faces(vertices, model.faces).sum()),
    }


def report(model: BodyModel, num_draws: int = 200, seed: int = 1) -> str:
    """The measurements of a body and of random shapes of it, beta ~ N(0, 1), as lines of text."""
    betas = np.random.default_rng(seed).normal(size=(num_draws, NUM_BETAS))
    bodies = shaped(model, betas)
    mean_stature, mean_bmi = stature_and_bmi(model.v_template.astype(np.float64), model.faces)
    stature, bmi = stature_and_bmi(bodies, model.faces)
    bulge = 1000 * chest_bulge(np.concatenate([model.v_template[None], bodies]), model.faces)
    crossing = np.array([crossing_faces(body, model.faces).sum() for body in bodies])
    lines = [
        f"{model.gender}: hash {model.hash}",
        f"  mean body: stature {mean_stature:.3f} m, BMI {mean_bmi:.1f}",
        f"  {num_draws} draws: stature {_spread(stature, 3)} m, BMI {_spread(bmi, 1)}",
        f"  chest, breast before breast bone: mean body {bulge[0]:.0f} mm, draws {_spread(bulge[1:], 0)} mm",
        f"  faces that cross others in the T-pose: draws {_spread(crossing, 0)} of {len(model.faces)}",
        f"  {'pose':26s} volume  edges < 0.5  > 1.7  crossing faces",
    ]
    for name, angles in EXTREME_POSES.items():
        row = pose_measures(model, posed(model, pose_vector(angles)))
        lines.append(
            f"  {name:26s} {row['volume']:+5.1f} %  {row['squeezed']:8.2f} % {row['stretched']:5.2f} % "
            f"{row['crossing']:10.0f}"
        )
    return "\n".join(lines)


def _spread(values: Array, digits: int) -> str:
    mean, deviation, low, high = (
        f"{value:.{digits}f}" for value in (values.mean(), values.std(), values.min(), values.max())
    )
    return f"{mean} +- {deviation} ({low} to {high})"
