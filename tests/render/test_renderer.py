"""Choosing a renderer, and what all of them have in common."""

import pytest
import torch

from ljn.geometry.camera import Camera
from ljn.render import RENDERERS, Renderer, get_renderer
from ljn.render.rasterizer import TorchRasterizer
from ljn.render.zbuffer import ZBuffer

CAMERA = Camera(fx=20.0, fy=22.0, cx=11.3, cy=8.6, width=24, height=18)
TRIANGLE = torch.tensor([[[-9.0, -9, 2], [9, -9, 2], [0, 9, 2]]])
FACES = torch.tensor([[0, 1, 2]])


def test_an_unknown_renderer_is_an_error_that_names_the_known_ones():
    with pytest.raises(
        ValueError, match="expected one of auto, zbuffer, torch, pyrender, open3d, got 'opengl'"
    ):
        get_renderer("opengl")
    assert RENDERERS == ("auto", "zbuffer", "torch", "pyrender", "open3d")


def test_auto_goes_by_the_device_of_the_vertices():
    auto = get_renderer()
    assert type(auto.backend(torch.device("cpu"))) is ZBuffer
    for device in ("cuda", "cuda:1", "mps", "xpu"):
        assert type(auto.backend(torch.device(device))) is TorchRasterizer


def test_auto_draws_what_the_z_buffer_draws_on_the_cpu():
    auto, zbuffer = get_renderer("auto"), get_renderer("zbuffer")
    assert torch.equal(auto(TRIANGLE, FACES, CAMERA), zbuffer(TRIANGLE, FACES, CAMERA))
    ours, reference = (r.fragments(TRIANGLE, FACES, CAMERA) for r in (auto, zbuffer))
    assert all(torch.equal(x, y) for x, y in zip(ours, reference))


def test_a_renderer_of_depth_alone_names_those_that_offer_fragments():
    class DepthAlone(Renderer):
        def __call__(self, vertices, faces, camera):
            return torch.zeros(len(vertices), camera.height, camera.width)

    with pytest.raises(
        NotImplementedError, match=r"DepthAlone draws depth alone.*auto, zbuffer, torch and open3d"
    ):
        DepthAlone().fragments(TRIANGLE, FACES, CAMERA)
