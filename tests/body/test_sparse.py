from dataclasses import replace

import pytest
import torch

from ljn.body import SMPL, SparseSMPL


@pytest.fixture(scope="module")
def columns(source):
    records = source.records("train", 9, seed=3)
    return [torch.from_numpy(column) for column in (records.pose, records.betas, records.gender)]


@pytest.fixture
def quick(body_models):
    if not torch.backends.mkl.is_available():
        pytest.skip("needs a PyTorch with MKL")
    return SparseSMPL(body_models)


@pytest.mark.parametrize(("dtype", "within"), [(torch.float32, 2e-6), (torch.float64, 1e-13)])
@pytest.mark.parametrize("number", [1, 9])
def test_it_is_the_layer_to_rounding(quick, body_models, columns, dtype, within, number):
    given = [column[:number] for column in columns]
    with torch.no_grad():
        quick(*given)  # what it has of another precision is dropped
        found, expected = (layer.to(dtype)(*given) for layer in (quick, SMPL(body_models)))
    assert quick._sparse
    for one, other in zip(found, expected):
        assert one.dtype == dtype
        torch.testing.assert_close(one, other, atol=within, rtol=0)


def test_with_gradients_it_is_the_layer(quick, body_models, columns):
    betas = columns[1].clone().requires_grad_()
    found, expected = (layer(columns[0], betas, columns[2]) for layer in (quick, SMPL(body_models)))
    assert torch.equal(found.vertices, expected.vertices)
    assert torch.autograd.grad(found.vertices.sum(), betas)[0].abs().sum() > 0


def test_a_body_with_few_zeros_is_posed_by_the_layer(body, columns):
    generator = torch.Generator().manual_seed(0)
    dense = replace(body, posedirs=torch.randn(body.posedirs.shape, generator=generator).numpy() * 1e-3)
    with torch.no_grad():
        found, expected = (kind(dense)(*columns[:2]) for kind in (SparseSMPL, SMPL))
    assert torch.equal(found.vertices, expected.vertices)


def test_some_vertices_alone_are_those_of_all(quick, columns):
    some = torch.tensor([7, 5000, 123])
    with torch.no_grad():
        everything = quick(*columns).vertices
        layer = quick.on_vertices(some)
        torch.testing.assert_close(layer(*columns).vertices, everything[:, some], atol=2e-6, rtol=0)
        assert torch.equal(quick(*columns).vertices, everything)
