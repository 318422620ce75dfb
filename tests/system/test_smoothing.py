import math

import pytest
import torch

from ljn.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from ljn.system.smoothing import OneEuro, OneEuroRotation, PoseSmoother, SlowMean, SmoothingSettings

RATE = 30.0


def smoothed(one_filter, values):
    return torch.stack([one_filter(value, 1 / RATE) for value in values])


def test_it_is_casiez_s_filter():
    """The authors' pseudocode, on numbers."""
    values = torch.randn(50, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    cutoff, beta, x, dx = 1.2, 0.7, None, 0.0
    for value, found in zip(values[:, 0].tolist(), smoothed(OneEuro(cutoff, beta), values)[:, 0].tolist()):
        if x is None:
            x = value
        else:
            share = lambda hz: 1 / (1 + RATE / (2 * math.pi * hz))  # noqa: E731
            dx += share(1.0) * ((value - x) * RATE - dx)
            x += share(cutoff + beta * abs(dx)) * (value - x)
        assert found == pytest.approx(x)


def test_jitter_at_rest_goes_and_fast_motion_hardly_lags():
    noise = 0.01 * torch.randn(300, 24, 3, generator=torch.Generator().manual_seed(0))
    still = smoothed(OneEuro(1.5, 8.0), noise)
    assert still[60:].std() < 0.5 * noise[60:].std()
    moving = torch.linspace(0, 20, 300)[:, None, None] * torch.tensor([1.0, 0, 0])  # 2 m/s
    lag = (smoothed(OneEuro(1.5, 8.0), moving) - moving).norm(dim=-1)
    assert lag.max() < 0.05


def test_rotations_about_an_axis_are_smoothed_as_their_angles_are_and_stay_rotations():
    angles = torch.cumsum(0.1 * torch.randn(80, 1, generator=torch.Generator().manual_seed(0)).double(), 0)
    axis = torch.tensor([[0.6, 0.0, 0.8]], dtype=torch.float64)
    found = smoothed(OneEuroRotation(1.0, 0.5), rotvec_to_rotmat(angles[..., None] * axis))
    expected = smoothed(OneEuro(1.0, 0.5), angles)
    torch.testing.assert_close(found, rotvec_to_rotmat(expected[..., None] * axis))
    # Past half a turn, too, where an axis-angle jumps.
    turning = torch.linspace(0, 4 * math.pi, 200, dtype=torch.float64)[:, None, None] * axis
    found = smoothed(OneEuroRotation(1.0, 0.5), rotvec_to_rotmat(turning))
    steps = rotmat_to_rotvec(found[:-1].mT @ found[1:]).norm(dim=-1)
    assert steps.max() < 0.2


def test_a_smoother_goes_on_from_its_state():
    generator = torch.Generator().manual_seed(0)

    def frame():
        rotvec = torch.randn(24, 3, generator=generator)
        return {"joints": torch.randn(24, 3, generator=generator), "rotmats": rotvec_to_rotmat(rotvec)}

    first = PoseSmoother(SmoothingSettings())
    for _ in range(3):
        first(frame(), 0.03)
    other = PoseSmoother(SmoothingSettings())
    other.state = first.state
    values = frame()
    expected, found = first(values, 0.03), other(values, 0.03)
    assert expected.keys() == found.keys()
    assert all(torch.equal(value, found[name]) for name, value in expected.items())
    with pytest.raises(ValueError, match="seconds: expected more than 0"):
        first(values, 0.0)
    with pytest.raises(ValueError, match=r"joint_beta: expected a number of 0 or more, got -1"):
        SmoothingSettings(joint_beta=-1)


def test_a_shape_is_the_mean_of_what_there_is_and_forgets_slowly():
    values = torch.randn(20, 10, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(smoothed(SlowMean(0.1, 0.0), values)[-1], values.mean(0))
    changed = torch.cat([values[:1].expand(100, -1), values[1:2].expand(600, -1)])
    torch.testing.assert_close(smoothed(SlowMean(0.1, 0.0), changed)[-1], values[1], atol=0.01, rtol=0)
