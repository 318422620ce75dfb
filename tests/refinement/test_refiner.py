import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt

from ljn.geometry.rotations import rotvec_to_rotmat
from ljn.refinement import SETTINGS, RefinementSettings, Refiner, chosen_settings
from ljn.refinement.prior import guess_precision
from ljn.refinement.refiner import nearest_pixels, nearest_vertices
from tests.refinement.conftest import (
    a_pose,
    depth_of,
    error_mm,
    fitted,
    guess_of,
    mesh_of,
    seen_of,
    state_of,
)

ROOT = torch.tensor([0.1, 0.0, 2.4])
FROM_FAR = RefinementSettings(num_steps=30, num_points=4096, scales_m=(0.5, 0.05))
TRUST_THE_CLOUD = RefinementSettings(num_steps=15, num_points=4096, prior_weight=0.3, scales_m=(0.05, 0.03))


@pytest.fixture(scope="module")
def truth():
    return state_of(a_pose(), torch.tensor([0.5, -1.0, 0.3, 0, 0, 0.5, 0, 0, 0, 0]), ROOT)


@pytest.fixture(scope="module")
def guess(body, truth):
    """Every joint off by 5 degrees about some axis, the shape too; the place by 2 cm."""
    turns = torch.nn.functional.normalize(
        torch.randn(24, 3, generator=torch.Generator().manual_seed(4)), dim=-1
    )
    state = truth.moved(torch.cat([0.09 * turns.flatten(), 0.4 * torch.ones(10), torch.zeros(3)])[None])
    return guess_of(state, mesh_of(body, truth)[1] + 0.012)


@pytest.fixture(scope="module")
def depth(body, truth):
    return depth_of(body, truth)


@pytest.fixture(scope="module")
def refiner(body):
    return Refiner(body)


def start_of(refiner, guess):
    return refiner.guess(*guess)


@pytest.mark.parametrize("name", SETTINGS)
def test_a_fit_from_the_truth_stays_there(body, truth, depth, name):
    refined = Refiner(body, name)(seen_of(depth), *guess_of(truth, mesh_of(body, truth)[1]))
    assert error_mm(body, fitted(refined), truth) < 3


def test_a_fit_comes_nearer(body, truth, depth, refiner, guess):
    refined = refiner(seen_of(depth), *guess)
    before, after = error_mm(body, start_of(refiner, guess), truth), error_mm(body, fitted(refined), truth)
    assert before > 40
    assert after < before / 3
    assert refined.is_kept.all()
    assert refined.residual_mm[0, 1] < refined.residual_mm[0, 0] / 3
    assert refined.unexplained[0, 1] < refined.unexplained[0, 0]


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_from_ten_degrees_in_every_joint_it_comes_back(body, truth, depth, seed):
    turns = torch.nn.functional.normalize(
        torch.randn(24, 3, generator=torch.Generator().manual_seed(seed)), dim=-1
    )
    start = truth.moved(torch.cat([np.deg2rad(10) * turns.flatten(), torch.zeros(13)])[None])
    assert error_mm(body, start, truth) > 90
    seen, state = seen_of(depth, 4096), start
    for settings in (FROM_FAR, TRUST_THE_CLOUD):
        state = fitted(Refiner(body, settings)(seen, *guess_of(state, mesh_of(body, state)[1])))
    assert error_mm(body, state, truth) < 3.5


