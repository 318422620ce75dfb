"""What is particular to the renderer `torch`: portions, precisions, devices."""

import numpy as np
import pytest
import torch

from datamodules.placement import place
from ljn.geometry.camera import Camera
from ljn.render import get_renderer
from ljn.render.rasterizer import TorchRasterizer

SMALL = Camera(fx=20.0, fy=22.0, cx=11.3, cy=8.6, width=24, height=18)
# Pixel centres are exactly representable: (x, y, 1) falls on pixel (16 x + 8, 16 y + 8).


@pytest.fixture(scope="module")
def placed(bodies, kinect):
    """4 meshes `(4, V, 3)` float64 before the camera, and their faces."""
    rng = np.random.default_rng(0)
    vertices = np.stack([mesh + place(mesh, kinect, rng.random(3)) for mesh in bodies[0][:4]])
    return torch.from_numpy(vertices), bodies[1]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_size_of_portions_changes_nothing(placed, kinect, dtype):
    vertices, faces = placed[0][:3].to(dtype), placed[1]
    expected = TorchRasterizer().fragments(vertices, faces, kinect)
    # Less than a mesh, some triangles of a mesh; a mesh and a half.
    for max_candidates in (3_000, 20_001):
        renderer = TorchRasterizer(max_candidates)
        assert torch.equal(renderer(vertices, faces, kinect), expected.depth)
        for ours, reference in zip(renderer.fragments(vertices, faces, kinect), expected):
            assert torch.equal(ours, reference)


@pytest.mark.parametrize("max_candidates", [1, 7, 100, 433])
def test_a_triangle_larger_than_a_portion_is_drawn_whole(max_candidates):
    rng = np.random.default_rng(0)
    vertices = torch.from_numpy(rng.uniform((-0.8, -0.6, 0.9), (0.8, 0.6, 3.0), (2, 12, 3)))
    faces = torch.from_numpy(np.stack([rng.choice(12, 3, replace=False) for _ in range(8)]))
    expected = get_renderer("zbuffer")(vertices, faces, SMALL)
    assert (expected > 0).sum() > 150
    ours = TorchRasterizer(max_candidates)(vertices, faces, SMALL)
    assert torch.equal(ours > 0, expected > 0)
    torch.testing.assert_close(ours, expected, atol=0, rtol=1e-6)


def test_portions_of_nothing_are_an_error():
    with pytest.raises(ValueError, match="max_candidates: expected at least 1, got 0"):
        TorchRasterizer(0)


def test_in_float32_a_sheet_of_random_triangles_has_no_holes():
    rng = np.random.default_rng(0)
    camera = Camera(fx=300.0, fy=300.0, cx=150.0, cy=150.0, width=301, height=301)
    size = 120
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, size), np.linspace(-0.6, 0.6, size))
    vertices = np.stack([x, y, np.ones(x.shape)], -1)
    vertices[..., :2] += rng.uniform(-0.003, 0.003, (size, size, 2))  # triangles keep their orientation
    vertices *= rng.uniform(1.0, 2.0, (size, size, 1))  # along the ray: the picture stays
    corner = np.arange((size - 1) * size).reshape(size - 1, size)[:, :-1].ravel()
    upper, lower = [0, 1, size], [1, size + 1, size]
    faces = torch.from_numpy(np.concatenate([corner[:, None] + upper, corner[:, None] + lower]))
    depth = TorchRasterizer()(torch.from_numpy(vertices.reshape(1, -1, 3)).float(), faces, camera)
    assert (depth > 0).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_mesh_far_outside_the_image_leaves_the_rest_of_the_batch(dtype):
    vertices = torch.tensor([[[-9.0, -9, 1.7], [9, -9, 1.7], [0, 9, 1.7]]], dtype=dtype)
    away = vertices + torch.tensor([1e6, 0, 0], dtype=dtype)
    faces = torch.tensor([[0, 1, 2], [0, 1, 1]])
    depth = TorchRasterizer()(torch.cat([away, vertices, -away * torch.tensor([1, 1, -1])]), faces, SMALL)
    assert not depth[0].any()
    assert not depth[2].any()
    torch.testing.assert_close(depth[1:2], TorchRasterizer()(vertices, faces, SMALL))
    assert (depth[1] > 0).any()


def test_a_vertex_close_to_the_cameras_plane_is_no_error():
    vertices = torch.tensor([[[0.5, 0.5, 1e-30], [-0.3, 0.0, 1.0], [0.0, -0.3, 1.0], [0.3, 0.3, 1.0]]])
    faces = torch.tensor([[0, 1, 2], [1, 2, 3]])
    depth = TorchRasterizer()(vertices, faces, SMALL)
    assert depth.isfinite().all()
    assert depth[0, 8, 11] > 0


@pytest.mark.parametrize("shape", [(0, 4), (2, 4)])
def test_no_faces_or_no_meshes_give_empty_images(shape):
    faces = torch.zeros(0, 3, dtype=torch.int64)
    fragments = TorchRasterizer().fragments(torch.ones(*shape, 3), faces, SMALL)
    assert fragments.depth.shape == (shape[0], 18, 24)
    assert not fragments.depth.any()
    assert (fragments.face_ids == -1).all()
    assert fragments.barycentrics.shape == (shape[0], 18, 24, 3)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_lower_precisions_are_computed_in_float32(dtype):
    vertices = torch.tensor([[[-9.0, -9, 1.75], [9, -9, 1.75], [0, 9, 1.75]]], dtype=dtype)
    faces = torch.tensor([[0, 1, 2]], dtype=torch.int32)
    depth = TorchRasterizer()(vertices, faces, SMALL)
    assert depth.dtype == torch.float32
    assert torch.equal(depth, TorchRasterizer()(vertices.float(), faces, SMALL))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_gpu_draws_what_the_cpu_draws(placed, kinect, dtype):
    vertices, faces = placed[0].to(dtype), placed[1]
    expected = TorchRasterizer().fragments(vertices, faces, kinect)
    for renderer in (TorchRasterizer(), TorchRasterizer(200_000), get_renderer("auto")):
        ours = renderer.fragments(vertices.cuda(), faces, kinect)
        assert all(x.device.type == "cuda" for x in ours)
        assert torch.equal(renderer(vertices.cuda(), faces.cuda(), kinect), ours.depth)
        depth, face_ids, barycentrics = (x.cpu() for x in ours)
        assert torch.equal(depth > 0, expected.depth > 0)
        torch.testing.assert_close(depth, expected.depth, atol=1e-5, rtol=0)
        same = face_ids == expected.face_ids
        assert same.double().mean() >= 0.9999
        torch.testing.assert_close(barycentrics[same], expected.barycentrics[same], atol=1e-3, rtol=0)
