import numpy as np
import pytest

from ljn.body import GENDERS, SMPL, BodyModel, load_body_model, load_body_models
from ljn.body.parts import PART_NAMES, PART_OF_JOINT, face_parts
from ljn.body.skeleton import JOINT_NAMES, MIRROR

LR = list(MIRROR)
FLIP = np.array([-1, 1, 1])


@pytest.fixture(scope="module", params=sorted(GENDERS))
def model(request):
    return load_body_model(gender=request.param)


@pytest.fixture(scope="module")
def mirror():
    """The mirror partner of each vertex, found on the neutral template."""
    vertices = load_body_model().v_template
    index = {tuple(vertex): number for number, vertex in enumerate((vertices + 0.0).tolist())}
    assert len(index) == len(vertices)
    return np.array([index[tuple(vertex)] for vertex in (vertices * FLIP + 0.0).tolist()])


def directed_edges(faces):
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def volumes(bodies, faces):
    a, b, c = (bodies[:, faces[:, corner]].astype(float) for corner in range(3))
    return (a * np.cross(b, c)).sum((1, 2)) / 6


def draws(model, count=200):
    betas = np.random.default_rng(11).normal(size=(count, 10))
    return model.v_template + np.einsum("vdk,nk->nvd", model.shapedirs.astype(float), betas)


def test_the_mesh_is_a_closed_surface_of_genus_0_with_smpls_counts(model):
    assert (len(model.v_template), len(model.faces)) == (6890, 13776)
    edges = directed_edges(model.faces)
    keys, back = edges[:, 0] * 6890 + edges[:, 1], edges[:, 1] * 6890 + edges[:, 0]
    assert len(np.unique(keys)) == len(keys), "an edge runs in one direction twice"
    assert np.array_equal(np.sort(keys), np.sort(back)), "an edge has only one face"
    assert len(np.unique(model.faces)) - len(keys) // 2 + len(model.faces) == 2
    assert volumes(model.v_template[None], model.faces)[0] > 0.04


def test_left_and_right_are_exact_mirror_images(model, mirror):
    assert np.array_equal(mirror[mirror], np.arange(6890))
    assert np.array_equal(model.v_template[mirror], model.v_template * FLIP)
    assert np.array_equal(model.shapedirs[mirror], model.shapedirs * FLIP[:, None])
    assert np.array_equal(model.weights[mirror][:, LR], model.weights)
    assert np.array_equal(model.J_regressor[LR][:, mirror], model.J_regressor)
    assert np.array_equal(mirror[model.faces[:6888]][:, ::-1], model.faces[6888:])
    posedirs = model.posedirs.reshape(6890, 3, 23, 3, 3)
    pairs = [joint - 1 for joint in LR[1:]]
    flipped = posedirs[mirror][:, :, pairs] * FLIP[:, None, None, None] * FLIP[:, None] * FLIP
    assert np.array_equal(flipped, posedirs)


def test_all_genders_share_faces_and_weights_and_fit_in_one_layer():
    bodies = load_body_models(None, list(GENDERS))
    assert SMPL(bodies).genders == tuple(GENDERS)  # of the same faces
    assert len({body.hash for body in bodies}) == 3
    assert all(np.array_equal(body.weights, bodies[0].weights) for body in bodies)


def test_weights_and_regressor_are_sparse_means(model):
    for array, most in ((model.weights, 4), (model.J_regressor, 100)):
        assert array.min() >= 0
        assert (array > 0).sum(1).max() <= most
        np.testing.assert_allclose(array.sum(1, dtype=float), 1, atol=1e-6)


