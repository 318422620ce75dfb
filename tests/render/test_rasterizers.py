"""Rules that every rasteriser keeps, in float64."""

from itertools import combinations

import numpy as np
import pytest
import torch

from ljn.geometry.camera import Camera
from ljn.render import get_renderer
from ljn.render.rasterizer import TorchRasterizer

SMALL = Camera(fx=20.0, fy=22.0, cx=11.3, cy=8.6, width=24, height=18)
# Pixel centres are exactly representable: (x, y, 1) falls on pixel (16 x + 8, 16 y + 8).
EXACT = Camera(fx=16.0, fy=16.0, cx=8.0, cy=8.0, width=17, height=17)


@pytest.fixture(params=["zbuffer", "torch"])
def renderer(request):
    return get_renderer(request.param)


@pytest.fixture
def render(renderer):
    """Draws one mesh, given as arrays: its depth image `(H, W)`."""

    def draw(vertices, faces, camera):
        vertices, faces = torch.as_tensor(vertices), torch.as_tensor(np.asarray(faces))
        return renderer(vertices[None], faces, camera)[0].numpy()

    return draw


def pixel_rays(camera):
    """Directions `(H, W, 3)` with z = 1 through the pixel centres: a hit's parameter is planar depth."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)


def naive_depth(vertices, faces, camera):
    """Every pixel's ray against every triangle, in float64 (Cramer's rule)."""
    rays = pixel_rays(camera)
    depth = np.zeros(rays.shape[:2])
    for row, column in np.ndindex(*depth.shape):
        nearest = np.inf
        for a, b, c in vertices[np.asarray(faces)]:
            system = np.stack([rays[row, column], a - b, a - c], -1)
            if np.linalg.det(system) == 0:
                continue
            t, s, r = np.linalg.solve(system, a)
            if t > 0 and min(s, r, 1 - s - r) >= 0:
                nearest = min(nearest, t)
        depth[row, column] = nearest if np.isfinite(nearest) else 0
    return depth


def convex_depth(vertices, faces, camera):
    """Rays against a convex solid as an intersection of half spaces: knows nothing of edges."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals *= np.sign(((a - vertices.mean(0)) * normals).sum(-1))[:, None]  # outwards
    slope, offset = pixel_rays(camera) @ normals.T, (normals * a).sum(-1)  # inside: slope * t <= offset
    enter = np.where(slope < 0, offset / slope, -np.inf).max(-1)
    leave = np.where(slope > 0, offset / slope, np.inf).min(-1)
    return np.where(enter < leave, enter, 0.0)


def icosphere(subdivisions, radius, centre):
    golden = (1 + 5**0.5) / 2
    vertices = [(-1, golden, 0), (1, golden, 0), (-1, -golden, 0), (1, -golden, 0)]
    vertices = np.array([np.roll(vertex, shift) for shift in range(3) for vertex in vertices])
    gaps = np.linalg.norm(vertices[:, None] - vertices, axis=-1).round(6)
    faces = [
        (i, j, k) for i, j, k in combinations(range(12), 3) if gaps[i, j] == gaps[j, k] == gaps[i, k] == 2
    ]
    triangles = vertices[np.array(faces)]  # (F, 3, 3)
    for _ in range(subdivisions):
        a, b, c = triangles.swapaxes(0, 1)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        triangles = np.concatenate([np.stack(part, 1) for part in parts])
    corners = triangles.reshape(-1, 3)
    corners = radius * corners / np.linalg.norm(corners, axis=-1, keepdims=True)
    _, first, index = np.unique(corners.round(9), axis=0, return_index=True, return_inverse=True)
    return corners[first] + centre, index.reshape(-1, 3)


def grid_faces(columns, rows):
    corner = np.arange((rows - 1) * columns).reshape(rows - 1, columns)[:, :-1].ravel()
    upper = np.stack([corner, corner + 1, corner + columns], -1)
    lower = np.stack([corner + 1, corner + columns + 1, corner + columns], -1)
    return np.concatenate([upper, lower])


@pytest.mark.parametrize("seed", range(4))
def test_depth_equals_rays_against_triangles_of_either_side(render, seed):
    rng = np.random.default_rng(seed)
    vertices = rng.uniform((-0.8, -0.6, 0.9), (0.8, 0.6, 3.0), (12, 3))
    faces = np.stack([rng.choice(12, 3, replace=False) for _ in range(8)])
    expected = naive_depth(vertices, faces, SMALL)
    depth = render(vertices, faces, SMALL)
    assert depth.dtype == np.float32
    assert (expected > 0).sum() > 50
    np.testing.assert_array_equal(depth > 0, expected > 0)
    np.testing.assert_allclose(depth, expected, rtol=1e-6)


@pytest.mark.parametrize("subdivisions", [0, 2, 3])
def test_a_closed_surface_has_no_holes(render, subdivisions):
    camera = Camera(fx=150.0, fy=150.0, cx=63.7, cy=64.2, width=128, height=128)
    vertices, faces = icosphere(subdivisions, 0.6, (0.05, -0.03, 2.0))
    assert len(vertices) == 10 * 4**subdivisions + 2
    expected = convex_depth(vertices, faces, camera)
    depth = render(vertices, faces, camera)
    assert (depth > 0).sum() > 4000
    np.testing.assert_array_equal(depth > 0, expected > 0)
    np.testing.assert_allclose(depth, expected, rtol=1e-6)