def foreign(kind, depth):
    """The image with something in it, or missing from it, that a mask did not take care of."""
    spoilt, rng = depth.copy(), np.random.default_rng(0)
    is_body = depth > 0
    v, u = np.nonzero(is_body)
    if kind == "noise":
        spoilt[is_body] += 0.01 * rng.standard_normal(is_body.sum()).astype(np.float32)
    elif kind == "holes":
        spoilt[rng.random(depth.shape) < 0.3] = 0
    elif kind == "wall":
        spoilt[v.min() : v.min() + 60, u.max() - 30 : u.max() + 40] = 3.0
        spoilt[is_body] = depth[is_body]
    elif kind == "stick":
        spoilt[v.min() + 60 : v.max(), u.min() + 10 : u.min() + 16] = 2.1
    elif kind == "second person":
        other = np.roll(depth, 75, axis=1)
        spoilt = np.where(is_body, depth, np.where(other > 0, other + 0.4, 0)).astype(np.float32)
    else:
        assert kind == "half a body"
        spoilt[(v.min() + v.max()) // 2 :] = 0
    return spoilt


@pytest.mark.parametrize("kind", ["noise", "holes", "wall", "stick", "second person", "half a body"])
def test_what_is_foreign_or_missing_does_not_drag_it(body, truth, depth, refiner, guess, kind):
    refined = refiner(seen_of(foreign(kind, depth)), *guess)
    before, after = error_mm(body, start_of(refiner, guess), truth), error_mm(body, fitted(refined), truth)
    assert after < before * (0.9 if kind == "half a body" else 0.6)


def test_a_hopeless_fit_is_given_up(body, depth, refiner):
    upside_down = rotvec_to_rotmat(torch.tensor([np.pi, 0, 0], dtype=torch.float32))
    state = state_of(a_pose(), torch.zeros(10), ROOT)
    state = state._replace(rotmats=torch.cat([upside_down @ state.rotmats[:, :1], state.rotmats[:, 1:]], 1))
    guess = guess_of(state, mesh_of(body, state)[1] + torch.tensor([1.5, 0, 0]))
    refined = refiner(seen_of(depth), *guess)
    assert not refined.is_kept.any()
    assert torch.equal(refined.rotmats, guess[0])
    assert torch.equal(refined.betas, guess[1])
    assert refined.residual_mm[0, 0] == refined.residual_mm[0, 1]


def test_a_batch_is_its_samples(body, truth, depth, guess):
    refiner = Refiner(type(body).load().double())  # rounding would choose other vertices
    other = guess_of(truth, mesh_of(body, truth)[1])
    seen, near = seen_of(depth), seen_of(foreign("holes", depth))
    both = {name: torch.cat([seen[name], near[name]]) for name in seen}
    batch = refiner(both, *(torch.cat(pair) for pair in zip(guess, other)))
    for place, alone in enumerate((refiner(seen, *guess), refiner(near, *other))):
        for together, single in zip(batch, alone):
            assert torch.allclose(together[place], single[0], atol=1e-6)


def test_it_computes_in_the_bodys_precision(body, depth, guess):
    exact = type(body).load().double()
    refined = Refiner(exact)(seen_of(depth), *guess)
    assert refined.rotmats.dtype == torch.float64
    assert refined.root.dtype == torch.float64


def test_a_broken_guess_is_an_error(depth, refiner, guess):
    rotmats, betas, joints = guess
    with pytest.raises(ValueError, match="refine: NaN or infinite values in the guess"):
        refiner(seen_of(depth), rotmats, torch.full_like(betas, torch.nan), joints)


def test_nearest_vertices_agree_with_tensors():
    generator = torch.Generator().manual_seed(0)
    points, vertices = torch.randn(2, 50, 3, generator=generator), torch.randn(2, 80, 3, generator=generator)
    normals = torch.nn.functional.normalize(points, dim=-1)
    turned = torch.nn.functional.normalize(vertices, dim=-1)
    is_facing = torch.rand(2, 80, generator=generator) > 0.5
    index = nearest_vertices(points, normals, vertices, turned, is_facing)
    costs = torch.cdist(points, vertices) ** 2 + 0.02 * (1 - normals @ turned.mT)
    assert torch.equal(index, costs.masked_fill(~is_facing[:, None], torch.inf).argmin(-1))


def test_where_no_vertex_faces_the_camera_the_first_is_taken():
    points = torch.randn(1, 3, 3)
    assert not nearest_vertices(points, points, points, points, torch.zeros(1, 3, dtype=torch.bool)).any()


@pytest.mark.parametrize("share", [0.01, 0.5, 1.0])
def test_nearest_pixels_are_the_distance_transforms(share):
    masks = torch.rand(3, 20, 20, generator=torch.Generator().manual_seed(1)) < share
    masks[:, 7, 3] = True
    rows, columns = np.mgrid[:20, :20]
    for mask, index in zip(masks.numpy(), nearest_pixels(masks).numpy()):
        assert mask.flatten()[index].all()
        assert np.allclose(np.hypot(index // 20 - rows, index % 20 - columns), distance_transform_edt(~mask))


def test_another_bodys_shape_has_a_prior_of_its_own():
    known, other = guess_precision(str(np.load(_path())["body"])), guess_precision("another body")
    assert torch.linalg.eigvalsh(known)[0] > 0
    assert torch.allclose(other[72:82, 72:82], torch.eye(10, dtype=torch.float64))
    assert not other[72:82, :72].any()
    assert not torch.allclose(known[72:82, 72:82], other[72:82, 72:82])


def _path():
    from ljn.refinement.prior import PATH

    return PATH


@pytest.mark.parametrize(
    ("value", "expected"), [(None, None), (False, None), (True, "accurate"), ("fast", "fast")]
)
def test_settings_are_chosen(value, expected):
    assert chosen_settings(value) == expected


def test_unknown_settings_are_refused():
    with pytest.raises(ValueError, match="expected true, false, accurate or fast, got 'slow'"):
        chosen_settings("slow")
    with pytest.raises(ValueError, match="num_steps: expected a whole number"):
        RefinementSettings(num_steps=0)
