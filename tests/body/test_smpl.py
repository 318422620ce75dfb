import pickle

import numpy as np
import pytest
import torch

from ljn.body import GENDERS, SMPL, BodyModel, load_body_model
from ljn.body.skeleton import NUM_JOINTS, PARENTS
from ljn.geometry.rotations import rotvec_to_rotmat

DTYPE = torch.float64


def tiny_body(gender="neutral", seed=0, num_vertices=9, faces=((0, 1, 2), (2, 3, 4))):
    rng = np.random.default_rng(seed)
    regressor, weights = rng.random((NUM_JOINTS, num_vertices)), rng.random((num_vertices, NUM_JOINTS))
    return BodyModel(
        v_template=rng.normal(size=(num_vertices, 3)),
        shapedirs=0.1 * rng.normal(size=(num_vertices, 3, 10)),
        posedirs=0.1 * rng.normal(size=(num_vertices, 3, 207)),
        J_regressor=regressor / regressor.sum(1, keepdims=True),
        weights=weights / weights.sum(1, keepdims=True),
        faces=np.array(faces),
        gender=gender,
    )


def draw(*batch, dtype=DTYPE, seed=0):
    generator = torch.Generator().manual_seed(seed)
    pose = 0.6 * torch.randn(*batch, 72, dtype=dtype, generator=generator)
    return pose, torch.randn(*batch, 10, dtype=dtype, generator=generator)


@pytest.fixture(scope="module")
def embedded():
    return load_body_model()


@pytest.fixture(scope="module")
def layer(embedded):
    return SMPL(embedded)


@pytest.fixture(scope="module", params=sorted(GENDERS))
def body_and_reference(request, tmp_path_factory):
    """An embedded body, and the same in the reference implementation, which reads only plain pickles."""
    smplx = pytest.importorskip("smplx", reason="smplx is not installed")
    sparse = pytest.importorskip("scipy.sparse", reason="SciPy is not installed")
    body = load_body_model(gender=request.param)
    fields = {
        "v_template": body.v_template,
        "shapedirs": body.shapedirs,
        "posedirs": body.posedirs,
        "J_regressor": sparse.csc_matrix(body.J_regressor),
        "weights": body.weights,
        "kintree_table": np.array([[2**32 - 1, *PARENTS[1:]], range(NUM_JOINTS)]),
        "f": body.faces.astype(np.uint32),
    }
    path = tmp_path_factory.mktemp("reference") / "body.pkl"
    path.write_bytes(pickle.dumps(fields))
    return body, smplx.SMPL(str(path), dtype=DTYPE)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-6)])
@pytest.mark.parametrize("scale", [0.3, 1.0, 3.0])
def test_vertices_and_joints_equal_smplx(body_and_reference, scale, dtype, tolerance):
    body, reference = body_and_reference
    pose, betas = draw(4)
    pose = scale * pose
    expected = reference(betas=betas, global_orient=pose[:, :3], body_pose=pose[:, 3:])
    output = SMPL(body).to(dtype)(pose.to(dtype), betas.to(dtype))
    torch.testing.assert_close(output.vertices.to(DTYPE), expected.vertices, atol=tolerance, rtol=0)
    torch.testing.assert_close(
        output.joints.to(DTYPE), expected.joints[:, :NUM_JOINTS], atol=tolerance, rtol=0
    )


def test_vertices_and_joints_equal_a_slow_loop():
    model = tiny_body()
    pose, betas = draw()
    rotmats = rotvec_to_rotmat(pose.view(NUM_JOINTS, 3)).numpy()
    shaped = model.v_template + model.shapedirs @ betas.numpy()
    rest_joints = model.J_regressor @ shaped
    unposed = shaped + model.posedirs @ (rotmats[1:] - np.eye(3)).ravel()
    joints, globals_, vertices = [], [], np.zeros_like(unposed)
    for joint, parent in enumerate(PARENTS):
        globals_.append(rotmats[joint] if parent < 0 else globals_[parent] @ rotmats[joint])
        offset = rest_joints[joint] - (rest_joints[parent] if parent >= 0 else 0)
        joints.append(offset if parent < 0 else joints[parent] + globals_[parent] @ offset)
        moved = (unposed - rest_joints[joint]) @ globals_[joint].T + joints[joint]
        vertices += model.weights[:, joint, None] * moved
    output = SMPL(model).double()(pose, betas)
    np.testing.assert_allclose(output.vertices, vertices, atol=1e-6)
    np.testing.assert_allclose(output.joints, np.array(joints), atol=1e-6)


