import torch

from ljn.geometry.camera import project
from ljn.geometry.patches import depth_patches, patch_squares


def scene(size=3, crop_px=64):
    """Tilted planes before the camera, and points near them."""
    generator = torch.Generator().manual_seed(0)
    points = 0.3 * torch.randn(size, 24, 3, generator=generator) + torch.tensor([0.0, 0.0, 2.0])
    rows = torch.arange(crop_px) - crop_px / 2
    crop = 2 + 0.002 * rows[:, None] + 0.001 * rows + 0.1 * torch.arange(size)[:, None, None]
    crop[:, :5] = crop[:, :, :8] = 0
    return crop, torch.tensor([60.0, 60, 31.5, 31.5]).expand(size, 4), points


def test_a_patch_shows_the_surface_as_wide_in_space_whatever_the_distance():
    crop, camera, joints = scene()
    patches = depth_patches(crop, camera, joints, 0.4, 0.25, 8)
    for sample, (image, one) in enumerate(zip(crop, joints)):
        for joint in range(0, 24, 5):
            z = one[joint, 2]
            offsets = 0.4 * ((torch.arange(8) + 0.5) / 8 - 0.5)
            for row in (0, 3, 7):
                for column in (1, 6):
                    corner = one[joint] + torch.stack([offsets[column], offsets[row], torch.zeros(())])
                    u, v = project(corner[None], camera[sample])[0].round().long().tolist()
                    inside = 0 <= u < 64 and 0 <= v < 64 and image[v, u] > 0
                    expected = ((image[v, u] - z) / 0.25).clamp(-2, 2) if inside else torch.zeros(())
                    torch.testing.assert_close(patches[sample, joint, 0, row, column], expected)
                    assert patches[sample, joint, 1, row, column] == float(inside)


def test_the_compiled_kernel_follows_the_tensor_form_to_the_last_bit():
    crop, camera, points = scene()
    points[0, :4] = torch.tensor([[0.0, 0, -1], [0, 0, 0], [50, 0, 1], [1e9, -1e9, 0.05]])
    sizes, units = (0.4, 1.0), (0.25, 0.5)
    squares = patch_squares(crop, camera, points, sizes, units, 8)
    assert squares.shape == (3, 24, 4, 64)
    for scale, (size, unit) in enumerate(zip(sizes, units)):
        patches = depth_patches(crop, camera, points, size, unit, 8)
        for square, (row, column) in enumerate([(0, 0), (0, 4), (4, 0), (4, 4)]):
            expected = patches[..., row : row + 4, column : column + 4].flatten(2)
            assert torch.equal(squares[:, :, square, 32 * scale : 32 * scale + 32], expected)