def test_no_face_of_the_t_pose_is_degenerate(model):
    a, b, c = (model.v_template[model.faces[:, corner]].astype(float) for corner in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    longest = np.maximum.reduce([np.linalg.norm(x - y, axis=1) for x, y in ((a, b), (b, c), (c, a))])
    assert area.min() > 1e-8
    assert (2 * area / longest**2).min() > 0.005


STATURE = {"female": (1.60, 1.66), "male": (1.72, 1.78), "neutral": (1.66, 1.72)}


def test_mean_and_random_bodies_have_the_stature_and_bmi_of_adults(model):
    low, high = STATURE[model.gender]
    bodies = np.concatenate([model.v_template[None], draws(model)])
    stature = np.ptp(bodies[..., 1], axis=1)
    bmi = volumes(bodies, model.faces) * 985 / stature**2
    assert low < stature[0] < high
    assert 22 < bmi[0] < 25
    assert 0.07 < stature[1:].std() < 0.11
    assert 1.3 < stature.min() < stature.max() < 2.15
    assert 3 < bmi[1:].std() < 5
    assert 12 < bmi.min() < bmi.max() < 42


def test_beta_0_is_the_stature_and_makes_bodies_taller(model):
    vertices, components = model.v_template, model.shapedirs
    growth = components[vertices[:, 1].argmax(), 1] - components[vertices[:, 1].argmin(), 1]
    assert growth[0] > 0.07
    assert np.abs(growth).argmax() == 0
    assert np.square(components).sum((0, 1)).argmax() == 0


def test_no_chest_of_a_random_body_is_caved_in(model):
    """The breasts of a draw lie at most a centimetre behind the breast bone, as flat chests do."""
    from ljn.body.build.measures import chest_bulge

    bulge = chest_bulge(np.concatenate([model.v_template[None], draws(model)]), model.faces)
    assert bulge.min() > -0.01


def test_rest_joints_lie_inside_the_body_in_a_t_pose(model):
    joints = dict(zip(JOINT_NAMES, model.J_regressor @ model.v_template))
    arm = [joints[f"l_{name}"] for name in ("shoulder", "elbow", "wrist")]
    assert np.ptp([joint[1] for joint in arm]) < 0.01
    assert arm[0][0] < arm[1][0] < arm[2][0]
    height = [joints[name][1] for name in ("l_foot", "l_ankle", "l_knee", "l_hip", "pelvis")]
    height += [joints[name][1] for name in ("spine1", "spine2", "spine3", "neck", "head")]
    assert (np.diff(height) > 0.01).all()


def test_every_part_is_one_patch_and_the_sides_mirror_each_other(model):
    labels = face_parts(model)
    assert set(labels.tolist()) == set(range(len(PART_NAMES)))
    swapped = [
        PART_NAMES.index({"l_": "r_", "r_": "l_"}.get(name[:2], name[:2]) + name[2:]) for name in PART_NAMES
    ]
    assert np.array_equal(np.array(swapped)[labels[:6888]], labels[6888:])
    for part in range(len(PART_NAMES)):
        faces = model.faces[labels == part]
        group = {vertex: vertex for vertex in np.unique(faces).tolist()}

        def root(vertex, group=group):
            while group[vertex] != vertex:
                vertex = group[vertex]
            return vertex

        for a, b, c in faces.tolist():
            group[root(a)] = group[root(b)] = root(c)
        assert len({root(vertex) for vertex in group}) == 1, PART_NAMES[part]


def test_parts_lie_around_their_joints(model):
    labels = face_parts(model)
    centres = model.v_template[model.faces].mean(1)
    joints = model.J_regressor @ model.v_template
    for joint, part in enumerate(PART_OF_JOINT):
        nearest = np.linalg.norm(centres[labels == part] - joints[joint], axis=1).min()
        assert nearest < 0.12, (JOINT_NAMES[joint], PART_NAMES[part])


def test_stray_patches_join_the_part_around_them():
    model = load_body_model()
    weights = model.weights.copy()
    outermost = model.faces[model.v_template[model.faces].mean(1)[:, 0].argmax(), 0]
    ring = np.unique(model.faces[(model.faces == outermost).any(1)])
    weights[ring] = np.eye(24)[JOINT_NAMES.index("head")]
    arrays = (model.v_template, model.shapedirs, model.posedirs, model.J_regressor)
    spoilt = BodyModel(*arrays, weights, model.faces)
    assert np.array_equal(face_parts(spoilt), face_parts(model))