def test_the_rest_pose_is_the_shaped_template_with_its_regressed_joints(embedded, layer):
    betas = draw(dtype=torch.float32)[1]
    shaped = embedded.v_template + embedded.shapedirs @ betas.numpy()
    output = layer(torch.zeros(72), betas)
    np.testing.assert_allclose(output.vertices, shaped, atol=2e-6)
    np.testing.assert_allclose(output.joints, embedded.J_regressor @ shaped, atol=2e-6)
    torch.testing.assert_close(layer.rest_joints(betas), output.joints, atol=1e-6, rtol=0)


@pytest.mark.parametrize("batch", [(), (1,), (5,), (2, 3), (2, 1, 2), (0,), (3, 0)])
def test_any_leading_shape_equals_sample_by_sample(batch):
    layer = SMPL([tiny_body("female", 1), tiny_body("male", 2)]).double()
    pose, betas = draw(*batch)
    gender = torch.randint(2, batch, generator=torch.Generator().manual_seed(3))
    output = layer(pose, betas, gender)
    assert output.vertices.shape == (*batch, 9, 3)
    assert output.joints.shape == layer.rest_joints(betas, gender).shape == (*batch, NUM_JOINTS, 3)
    assert output.vertices.is_contiguous()
    flat = output.vertices.reshape(-1, 9, 3), output.joints.reshape(-1, NUM_JOINTS, 3)
    for i, inputs in enumerate(zip(pose.reshape(-1, 72), betas.reshape(-1, 10), gender.reshape(-1))):
        single = layer(*inputs)
        torch.testing.assert_close(flat[0][i], single.vertices)
        torch.testing.assert_close(flat[1][i], single.joints)


def test_genders_mixed_in_one_batch_equal_each_body_alone():
    models = {name: tiny_body(name, seed) for seed, name in enumerate(("neutral", "female", "male"))}
    mixed = SMPL(list(models.values())).double()
    pose, betas = draw(7)
    names = ["male", "female", "male", "neutral", "neutral", "male", "female"]
    output = mixed(pose, betas, torch.tensor([GENDERS[name] for name in names]))
    for i, name in enumerate(names):
        alone = SMPL(models[name]).double()(pose[i], betas[i])
        torch.testing.assert_close(output.vertices[i], alone.vertices)
        torch.testing.assert_close(output.joints[i], alone.joints)


def test_gradients_reach_each_sample_of_a_mixed_batch():
    layer = SMPL([tiny_body("female", 1), tiny_body("male", 2)]).double()
    pose, betas = (value.requires_grad_() for value in draw(3))
    gender = torch.tensor([1, 0, 1])
    layer(pose, betas, gender).vertices[1].sum().backward()
    assert betas.grad[1].abs().min() > 0
    assert pose.grad[[0, 2]].abs().max() == betas.grad[[0, 2]].abs().max() == 0


@pytest.mark.parametrize("scale", [0.0, 1.0])
def test_gradients_of_pose_and_shape_are_right(scale):
    layer = SMPL(tiny_body(num_vertices=5)).double()
    pose, betas = (scale * value for value in draw(1))
    pose[..., 3:6] = scale * torch.tensor([0.0, torch.pi, 0.0])
    assert torch.autograd.gradcheck(layer, (pose.requires_grad_(), betas.requires_grad_()), fast_mode=True)


def test_autocast_does_not_touch_the_body():
    layer = SMPL(tiny_body())
    pose, betas = draw(4, dtype=torch.float32)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        output = layer(pose, betas)
        assert layer(pose.bfloat16(), betas).vertices.dtype == torch.float32
    assert torch.equal(output.vertices, layer(pose, betas).vertices)


def test_no_part_of_a_body_is_in_the_state_dict(layer):
    assert layer.state_dict() == {}
    assert not list(layer.parameters())
    layer.load_state_dict({})


def test_the_layer_knows_its_mesh_genders_and_hashes(embedded, layer):
    np.testing.assert_array_equal(layer.faces, embedded.faces)
    assert (layer.hash, layer.genders) == (embedded.hash, ("neutral",))
    assert SMPL.load().hash == embedded.hash
    female, male = tiny_body("female", 1), tiny_body("male", 2)
    both = SMPL([male, female])
    assert both.genders == ("male", "female")
    assert both.hash == SMPL([female, male]).hash == "-".join(sorted([female.hash, male.hash]))


