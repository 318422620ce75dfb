import dataclasses
import math

import pytest
import torch

from ljn.geometry.camera import Camera, back_project, place_at_root, project


def draw_points(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(*shape, 3, dtype=torch.float64, generator=generator)
    return torch.cat([points[..., :2], points[..., 2:].abs() + 0.5], -1)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_back_projection_inverts_projection(kinect, batch):
    points = draw_points(*batch, 7)
    intrinsics = kinect.intrinsics(torch.float64).expand(*batch, 4)
    back = back_project(project(points, intrinsics), points[..., 2], intrinsics)
    torch.testing.assert_close(back, points, atol=1e-12, rtol=0)


def test_projection_inverts_back_projection_with_a_camera_for_each_sample():
    generator = torch.Generator().manual_seed(0)
    pixels = 400 * torch.rand(5, 9, 2, dtype=torch.float64, generator=generator)
    depth = 1 + torch.rand(5, 9, dtype=torch.float64, generator=generator)
    intrinsics = 100 + 300 * torch.rand(5, 4, dtype=torch.float64, generator=generator)
    torch.testing.assert_close(project(back_project(pixels, depth, intrinsics), intrinsics), pixels)


def test_projection_follows_the_pinhole_formula(kinect):
    x, y, z = 0.3, -0.2, 2.0
    [pixel] = project(
        torch.tensor([[x, y, z]], dtype=torch.float64), kinect.intrinsics(torch.float64)
    ).tolist()
    assert pixel == pytest.approx([kinect.fx * x / z + kinect.cx, kinect.fy * y / z + kinect.cy])


def test_projection_and_back_projection_have_correct_gradients(kinect):
    points = draw_points(4).requires_grad_()
    intrinsics = kinect.intrinsics(torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(project, (points, intrinsics))
    pixels, depth = (x.detach().requires_grad_() for x in (project(points, intrinsics), points[:, 2]))
    assert torch.autograd.gradcheck(back_project, (pixels, depth, intrinsics))


def test_intrinsics_come_in_the_order_of_the_batch_contract(kinect):
    expected = [kinect.fx, kinect.fy, kinect.cx, kinect.cy]
    assert kinect.intrinsics(torch.float64).tolist() == expected
    assert kinect.intrinsics().dtype == torch.float32


@pytest.mark.parametrize("name", ["fx", "fy", "width", "height"])
@pytest.mark.parametrize("value", [0, -3, math.nan, math.inf])
def test_focal_lengths_and_sizes_must_be_positive_and_finite(kinect, name, value):
    with pytest.raises(ValueError, match=f"focal lengths and image size must be positive.*{name}={value}"):
        dataclasses.replace(kinect, **{name: value})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": "366"}, "expected six numbers"),
        ({"cy": None}, "expected six numbers"),
        ({"width": 423.5}, "expected whole numbers of pixels"),
        ({"height": 10**9}, "16777216 in all at the most"),
    ],
)
def test_what_is_no_camera_is_refused(kinect, change, message):
    with pytest.raises(ValueError, match=f"camera: .*{message}"):
        dataclasses.replace(kinect, **change)


@pytest.mark.parametrize("change", [{"cx": -1.0}, {"cx": 424.0}, {"cy": 600.0}, {"cy": math.nan}])
def test_the_principal_point_must_lie_inside_the_image(kinect, change):
    with pytest.raises(ValueError, match=r"principal point .* lies outside the image of 424 x 512"):
        dataclasses.replace(kinect, **change)


def test_swapped_width_and_height_are_named_as_the_likely_mistake():
    with pytest.raises(ValueError, match="are width and height, or cx and cy, swapped"):
        Camera(fx=365.0, fy=365.0, cx=260.0, cy=100.0, width=200, height=300)


# Placement


def test_a_body_is_placed_with_its_root_where_it_is_seen():
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(2, 5, 3, generator=generator, dtype=torch.float64)
    root, seen = torch.randn(2, 2, 3, generator=generator, dtype=torch.float64)
    placed = place_at_root(points, root, seen)
    torch.testing.assert_close(place_at_root(root[:, None], root, seen)[:, 0], seen)
    for b in range(2):
        for n in range(5):
            forward, left, up = (points[b, n] - root[b]).tolist()
            expected = seen[b] + torch.tensor([left, -up, -forward], dtype=torch.float64)
            torch.testing.assert_close(placed[b, n], expected)
