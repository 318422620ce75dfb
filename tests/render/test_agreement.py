import numpy as np
import pytest
import torch

from datamodules.placement import place
from ljn.render import get_renderer

pytestmark = pytest.mark.render


@pytest.mark.parametrize("backend", ["open3d", "pyrender"])
def test_the_z_buffer_agrees_with_other_backends_on_bodies(backend, bodies, kinect, request):
    request.getfixturevalue(backend)
    rng = np.random.default_rng(0)
    meshes, faces = bodies[0][:32], bodies[1]
    vertices = np.stack([mesh + place(mesh, kinect, rng.random(3)) for mesh in meshes])
    # The others work in float32: the z-buffer is to see the same, rounded meshes.
    vertices = torch.from_numpy(vertices).float()
    ours = get_renderer("zbuffer")(vertices, faces, kinect).numpy()
    reference = get_renderer(backend)(vertices, faces, kinect).numpy()
    assert ours.shape == reference.shape == (32, kinect.height, kinect.width)

    num_pixels = np.count_nonzero(reference)
    assert num_pixels > 32 * 5000
    assert np.count_nonzero((ours > 0) != (reference > 0)) <= 0.0005 * num_pixels
    shared = (ours > 0) & (reference > 0)
    assert (np.abs(ours - reference)[shared] <= 5e-5).mean() >= 0.999
