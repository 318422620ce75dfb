"""From MakeHuman's files to bodies in SMPL's format: the order of the steps."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ljn.body.build.adults import average_adult, sample_adults
from ljn.body.build.correctives import fit_posedirs, mirrored_from_left
from ljn.body.build.makehuman import MakeHuman
from ljn.body.build.regressor import fit_regressor
from ljn.body.build.shapes import fit_betas, fit_shapes
from ljn.body.build.skinning import clean_weights, to_tpose
from ljn.body.build.surface import vertex_areas
from ljn.body.build.topology import Topology, decimate_symmetric, mirror_vertices, symmetrised
from ljn.body.skeleton import MIRROR, NUM_JOINTS, PARENTS, ROOT

Array = NDArray[np.float64]

NUM_FACES = 13_776
"""SMPL's; genus 0 gives SMPL's 6890 vertices with it."""

_ROOT_HEIGHT = -0.23
"""Metres: the mean body's pelvis below the origin, as in SMPL's files."""
_TRAIN_SHARE = 0.8
_SHAPE_STEP = 2.0**-20
_POSE_STEP = 2.0**-15
"""Metres: coordinates and offsets are rounded to multiples of these, for smaller files. The second is exact in
half precision up to 62 mm."""


@dataclass(frozen=True)
class Source:
    """What all bodies share."""

    makehuman: MakeHuman
    topology: Topology  # the decimated mesh, of indices into `rows`
    rows: NDArray[np.int64]  # `(V,)`, the mesh's vertices among all of MakeHuman's
    weights: Array  # `(V, 24)`, skinning weights


def read_source(folder: Path) -> Source:
    """MakeHuman's data below `folder`, with the mesh that all bodies share, decimated in one reference shape."""
    makehuman = MakeHuman.read(folder)
    ids = makehuman.body_ids
    partner = mirror_vertices(makehuman.vertices[ids])
    reference = symmetrised(makehuman.shapes(average_adult(), ids)[0][0], partner)
    place = np.full(len(makehuman.vertices), -1)
    place[ids] = np.arange(len(ids))
    polygons = [place[polygon].tolist() for polygon in makehuman.body_faces]
    topology = decimate_symmetric(reference, polygons, NUM_FACES)
    rows = ids[topology.kept]
    weights = clean_weights(makehuman.weights[rows], topology)
    return Source(makehuman, topology, rows, weights)


def build_body(
    source: Source, gender: str, seed: int = 0, count: int = 600, log: Callable[[str], None] = print
) -> dict[str, NDArray[np.generic]]:
    """The arrays of one body file in SMPL's format, exactly left-right symmetric.

    Of `count` sampled adults, four in five are fitted; the others measure the fit, in lines for `log`.
    """
    topology, weights = source.topology, source.weights
    mirror, faces = topology.mirror, topology.faces
    rng = np.random.default_rng(seed)
    vertices, cubes = source.makehuman.shapes(sample_adults(rng, count, gender), source.rows)
    vertices = symmetrised(vertices, mirror)
    train = round(_TRAIN_SHARE * count)

    # The cubes wander inside the body from adult to adult; the regressor keeps what the skin tells of them.
    rough = fit_regressor(vertices[:train], cubes[:train], weights, mirror)
    joints = np.einsum("jv,nvd->njd", rough, vertices, optimize=True)
    for body, skeleton in zip(vertices, joints):
        body[:], skeleton[:] = to_tpose(body, skeleton, weights)
    vertices, joints = symmetrised(vertices, mirror), symmetrised(joints, np.array(MIRROR))

    centre = np.einsum("v,nvd->nd", vertex_areas(vertices.mean(0), faces), vertices)
    centre /= vertex_areas(vertices.mean(0), faces).sum()
    centre[:, 0] = 0
    centre += joints[:, ROOT].mean(0) - centre.mean(0) - [0, _ROOT_HEIGHT, 0]
    vertices, joints = vertices - centre[:, None], joints - centre[:, None]

    mean, components = fit_shapes(vertices[:train], faces, mirror)
    regressor = fit_regressor(vertices[:train], joints[:train], weights, mirror)
    posedirs = fit_posedirs(mean, weights, regressor @ mean, topology, rng)
    _log_fit(log, gender, vertices[train:], joints[train:], mean, components, regressor, source)

    posedirs = mirrored_from_left(np.round(posedirs / _POSE_STEP) * _POSE_STEP, topology)
    return {
        "v_template": (np.round(mean / _SHAPE_STEP) * _SHAPE_STEP).astype(np.float32),
        "shapedirs": (np.round(components / _SHAPE_STEP) * _SHAPE_STEP).astype(np.float32),
        "posedirs": posedirs.astype(np.float16),
        "J_regressor": regressor.astype(np.float32),
        "weights": weights.astype(np.float32),
        "kintree_table": np.array([[2**32 - 1, *PARENTS[1:]], range(NUM_JOINTS)], dtype=np.uint32),
        "f": faces.astype(np.uint32),
    }


def _log_fit(
    log: Callable[[str], None],
    gender: str,
    bodies: Array,
    joints: Array,
    mean: Array,
    components: Array,
    regressor: Array,
    source: Source,
) -> None:
    """Errors on adults that nothing was fitted to."""
    betas = fit_betas(bodies, mean, components, source.topology.faces)
    fitted = mean + np.einsum("vdk,nk->nvd", components, betas)
    error = 1000 * np.linalg.norm(fitted - bodies, axis=-1)
    mean_distance = 1000 * float(np.linalg.norm(bodies - mean, axis=-1).mean())
    joint_error = 1000 * np.linalg.norm(np.einsum("jv,nvd->njd", regressor, bodies) - joints, axis=-1)
    log(
        f"{gender}, {len(bodies)} adults held out: 10 betas {error.mean():.2f} mm from the surface (95 %: "
        f"{np.percentile(error, 95):.1f} mm; the mean body {mean_distance:.1f} mm), joint regressor "
        f"{joint_error.mean():.2f} mm from the joints (worst {joint_error.mean(0).max():.2f} mm), "
        f"{(regressor > 0).sum() / NUM_JOINTS:.0f} vertices a joint"
    )


def save_body(arrays: dict[str, NDArray[np.generic]], path: Path) -> None:
    """Writes a body file; the same arrays always make the same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]
