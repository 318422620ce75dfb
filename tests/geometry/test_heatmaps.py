import pytest
import torch

from ljn.geometry.heatmaps import decode_heatmaps, gaussian_heatmaps

SIZE, STRIDE = (24, 16), 4


def keypoints(number=200):
    generator = torch.Generator().manual_seed(0)
    inside = torch.tensor([STRIDE * SIZE[1] - 12.0, STRIDE * SIZE[0] - 12.0])
    return torch.rand(number, 24, 2, generator=generator) * inside + 6


def test_a_map_is_highest_in_the_cell_of_its_keypoint_and_as_wide_as_asked():
    maps = gaussian_heatmaps(torch.tensor([[21.5, 33.5]]), 1.5, SIZE, STRIDE)  # the middle of column 5, row 8
    assert maps.shape == (1, *SIZE)
    assert maps[0, 8, 5] == 1
    torch.testing.assert_close(maps[0, 8, 8], torch.exp(torch.tensor(-2.0)))
    torch.testing.assert_close(maps[0, 11, 5], maps[0, 8, 8])


def test_parabolas_find_a_gaussian_exactly_and_quarters_within_a_quarter_of_a_cell():
    true = keypoints()
    maps = gaussian_heatmaps(true, 1.1, SIZE, STRIDE)
    found, heights = decode_heatmaps(maps, STRIDE, "parabola")
    assert (found - true).abs().max() < 1e-3
    assert heights.min() > 0.7
    found, _ = decode_heatmaps(maps, STRIDE, "quarter")
    # Towards the second peak alone: across it, the position stays that of the cell.
    assert (found - true).abs().max() <= STRIDE / 2 + 1e-3
    assert (found - true).norm(dim=-1).mean() < 0.8 * (true - (true / STRIDE).round() * STRIDE).norm(
        dim=-1
    ).mean()


def test_a_peak_at_the_border_stays_in_the_image():
    maps = gaussian_heatmaps(
        torch.tensor([[-8.0, 20.0], [80.0, 20.0], [20.0, -9.0], [20.0, 120.0]]), 1.1, SIZE, STRIDE
    )
    for decoding in ("parabola", "quarter"):
        found, _ = decode_heatmaps(maps, STRIDE, decoding)
        assert (found >= -0.5).all()
        assert (found <= torch.tensor([63.5, 95.5])).all()


def test_confidence_is_the_height_of_the_peak_between_0_and_1():
    maps = torch.zeros(3, *SIZE)
    maps[0, 3, 3], maps[1, 3, 3], maps[2] = 0.4, 1.2, -1.0
    assert decode_heatmaps(maps, STRIDE)[1].tolist() == pytest.approx([0.4, 1, 0])


def test_an_unknown_decoding_is_named():
    with pytest.raises(ValueError, match=r"decoding: expected one of quarter, parabola, got 'soft'"):
        decode_heatmaps(torch.zeros(1, 4, 4), STRIDE, "soft")
