import pytest
import torch

from ljn.render import get_renderer

pytestmark = pytest.mark.render


def test_ray_casting_gives_planar_depth_and_a_background_of_zero(kinect, open3d):
    vertices = torch.tensor([[[-9.0, -9, 1.7], [9, -9, 1.7], [0, 0, 1.7]]])
    depth = get_renderer("open3d")(vertices, torch.tensor([[0, 1, 2]]), kinect)[0]
    assert depth.dtype == torch.float32
    assert depth[-1].max() == 0
    torch.testing.assert_close(depth[0], torch.full((kinect.width,), 1.7))


def test_ray_casting_checks_its_vertices_like_every_renderer(kinect, open3d):
    with pytest.raises(ValueError, match="in front of the camera"):
        get_renderer("open3d")(-torch.ones(1, 3, 3), torch.tensor([[0, 1, 2]]), kinect)
