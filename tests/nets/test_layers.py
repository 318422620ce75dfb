import pytest
import torch
from torch import nn

from ljn.nets.layers import (
    PRELU_SLOPE,
    StackedLinear,
    StackedPReLU,
    activate_and_pool,
    apply_shared,
    initialise_for_prelu,
    perceive_and_pool,
    perceptron,
    stacked_perceptron,
)


def test_stacked_layers_equal_a_loop_over_the_joints():
    torch.manual_seed(0)
    stacked = stacked_perceptron(3, [5, 7, 2], last_activation=False).double()
    x = torch.randn(3, 4, 5, dtype=torch.float64)
    out = stacked(x)
    for joint in range(3):
        single = perceptron([5, 7, 2], last_activation=False).double()
        single[0].weight.data = stacked[0].weight.data[joint]
        single[0].bias.data = stacked[0].bias.data[joint]
        single[1].weight.data = stacked[1].weight.data[joint : joint + 1]
        single[2].weight.data = stacked[2].weight.data[joint]
        single[2].bias.data = stacked[2].bias.data[joint]
        torch.testing.assert_close(out[joint], single(x[joint]))


@pytest.mark.parametrize("slope", [0.25, 0.0, -0.7, 1.5])
def test_activating_after_pooling_equals_activating_before(slope):
    torch.manual_seed(0)
    activation = nn.PReLU(init=slope).double()
    x = torch.randn(4, 9, 6, dtype=torch.float64, requires_grad=True)
    pooled = activate_and_pool(x, activation, 1)
    reference = activation(x).amax(1)
    torch.testing.assert_close(pooled, reference)
    weight = torch.randn_like(reference)
    torch.testing.assert_close(
        torch.autograd.grad((pooled * weight).sum(), x)[0],
        torch.autograd.grad((reference * weight).sum(), x)[0],
    )


def test_activating_after_pooling_handles_slopes_of_both_signs_among_joints():
    torch.manual_seed(0)
    activation = StackedPReLU(3)
    activation.weight.data = torch.tensor([0.3, -0.4, 2.0])
    x = torch.randn(3, 4, 9, 6)
    torch.testing.assert_close(activate_and_pool(x, activation, 2), activation(x).amax(2))


def test_what_all_points_share_is_as_if_each_point_carried_it():
    torch.manual_seed(0)
    layers = perceptron([7, 5, 3]).double()
    points, shared = torch.randn(2, 4, 3, dtype=torch.float64), torch.randn(2, 4, dtype=torch.float64)
    carried = torch.cat([points, shared[:, None].expand(-1, 4, -1)], -1)
    torch.testing.assert_close(apply_shared(layers, points, shared), layers(carried))
    torch.testing.assert_close(apply_shared(layers, carried, None), layers(carried))


@pytest.mark.parametrize("out_features", [4, 8])
def test_perceiving_and_pooling_through_few_points_equals_pooling_all(out_features):
    torch.manual_seed(0)
    mlp = perceptron([3, 5, out_features], last_activation=False).double()
    for slope in (0.25, -0.3):
        activation = nn.PReLU(init=slope).double()
        x = torch.randn(2, 17, 3, dtype=torch.float64, requires_grad=True)
        pooled = perceive_and_pool(mlp, activation, x)
        reference = activation(mlp(x)).amax(1)
        torch.testing.assert_close(pooled, reference)
        weight = torch.randn_like(reference)
        inputs = [x, *mlp.parameters(), activation.weight]
        torch.testing.assert_close(
            torch.autograd.grad((pooled * weight).sum(), inputs, materialize_grads=True),
            torch.autograd.grad((reference * weight).sum(), inputs, materialize_grads=True),
        )
        with torch.no_grad():
            torch.testing.assert_close(perceive_and_pool(mlp, activation, x), reference)


@pytest.mark.parametrize("shape", [(20, 103), (200, 103), (3, 200, 103)])
def test_a_layer_starts_orthogonal_and_with_the_same_say_for_each_part(shape):
    torch.manual_seed(0)
    layer = StackedLinear(*shape[:1], shape[2], shape[1]) if len(shape) == 3 else nn.Linear(*shape[::-1])
    initialise_for_prelu(layer, PRELU_SLOPE, parts=(3, 100))
    gain = 2 / (1 + PRELU_SLOPE**2) / 2
    for part in layer.weight.detach().split([3, 100], -1):
        says = part.square().sum(-1).mean(-1)  # of independent inputs of size 1
        torch.testing.assert_close(says, torch.full_like(says, gain))
        gram = part @ part.mT if part.shape[-2] < part.shape[-1] else part.mT @ part
        diagonal = gram.diagonal(dim1=-2, dim2=-1)
        torch.testing.assert_close(
            gram, torch.diag_embed(diagonal.mean(-1, keepdim=True).expand_as(diagonal))
        )
