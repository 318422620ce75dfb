import numpy as np
import pytest
import torch

from datamodules.placement import place
from ljn.render import get_renderer

pytestmark = pytest.mark.render


def test_the_z_buffer_agrees_with_ray_casting_on_bodies(bodies, kinect, open3d):
    rng = np.random.default_rng(0)
    meshes, faces = bodies[0][:32], bodies[1]
    vertices = np.stack([mesh + place(mesh, kinect, rng.random(3)) for mesh in meshes])
    # Ray casting works in float32: the z-buffer is to see the same, rounded meshes.
    vertices = torch.from_numpy(vertices).float()
    ours = get_renderer("zbuffer")(vertices, faces, kinect).numpy()
    reference = get_renderer("open3d")(vertices, faces, kinect).numpy()
    assert ours.shape == reference.shape == (32, kinect.height, kinect.width)

    num_pixels = np.count_nonzero(reference)
    assert num_pixels > 32 * 5000
    assert np.count_nonzero((ours > 0) != (reference > 0)) <= 0.0005 * num_pixels
    shared = (ours > 0) & (reference > 0)
    assert (np.abs(ours - reference)[shared] <= 5e-5).mean() >= 0.999


def test_ray_casting_gives_planar_depth_and_a_background_of_zero(kinect, open3d):
    vertices = torch.tensor([[[-9.0, -9, 1.7], [9, -9, 1.7], [0, 0, 1.7]]])
    depth = get_renderer("open3d")(vertices, torch.tensor([[0, 1, 2]]), kinect)[0]
    assert depth.dtype == torch.float32
    assert depth[-1].max() == 0
    torch.testing.assert_close(depth[0], torch.full((kinect.width,), 1.7))


def test_ray_casting_checks_its_vertices_like_every_renderer(kinect, open3d):
    with pytest.raises(ValueError, match="in front of the camera"):
        get_renderer("open3d")(-torch.ones(1, 3, 3), torch.tensor([[0, 1, 2]]), kinect)
