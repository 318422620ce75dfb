import pytest
import torch

from ljn.body.skeleton import MIRROR
from ljn.nets.cpn import CascadedPyramidNetwork
from ljn.nets.resnet import ResNet

LIGHT = {"block": "basic", "depths": (1, 1, 1, 1), "widths": (8, 8, 8, 8), "stem_channels": 8, "stem_px": 3}


def network(sees="depth", **changes):
    torch.manual_seed(0)
    backbone = ResNet(3 if sees == "rgb" else 2, **LIGHT)
    return CascadedPyramidNetwork(backbone, sees, channels=8, refine_width=4, **changes)


def image(sees, size=2):
    generator = torch.Generator().manual_seed(0)
    if sees == "rgb":
        return torch.randint(0, 256, (size, 3, 64, 32), generator=generator, dtype=torch.uint8)
    depth = 2 + 0.2 * torch.rand(size, 64, 64, generator=generator)
    depth[:, :9], depth[..., 50:] = 0, 0
    return depth


def test_the_backbone_s_defaults_are_resnet_50():
    with torch.device("meta"):
        state = ResNet().state_dict()
    # torchvision's resnet50 without its classifier: 161 convolutions and normalisations' parameters less fc's two, and
    # three statistics of each of 53 normalisations.
    assert len(state) == 318
    assert (
        sum(value.numel() for name, value in state.items() if name.endswith(("weight", "bias"))) == 23_508_032
    )
    assert state["layer3.5.conv2.weight"].shape == (256, 256, 3, 3)
    assert state["layer4.0.downsample.1.running_mean"].shape == (2048,)


@pytest.mark.parametrize("sees", ["rgb", "depth"])
def test_five_heatmaps_at_a_quarter_of_the_resolution_and_every_parameter_gets_a_gradient(sees):
    net = network(sees)
    x = net.normalised(image(sees))
    maps = net.heatmaps(x)
    assert [each.shape for each in maps] == [(2, 24, x.shape[-2] // 4, x.shape[-1] // 4)] * 5
    sum(each.square().sum() for each in maps).backward()
    # The blocks' last scales are zero at first, and nothing reaches what lies before them: one step later, it does.
    with torch.no_grad():
        for parameter in net.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    net.zero_grad()
    sum(each.square().sum() for each in net.heatmaps(x)).backward()
    assert [name for name, p in net.named_parameters() if p.grad is None or not p.grad.any()] == []


@pytest.mark.parametrize("sees", ["rgb", "depth"])
def test_with_its_flip_test_a_mirror_image_gives_mirrored_keypoints(sees):
    net = network(sees, decoding="parabola").eval()
    with torch.no_grad():
        for parameter in net.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    seen = image(sees)
    keypoints, confidences = net(seen)
    mirrored, others = net(seen.flip(-1))
    assert keypoints.shape == (2, 24, 2)
    torch.testing.assert_close(confidences, others[:, list(MIRROR)])
    expected = mirrored[:, list(MIRROR)] * torch.tensor([-1, 1]) + torch.tensor([seen.shape[-1] - 1, 0])
    torch.testing.assert_close(keypoints, expected, atol=0.01, rtol=0)
    net.flip_test = False
    assert not torch.equal(net(seen).confidences, confidences)


def test_only_the_shape_of_the_body_counts_not_its_distance():
    net = network().eval()
    seen = image("depth")
    near, far = net(seen), net(torch.where(seen > 0, seen + 1.5, 0))
    torch.testing.assert_close(near.confidences, far.confidences, atol=1e-4, rtol=1e-3)


def test_a_backbone_of_other_channels_is_refused():
    with pytest.raises(
        ValueError, match=r"backbone: expected 3 channels in, .* got 2; set model.backbone.in_channels=3"
    ):
        CascadedPyramidNetwork(ResNet(2, **LIGHT), "rgb")
    with pytest.raises(ValueError, match=r"sees: expected one of rgb, depth, got 'infrared'"):
        CascadedPyramidNetwork(ResNet(2, **LIGHT), "infrared")
    with pytest.raises(ValueError, match=r"block: expected one of basic, bottleneck, got 'dense'"):
        ResNet(3, "dense")
    with pytest.raises(ValueError, match=r"depths, widths: expected four numbers each"):
        ResNet(3, "basic", depths=(1, 1, 1))