def test_bodies_of_one_gender_or_of_different_meshes_do_not_mix():
    for others in ([tiny_body("male")] * 2, []):
        with pytest.raises(ValueError, match="models: expected one body for each gender, got genders"):
            SMPL(others)
    for other in (tiny_body("female", faces=((0, 1, 3),)), tiny_body("female", num_vertices=10)):
        with pytest.raises(ValueError, match="models: expected bodies with the same faces"):
            SMPL([tiny_body("male"), other])


def test_a_gender_must_be_given_and_loaded():
    pose, betas = draw(2)
    two = SMPL([tiny_body("female"), tiny_body("male", 1)]).double()
    with pytest.raises(ValueError, match="gender: expected codes, since several bodies are loaded"):
        two(pose, betas)
    with pytest.raises(ValueError, match=r"of loaded bodies, 0 \(female\), 1 \(male\); got \[1, 2\]"):
        two(pose, betas, torch.tensor([1, 2]))
    one = SMPL(tiny_body("neutral")).double()
    assert torch.equal(one(pose, betas).vertices, one(pose, betas, torch.tensor([2, 2])).vertices)


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        (((2, 24, 3), (2, 10)), r"pose: expected shape \(2, 24, 72\), got \(2, 24, 3\)"),
        (((2, 72), (2, 16)), r"betas: expected shape \(2, 10\), got \(2, 16\)"),
        (((2, 72), (2, 10), (2, 1)), r"gender: expected shape \(2,\), got \(2, 1\)"),
        (((), (10,)), r"pose: expected shape \(72,\), got \(\)"),
    ],
)
def test_a_wrong_shape_is_named(shapes, message):
    with pytest.raises(ValueError, match=message):
        SMPL(tiny_body())(*(torch.zeros(shape) for shape in shapes))
    with pytest.raises(ValueError, match=r"betas: expected shape \(4, 10\), got \(4, 72\)"):
        SMPL(tiny_body()).rest_joints(torch.zeros(4, 72))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_the_gpu_gives_the_same_body(embedded, layer):
    pose, betas = draw(16, dtype=torch.float32)
    expected = layer(pose, betas)
    output = SMPL(embedded).cuda()(pose.cuda(), betas.cuda(), torch.full((16,), GENDERS["neutral"]).cuda())
    torch.testing.assert_close(output.vertices.cpu(), expected.vertices, atol=1e-5, rtol=0)
    torch.testing.assert_close(output.joints.cpu(), expected.joints, atol=1e-5, rtol=0)


# Rotation matrices and shapes


def test_rotation_matrices_give_the_same_body_as_their_vectors():
    layer = SMPL(tiny_body()).double()
    pose, betas = draw(2, 3)
    rotmats = rotvec_to_rotmat(pose.unflatten(-1, (24, 3)))
    for one, other in zip(layer.from_rotmats(rotmats, betas), layer(pose, betas)):
        assert torch.equal(one, other)
    with pytest.raises(ValueError, match=r"rotmats: expected shape \(\.\.\., 24, 3, 3\), got \(2, 3, 72\)"):
        layer.from_rotmats(pose, betas)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_the_shape_of_a_rest_mesh_is_found_again(batch):
    layer = SMPL(tiny_body()).double()
    _, betas = draw(*batch)
    rest = layer(torch.zeros(*batch, 72, dtype=DTYPE), betas).vertices
    torch.testing.assert_close(layer.fit_betas(rest), betas)


def test_a_fitted_shape_is_the_nearest_of_all():
    layer = SMPL(tiny_body()).double()
    target = layer._v_template[0].unflatten(0, (3, -1)).T + 0.1 * torch.randn(
        layer.num_vertices, 3, dtype=DTYPE, generator=torch.Generator().manual_seed(1)
    )

    def distance(betas):
        return (layer(torch.zeros(72, dtype=DTYPE), betas).vertices - target).square().sum()

    betas = layer.fit_betas(target).requires_grad_()
    distance(betas).backward()
    assert betas.grad.abs().max() < 1e-7


def test_a_shape_is_fitted_to_one_body_of_the_same_mesh():
    layer = SMPL([tiny_body("female"), tiny_body("male", seed=1)])
    with pytest.raises(ValueError, match="several bodies are loaded"):
        layer.fit_betas(torch.zeros(9, 3))
    with pytest.raises(ValueError, match=r"expected \(\.\.\., 9, 3\), got \(8, 3\)"):
        SMPL(tiny_body()).fit_betas(torch.zeros(8, 3))
