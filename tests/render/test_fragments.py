"""Face ids and barycentrics: what is seen at each pixel."""

import numpy as np
import pytest
import torch

from datamodules.placement import place
from ljn.geometry.camera import Camera
from ljn.render import get_renderer

# Pixel centres are exactly representable: (x, y, 1) falls on pixel (16 x + 8, 16 y + 8).
EXACT = Camera(fx=16.0, fy=16.0, cx=8.0, cy=8.0, width=17, height=17)
BACKENDS = ["zbuffer", "torch", pytest.param("open3d", marks=pytest.mark.render)]


@pytest.fixture
def make(request):
    """A renderer by name; for one whose package is missing the test is skipped."""

    def build(name):
        if name == "open3d":
            request.getfixturevalue("open3d")
        return get_renderer(name)

    return build


@pytest.fixture(scope="module")
def placed(bodies, kinect):
    """8 meshes `(8, V, 3)` before the camera, in float64 rounded to float32, and their faces."""
    rng = np.random.default_rng(0)
    vertices = np.stack([mesh + place(mesh, kinect, rng.random(3)) for mesh in bodies[0][:8]])
    return torch.from_numpy(vertices).float().double(), bodies[1]


@pytest.fixture(scope="module")
def reference(placed, kinect):
    return get_renderer("zbuffer").fragments(*placed, kinect)


def points_at_pixels(fragments, vertices, faces):
    """`(P, 3)`: where the foreground pixels' barycentrics are in space; and `(P, 3)`: mesh, row and column."""
    where = (fragments.face_ids >= 0).nonzero()
    mesh, row, column = where.unbind(1)
    corners = vertices[mesh[:, None], faces[fragments.face_ids[mesh, row, column]]]  # (P, 3 corners, 3)
    weights = fragments.barycentrics[mesh, row, column].to(vertices.dtype)
    return (weights[..., None] * corners).sum(1), where


@pytest.mark.parametrize("name", BACKENDS)
def test_barycentrics_give_the_point_in_space_that_a_pixel_sees(make, name, placed, kinect):
    vertices, faces = placed
    fragments = make(name).fragments(vertices, faces, kinect)
    points, where = points_at_pixels(fragments, vertices, faces)
    mesh, row, column = where.unbind(1)
    depth = fragments.depth[mesh, row, column].double()
    rays = [(column - kinect.cx) / kinect.fx, (row - kinect.cy) / kinect.fy, torch.ones(len(where))]
    expected = torch.stack(rays, -1) * depth[:, None]
    error = (points - expected).norm(dim=-1)
    assert len(points) > 8 * 5000
    # Ray casting in float32 is off by more where it grazes a surface.
    assert torch.quantile(error, 0.999) < 2e-5
    assert error.max() < (1e-3 if name == "open3d" else 2e-6)


@pytest.mark.parametrize("name", BACKENDS)
def test_fragments_have_the_depth_and_the_background_of_the_depth_image(make, name, placed, kinect):
    renderer = make(name)
    depth, face_ids, barycentrics = renderer.fragments(*placed, kinect)
    assert torch.equal(depth, renderer(*placed, kinect))
    assert (depth.dtype, face_ids.dtype, barycentrics.dtype) == (torch.float32, torch.int64, torch.float32)
    assert face_ids.shape == depth.shape
    assert barycentrics.shape == (*depth.shape, 3)
    is_body = depth > 0
    assert torch.equal(face_ids >= 0, is_body)
    assert (face_ids[~is_body] == -1).all()
    assert face_ids.max() < len(placed[1])
    assert not barycentrics[~is_body].any()
    assert barycentrics.min() >= (-1e-5 if name == "open3d" else 0)
    torch.testing.assert_close(
        barycentrics.sum(-1)[is_body], torch.ones(int(is_body.sum())), atol=1e-6, rtol=0
    )


def test_torch_sees_the_faces_that_the_z_buffer_sees(placed, reference, kinect):
    ours = get_renderer("torch").fragments(*placed, kinect)
    same = ours.face_ids == reference.face_ids
    assert same.double().mean() > 0.99999
    torch.testing.assert_close(ours.barycentrics[same], reference.barycentrics[same], atol=1e-6, rtol=0)


def test_torch_in_float32_sees_nearly_the_same(placed, reference, kinect):
    ours = get_renderer("torch").fragments(placed[0].float(), placed[1], kinect)
    is_body = reference.face_ids >= 0
    same = (ours.face_ids == reference.face_ids) & is_body
    assert same.sum() > 0.999 * is_body.sum()
    points, _ = points_at_pixels(ours, *placed)
    expected, _ = points_at_pixels(reference, *placed)
    assert torch.quantile((points - expected).norm(dim=-1), 0.999) < 5e-5


@pytest.mark.render
def test_ray_casting_sees_nearly_the_same_faces(make, placed, reference, kinect):
    fragments = make("open3d").fragments(*placed, kinect)
    is_body = (reference.face_ids >= 0) & (fragments.face_ids >= 0)
    same = (fragments.face_ids == reference.face_ids) & is_body
    assert same.sum() > 0.999 * is_body.sum()
    difference = (fragments.barycentrics - reference.barycentrics)[same].abs().amax(-1)
    assert torch.quantile(difference, 0.99) < 1e-3


@pytest.mark.parametrize("name", ["zbuffer", "torch"])
def test_of_faces_that_are_equally_near_the_first_is_seen(make, name):
    x, y = np.meshgrid(np.arange(2, 13) / 16 - 0.5, np.arange(3, 12) / 16 - 0.5)
    vertices = torch.from_numpy(np.stack([x, y, np.ones(x.shape)], -1).reshape(-1, 3))
    corner = np.arange(8 * 11).reshape(8, 11)[:, :-1].ravel()
    upper = np.stack([corner, corner + 1, corner + 11], -1)
    lower = np.stack([corner + 1, corner + 12, corner + 11], -1)
    faces = np.random.default_rng(0).permutation(np.concatenate([upper, lower, upper[:, ::-1]]))
    [face_ids] = make(name).fragments(vertices[None], torch.from_numpy(faces), EXACT).face_ids.numpy()
    # The centres of pixels are the corners of faces: a pixel's first is the first with that corner.
    u, v = (vertices[:, :2].numpy() * 16 + 8).astype(int).T
    expected = np.full((17, 17), -1)
    for number in reversed(range(len(faces))):
        expected[v[faces[number]], u[faces[number]]] = number
    np.testing.assert_array_equal(face_ids, expected)


@pytest.mark.parametrize("name", ["zbuffer", "torch"])
def test_weights_are_perspective_correct(make, name):
    # An edge from 1 m to 3 m: the middle of the picture of it is not its middle.
    vertices = torch.tensor([[[-0.25, 0.0, 1.0], [0.75, 0.0, 3.0], [0.0, 0.5, 2.0]]], dtype=torch.float64)
    fragments = make(name).fragments(vertices, torch.tensor([[0, 1, 2]]), EXACT)
    assert fragments.face_ids[0, 8, 8] == 0
    torch.testing.assert_close(fragments.barycentrics[0, 8, 8], torch.tensor([0.75, 0.25, 0.0]))
    assert fragments.depth[0, 8, 8] == 1.5


@pytest.mark.render
def test_pyrender_offers_depth_alone(make, pyrender, placed, kinect):
    with pytest.raises(NotImplementedError, match=r"PyRender draws depth alone.*zbuffer, torch and open3d"):
        make("pyrender").fragments(*placed, kinect)
