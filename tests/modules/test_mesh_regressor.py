import pytest
import torch
from torch.optim.lr_scheduler import OneCycleLR

from ljn.body.skeleton import NUM_JOINTS
from ljn.building import build

EXPERIMENTS = ("proposed", "single", "pointnet", "basic")


@pytest.mark.slow
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_eight_samples_are_overfitted(experiment, compose_config, tmp_path):
    cfg = compose_config(
        *(f"experiment=mesh/{experiment}", "preset=small", f"paths.output_dir={tmp_path}"),
        *("data.num_train=8", "data.observation.num_points=128", "data.num_workers=0"),
        *("preset.mesh.num_centres=[32,8]", "preset.mesh.group_sizes=[8,8]"),
        "preset.mesh.channels=[[32,32],[64,64]]",
    )
    torch.manual_seed(0)
    module = build(cfg.module)
    batch, _ = build(cfg.data).examples("train", range(8))
    steps = 800
    optimizer = torch.optim.Adam(module.net.parameters(), betas=(0.9, 0.99))
    schedule = OneCycleLR(optimizer, 2e-3, steps)
    for _ in range(steps):
        optimizer.zero_grad()
        module.loss(batch).backward()
        optimizer.step()
        schedule.step()
    module.eval()
    with torch.no_grad():
        apve_mm = module.evaluate(batch, module.test_metrics)["apve"]
    assert float(apve_mm.mean()) < 10


def test_loss_vertices_are_of_every_limb_as_many_as_it_has(compose_config):
    module = build(compose_config("experiment=mesh/kinematic", "preset=small").module)
    chosen = module.loss_bodies[0]._weights[0].argmax(0)
    every = module.body._weights[0].argmax(0)
    expected = torch.bincount(every, minlength=NUM_JOINTS) * len(chosen) / len(every)
    count = torch.bincount(chosen, minlength=NUM_JOINTS)
    assert ((count - expected).abs() < 4 * expected.sqrt() + 1).all()
