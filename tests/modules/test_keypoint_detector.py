import pytest
import torch
from torch.optim.lr_scheduler import OneCycleLR

from ljn.building import build
from ljn.geometry.camera import project
from ljn.losses import heatmap_loss
from ljn.modules.keypoint_detector import KeypointDetector, load_backbone
from ljn.nets.cpn import CascadedPyramidNetwork
from ljn.nets.resnet import ResNet

LIGHT = {"block": "basic", "depths": (1, 1, 1, 1), "widths": (8, 8, 8, 8), "stem_channels": 8, "stem_px": 3}


def module(**changes):
    torch.manual_seed(0)
    return KeypointDetector(CascadedPyramidNetwork(ResNet(2, **LIGHT), "depth", 8, 4), **changes)


@pytest.mark.slow
@pytest.mark.parametrize("experiment", ["cpn", "cpn_depth"])
def test_sixteen_samples_are_overfitted_to_under_a_pixel(experiment, compose_config, tmp_path):
    cfg = compose_config(
        *(f"experiment=keypoints/{experiment}", "preset=small", f"paths.output_dir={tmp_path}"),
        # Nobody has shown it mirror images.
        *("model.flip_test=false", "data.num_test=16", "data.num_workers=0"),
    )
    torch.manual_seed(0)
    detector = build(cfg.module)
    data = build(cfg.data)
    data.takes = detector.takes
    batch, _ = data.examples("test", range(16))  # whole persons
    steps = 300
    optimizer = torch.optim.RAdam(detector.net.parameters())
    schedule = OneCycleLR(optimizer, 3e-3, steps)
    for _ in range(steps):
        optimizer.zero_grad()
        detector.loss(batch).backward()
        optimizer.step()
        schedule.step()
    detector.eval()
    with torch.no_grad():
        samples = detector.evaluate(batch, detector.test_metrics)
    assert float(samples["crop_error_px"].mean()) < 1
    assert float(samples["exchanged"].mean()) == 0


def batch(size=4):
    generator = torch.Generator().manual_seed(0)
    joints = 0.3 * torch.randn(size, 24, 3, generator=generator) + torch.tensor([0.0, 0.0, 3.0])
    crop = torch.zeros(size, 64, 64)
    crop[:, 10:50, 20:40] = 3
    return {
        "crop": crop,
        "crop_camera": torch.tensor([100.0, 100, 31.5, 31.5]).expand(size, 4),
        "camera": torch.tensor([300.0, 300, 200, 150]).expand(size, 4),
        "joints": joints,
        "sample_id": torch.arange(size),
    }


def test_predictions_are_in_pixels_of_the_image_and_of_the_crop():
    detector, seen = module().eval(), batch()
    out = detector.evaluate(seen, detector.test_metrics)
    in_crop = detector(seen).keypoints
    torch.testing.assert_close(out["pred_keypoints"], 3 * (in_crop - 31.5) + torch.tensor([200.0, 150]))
    expected = (in_crop - project(seen["joints"], seen["crop_camera"])).norm(dim=-1).mean(-1)
    torch.testing.assert_close(out["crop_error_px"], expected.double(), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(out["keypoint_error_px"], 3 * expected.double(), rtol=1e-4, atol=1e-4)


def test_joints_outside_of_the_crop_are_not_learned_from():
    detector, seen = module(), batch()
    seen["joints"][:, 3] = torch.tensor([2.0, 0, 3])
    first = detector.loss(seen)
    seen["joints"][:, 3, 0] = -3.0
    torch.testing.assert_close(detector.loss(seen), first)


def test_refinenet_learns_from_the_hardest_joints_alone():
    maps = [torch.zeros(1, 4, 1, 1)] * 2
    target = torch.tensor([1.0, 2, 3, 4])[None, :, None, None]
    is_seen = torch.tensor([[True, True, True, False]])
    assert heatmap_loss(maps, [target, target], is_seen, 1) == 0.5 * (1 + 4 + 9) / 4 + 9
    assert heatmap_loss(maps, [target, target], is_seen, 2) == 0.5 * (1 + 4 + 9) / 4 + (9 + 4) / 2


def test_a_training_begins_with_the_backbone_s_weights_of_a_file(tmp_path):
    torch.manual_seed(1)
    state = ResNet(2, **LIGHT).state_dict()
    torch.save({**state, "fc.weight": torch.zeros(3, 8), "fc.bias": torch.zeros(3)}, tmp_path / "resnet.pth")
    detector = module(backbone_weights=tmp_path / "resnet.pth")
    detector.setup("test")
    assert not torch.equal(detector.net.backbone.conv1.weight, state["conv1.weight"])
    detector.setup("fit")
    assert torch.equal(detector.net.backbone.conv1.weight, state["conv1.weight"])


def test_backbone_weights_that_cannot_be_are_named(tmp_path):
    backbone = ResNet(2, **LIGHT)
    with pytest.raises(FileNotFoundError, match=r"backbone_weights: there is no file .*none.pth"):
        load_backbone(backbone, tmp_path / "none.pth")
    (tmp_path / "bad.pth").write_bytes(b"no weights")
    torch.save(ResNet(3, **LIGHT).state_dict(), tmp_path / "other.pth")
    torch.save([1, 2], tmp_path / "list.pth")
    for name in ("bad", "other", "list"):
        with pytest.raises(
            ValueError, match=rf"backbone_weights: .*{name}.pth' is damaged, or does not hold"
        ):
            load_backbone(backbone, tmp_path / f"{name}.pth")


def test_settings_that_cannot_be_are_named():
    with pytest.raises(ValueError, match=r"target_sigmas: expected five positive numbers"):
        module(target_sigmas=(1, 1))
    with pytest.raises(ValueError, match=r"hard_keypoints: expected 1 to 24 joints, got 25"):
        module(hard_keypoints=25)