def test_edges_and_corners_exactly_through_pixel_centres_leave_no_gap(render):
    x, y = np.meshgrid(np.arange(2, 13) / 16 - 0.5, np.arange(3, 12) / 16 - 0.5)
    vertices = np.stack([x, y, np.ones(x.shape)], -1).reshape(-1, 3)
    depth = render(vertices, grid_faces(11, 9), EXACT)
    expected = np.zeros((17, 17))
    expected[3:12, 2:13] = 1.0
    np.testing.assert_array_equal(depth, expected)


@pytest.mark.parametrize("seed", range(3))
def test_edges_within_rounding_of_pixel_centres_leave_no_gap(render, seed):
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(1, 16) / 16 - 0.5, np.arange(1, 16) / 16 - 0.5)
    z = rng.uniform(1.0, 1.2, x.shape)
    vertices = np.stack([x * z, y * z, z], -1).reshape(-1, 3)  # back on the same pixels but for rounding
    depth = render(vertices, grid_faces(15, 15), EXACT)
    np.testing.assert_allclose(depth[2:15, 2:15], z[1:-1, 1:-1], rtol=1e-6)


def test_a_fan_of_triangles_around_a_pixel_centre_covers_it(render):
    rng = np.random.default_rng(0)
    for _ in range(50):
        angles = np.sort(rng.uniform(0, 2 * np.pi, 7))
        if np.diff(angles, append=angles[0] + 2 * np.pi).max() > 3:
            continue
        rim = np.stack([0.3 * np.cos(angles), 0.3 * np.sin(angles), np.ones(7)], -1)
        vertices = np.concatenate([[[0.0, 0.0, 1.0]], rim])
        faces = [(0, 1 + i, 1 + (i + 1) % 7) for i in range(7)]
        assert render(vertices, faces, EXACT)[8, 8] == 1.0


def test_triangles_thinner_than_rounding_are_no_error(render):
    rng = np.random.default_rng(0)
    camera = Camera(fx=1.0, fy=1.0, cx=0.0, cy=0.0, width=6, height=6)
    u = rng.uniform(0, 4, (20_000, 3))
    v = np.nextafter(u, rng.choice([-9.0, 9.0], u.shape))
    vertices = np.stack([u, v, np.ones(u.shape)], -1).reshape(-1, 3)
    depth = render(vertices, np.arange(60_000).reshape(-1, 3), camera)
    assert set(np.unique(depth)) <= {0.0, 1.0}


def test_a_triangle_without_area_and_a_mesh_outside_the_image_draw_nothing(render):
    vertices = np.array([[-0.3, -0.3, 1.0], [0.3, 0.3, 1.0], [0.0, 0.0, 1.0]])
    assert not render(vertices, [(0, 1, 2), (0, 1, 1), (2, 2, 2)], EXACT).any()
    vertices = np.array([[5.0, 0, 1], [6.0, 0, 1], [5.0, 1, 1]])
    assert not render(vertices, [(0, 1, 2)], SMALL).any()
    assert not render(vertices * (-1, 1, 1), [(0, 1, 2)], SMALL).any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_depth_of_a_plane_across_the_axis_is_exact(renderer, render, dtype):
    z = 1.7
    vertices = torch.tensor([[-9, -9, z], [9, -9, z], [9, 9, z], [-9, 9, z]], dtype=dtype)
    depth = render(vertices, [(0, 1, 2), (0, 2, 3)], SMALL)
    # In float32 the depth's reciprocal is rounded, and weighted means of it are.
    is_rounded = isinstance(renderer, TorchRasterizer) and dtype == torch.float32
    np.testing.assert_allclose(depth, np.float32(z), rtol=5e-7 if is_rounded else 0)


def test_a_batch_equals_its_meshes_rendered_alone(renderer, bodies, kinect):
    vertices, faces = torch.from_numpy(bodies[0][:3]) + torch.tensor([0.0, 0.0, 2.5]), bodies[1]
    together = renderer(vertices, faces, kinect)
    assert together.shape == (3, kinect.height, kinect.width)
    for mesh, depth in zip(vertices, together):
        assert torch.equal(renderer(mesh[None], faces, kinect)[0], depth)
    assert renderer(vertices[:0], faces, kinect).shape == (0, kinect.height, kinect.width)


def test_meshes_that_need_gradients_can_be_drawn(renderer):
    vertices = torch.tensor([[[-9.0, -9, 2], [9, -9, 2], [0, 9, 2]]], requires_grad=True)
    assert renderer(vertices, torch.tensor([[0, 1, 2]]), SMALL).max() == 2


@pytest.mark.parametrize("z", [0.0, -1.0])
def test_a_vertex_not_in_front_of_the_camera_is_an_error(render, z):
    vertices = np.array([[0, 0, 1.0], [1, 0, 1.0], [0, 1, z]])
    with pytest.raises(ValueError, match=rf"the nearest has a depth of {z:.3f} m.*in front of the camera"):
        render(vertices, [(0, 1, 2)], SMALL)


@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_vertices_that_are_not_finite_or_without_a_batch_dimension_are_an_error(render, renderer, value):
    vertices = np.array([[0, 0, 1.0], [1, 0, 1.0], [0, value, 1]])
    with pytest.raises(ValueError, match="vertices: NaN or infinite values"):
        render(vertices, [(0, 1, 2)], SMALL)
    with pytest.raises(ValueError, match=r"vertices: expected \(B, V, 3\), got \(4, 3\)"):
        renderer(torch.ones(4, 3), torch.tensor([[0, 1, 2]]), SMALL)
