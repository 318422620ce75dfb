"""All renderers draw the same bodies."""

import numpy as np
import pytest
import torch

from datamodules.placement import place
from ljn.render import get_renderer


@pytest.fixture(scope="module")
def placed(bodies, kinect):
    """32 meshes `(32, V, 3)` float64 before the camera, and their faces."""
    rng = np.random.default_rng(0)
    vertices = np.stack([mesh + place(mesh, kinect, rng.random(3)) for mesh in bodies[0][:32]])
    return torch.from_numpy(vertices), bodies[1]


def assert_nearly_equal(depth, reference):
    """As near as rasterisers come that round differently: the outline, and where they graze a surface."""
    num_pixels = int((reference > 0).sum())
    assert num_pixels > 32 * 5000
    assert ((depth > 0) != (reference > 0)).sum() <= 0.0005 * num_pixels
    shared = (depth > 0) & (reference > 0)
    assert ((depth - reference)[shared].abs() <= 5e-5).double().mean() >= 0.999


def test_torch_draws_in_float64_what_the_z_buffer_draws(placed, kinect):
    depth, reference = (get_renderer(name)(*placed, kinect) for name in ("torch", "zbuffer"))
    assert depth.dtype == torch.float32
    assert (reference > 0).sum() > 32 * 5000
    assert torch.equal(depth > 0, reference > 0)
    torch.testing.assert_close(depth, reference, atol=1e-5, rtol=0)


def test_torch_draws_in_float32_nearly_what_the_z_buffer_draws(placed, kinect):
    vertices, faces = placed[0].float(), placed[1]
    assert_nearly_equal(*(get_renderer(name)(vertices, faces, kinect) for name in ("torch", "zbuffer")))


@pytest.mark.render
@pytest.mark.parametrize("backend", ["open3d", "pyrender"])
def test_zbuffer_and_torch_agree_with_other_backends(backend, placed, kinect, request):
    request.getfixturevalue(backend)
    # The others work in float32: all are to see the same, rounded meshes.
    vertices, faces = placed[0].float(), placed[1]
    reference = get_renderer(backend)(vertices, faces, kinect)
    assert reference.shape == (32, kinect.height, kinect.width)
    for name in ("zbuffer", "torch"):
        assert_nearly_equal(get_renderer(name)(vertices, faces, kinect), reference)
