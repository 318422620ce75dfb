import copy

import pytest
import torch
from torch.func import jacfwd

from ljn.body import SMPL, load_body_models
from ljn.refinement.surface import NUM_CHANGES, BodyState, BodySurface
from tests.refinement.conftest import a_pose, mesh_of, state_of


@pytest.fixture(scope="module")
def exact(body):
    return copy.deepcopy(body).double()


@pytest.fixture(scope="module")
def state():
    generator = torch.Generator().manual_seed(1)
    pose, betas = a_pose(0.3).double(), torch.randn(10, generator=generator, dtype=torch.float64)
    return state_of(pose, betas, torch.tensor([0.1, -0.2, 2.5], dtype=torch.float64))


def test_surface_is_the_body_layers(exact, state):
    surface = BodySurface(exact, 200)
    posed, (vertices, joints) = surface(state), mesh_of(exact, state)
    assert (posed.vertices - vertices[:, surface.index]).abs().max() < 1e-6  # bodies are stored in float32
    assert (posed.joints - joints).abs().max() < 1e-6


def test_vertices_are_of_both_sides_and_every_limb(body):
    surface = BodySurface(body, 1722)
    chosen = surface._weights.argmax(-1).bincount(minlength=24)
    for left, right in ((1, 2), (4, 5), (7, 8), (10, 11), (16, 17), (18, 19), (20, 21)):
        assert min(chosen[left], chosen[right]) > 5
        assert abs(chosen[left] - chosen[right]) <= 0.2 * chosen[left]


def test_normals_are_unit_and_point_outward(body):
    surface = BodySurface(body, 500)
    posed = surface(state_of(a_pose(), torch.zeros(10), torch.tensor([0.0, 0, 2.5])))
    assert torch.allclose(posed.normals.norm(dim=-1), torch.ones(1, 500), atol=1e-5)
    vertices, joints = posed.vertices[0], posed.joints[0]
    nearest = torch.cdist(vertices, joints).argmin(-1)
    outward = ((vertices - joints[nearest]) * posed.normals[0]).sum(-1) > 0
    assert outward.double().mean() > 0.93


@pytest.mark.parametrize("form", ["_rows_on_cpu", "_rows_as_tensors"])
def test_rows_are_autograds(exact, state, form):
    surface = BodySurface(exact, 60)
    posed = surface(state)
    index = torch.arange(60)[None]
    directions = torch.randn(1, 60, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))

    def along(change):
        # Without the correctives' own derivative, which is left out.
        moved = state.moved(change[None])
        features = BodyState(state.rotmats, moved.betas, state.root)
        unposed = surface(features).unposed
        turned = surface(moved)
        vertices = (turned.blended @ unposed[..., None]).squeeze(-1) + surface._weights @ turned.offsets
        return (vertices * directions).sum(-1)[0]

    wanted = jacfwd(along)(torch.zeros(NUM_CHANGES, dtype=torch.float64))
    rows = getattr(surface, form)(posed, index, directions)
    assert (rows[0] - wanted).abs().max() < 1e-7


def test_a_change_leads_from_one_state_to_the_other(state):
    generator = torch.Generator().manual_seed(3)
    change = 0.2 * torch.randn(1, NUM_CHANGES, dtype=torch.float64, generator=generator)
    assert torch.allclose(state.moved(change).change_from(state), change, atol=1e-9)


def test_bodies_of_several_genders_are_refused():
    with pytest.raises(ValueError, match="expected one body, got those of female, male"):
        BodySurface(SMPL(load_body_models(None, ["female", "male"])), 10)
