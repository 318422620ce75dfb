import numpy as np
import pytest
import torch

from ljn.geometry.rotations import rotvec_to_rotmat
from ljn.metrics import MeshMetrics, functional

NUM_SAMPLES, NUM_VERTICES = 7, 30
# Body world's axes in the camera: x forward is -z, y left is x, z up is -y.
CAM_FROM_BODY = np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]])


def make_batch(num_samples=NUM_SAMPLES):
    generator = torch.Generator().manual_seed(0)

    def noise(size, scale):
        return scale * torch.randn(num_samples, size, 3, generator=generator)

    vertices, body_joints, joints = noise(NUM_VERTICES, 0.5), noise(24, 0.5), noise(24, 0.5) + 2
    return {
        "pred_vertices": vertices + noise(NUM_VERTICES, 0.05),
        "vertices": vertices,
        "pred_body_joints": body_joints + noise(24, 0.05),
        "body_joints": body_joints,
        "floor_vertices": vertices + noise(NUM_VERTICES, 0.01),
        "initial_joints": joints + noise(24, 0.02),
        "joints": joints,
    }


def naive(batch):
    """Every metric but the Procrustes-aligned one, by loops over samples and points; mm."""
    found = {}
    arrays = {name: value.double().numpy() for name, value in batch.items()}

    def add(key, pred, target):
        found.setdefault(key, []).append(
            1000 * np.mean([np.sqrt(((p - t) ** 2).sum()) for p, t in zip(pred, target)])
        )

    for i in range(len(arrays["joints"])):
        of = {name: value[i] for name, value in arrays.items()}
        add("apve", of["pred_vertices"], of["vertices"])
        add("mpjpe", of["pred_body_joints"], of["body_joints"])
        add("mpjpe_eq38", of["pred_body_joints"][1:], of["body_joints"][1:])
        found["mpjpe_eq38"][-1] *= 23 / 24
        add("floor_apve", of["floor_vertices"], of["vertices"])
        add("initial_mean_distance_mm", of["initial_joints"], of["joints"])
        pred_root, root = of["pred_body_joints"][0], of["body_joints"][0]
        add("apve_root_aligned", of["pred_vertices"] - pred_root, of["vertices"] - root)
        for name, kind in (("apve_camera", "vertices"), ("mpjpe_camera", "body_joints")):
            pred = [CAM_FROM_BODY @ (p - pred_root) + of["initial_joints"][0] for p in of[f"pred_{kind}"]]
            target = [CAM_FROM_BODY @ (p - root) + of["joints"][0] for p in of[kind]]
            add(name, np.array(pred), np.array(target))
    means = {key: float(np.mean(values)) for key, values in found.items()}
    distances = np.sqrt(((arrays["initial_joints"] - arrays["joints"]) ** 2).sum(-1))
    return means | {"initial_max_distance_mm": 1000 * float(distances.max())}


@pytest.mark.parametrize("sizes", [[NUM_SAMPLES], [1] * NUM_SAMPLES, [4, 0, 3]])
def test_mesh_metrics_equal_loops_whatever_the_batches(sizes):
    batch = make_batch()
    metrics = MeshMetrics()
    for part in zip(*(value.split(sizes) for value in batch.values())):
        metrics.update(**dict(zip(batch, part)))
    computed = {key: value.item() for key, value in metrics.compute().items()}
    expected = naive(batch)
    assert computed.keys() == expected.keys() | {"apve_procrustes"}
    assert {key: computed[key] for key in expected} == pytest.approx(expected, rel=1e-9)


def test_procrustes_forgives_a_similarity_transform_and_nothing_else():
    batch = make_batch()
    turn = rotvec_to_rotmat(torch.tensor([0.3, -1.2, 0.7]))
    moved = 1.3 * batch["vertices"] @ turn.T + torch.tensor([0.4, -2.0, 0.1])
    assert functional.apve_procrustes(moved, batch["vertices"]).max() < 1e-3
    assert functional.apve_procrustes(moved * torch.tensor([-1.0, 1, 1]), batch["vertices"]).min() > 10


def test_a_perfect_mesh_scores_zero_but_for_the_initial_root():
    batch = make_batch()
    batch |= {"pred_vertices": batch["vertices"], "pred_body_joints": batch["body_joints"]}
    metrics = MeshMetrics("test/")
    metrics.update(**batch)
    computed = {key: value.item() for key, value in metrics.compute().items()}
    root_error = 1000 * (batch["initial_joints"] - batch["joints"])[:, 0].double().norm(dim=-1).mean().item()
    for key in ("apve", "mpjpe", "mpjpe_eq38", "apve_root_aligned", "apve_procrustes"):
        assert computed[f"test/{key}"] == pytest.approx(0, abs=1e-4)
    for key in ("apve_camera", "mpjpe_camera"):
        assert computed[f"test/{key}"] == pytest.approx(root_error, rel=1e-4)


def test_one_nan_vertex_shows():
    batch = make_batch()
    batch["pred_vertices"][2, 3, 1] = torch.nan
    metrics = MeshMetrics()
    metrics.update(**batch)
    bad = {key for key, value in metrics.compute().items() if value.isnan()}
    assert bad == {"apve", "apve_root_aligned", "apve_procrustes", "apve_camera"}
