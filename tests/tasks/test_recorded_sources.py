"""Training and testing from every source of recorded poses, by overrides alone."""

from pathlib import Path

import numpy as np
import pytest
import torch

from ljn.body import SMPL, load_body_model
from ljn.pipeline.motion import BodyMotion, write_amass, write_bvh
from ljn.tasks.evaluate import evaluate
from ljn.tasks.train import train

SEEDS = Path(__file__).parents[2] / "datamodules/sources/embedded/data/seed_poses.npz"


@pytest.fixture(scope="module")
def motions(tmp_path_factory):
    """A folder for each source: the clips that ship as AMASS's files, as BVH files and as one plain file."""
    directory = tmp_path_factory.mktemp("motions")
    with np.load(SEEDS) as arrays:
        poses, clip = arrays["poses"].astype(np.float32), arrays["clip"]
    rest = SMPL(load_body_model()).rest_joints(torch.zeros(10)).numpy()
    np.savez(directory / "plain.npz", poses=poses, subject=clip)
    for name in np.unique(clip)[:6]:
        pose = poses[clip == name][:40]
        motion = BodyMotion(pose, np.zeros((len(pose), 3)), np.zeros(10), rest, 30.0)
        for folder, suffix, write in (("amass", ".npz", write_amass), ("bvh", ".bvh", write_bvh)):
            path = directory / folder / str(name) / f"take{suffix}"
            path.parent.mkdir(parents=True)
            write(path, motion)
    (directory / "amass" / "broken.npz").write_bytes(b"PK")
    return directory


SOURCES = {
    "amass": ["data.source.path={}/amass"],
    "bvh": ["data.source.path={}/bvh", "data.source.rate_hz=30"],
    "npz": ["data.source.path={}/plain.npz", "data.synthesis.heading=source"],
    "mixed": ["data.source.weights.bvh=1", "data.source.sources.bvh.path={}/bvh"],
}


def overrides_of(source, motions):
    return [f"data/source={source}", *(line.format(motions) for line in SOURCES[source])]


@pytest.mark.slow
@pytest.mark.parametrize("source", SOURCES)
def test_a_run_trains_on_a_source_and_is_tested_on_another(
    source, motions, smoke_config, tmp_path, monkeypatch
):
    typed = overrides_of(source, motions)
    cfg = smoke_config(tmp_path, "experiment=detector/cascade", "callbacks.pictures=null", *typed)
    metrics = train(cfg)
    assert metrics["test/mpjpe"] > 0
    checkpoint = Path(cfg.paths.run_dir) / "checkpoints" / "best.ckpt"
    results = {}
    for other in ("npz", "embedded"):
        typed = ["data/source=embedded"] if other == "embedded" else overrides_of(other, motions)[:2]
        typed.append("data.synthesis.heading=histogram")
        monkeypatch.setattr("ljn.tasks.evaluate.typed_overrides", lambda typed=typed: typed)
        call = smoke_config(tmp_path, "task=evaluate", f"ckpt_path={checkpoint}", *typed)
        results[other] = evaluate(call)["test/mpjpe"]
        again = evaluate(smoke_config(tmp_path, "task=evaluate", f"ckpt_path={checkpoint}", *typed))
        assert again["test/mpjpe"] == results[other]
    assert results["npz"] != results["embedded"]


@pytest.mark.slow
def test_the_thesis_s_table_runs_from_a_source_by_overrides(motions, run_py, tmp_path):
    run_py(
        *("sweep=table_3_2", "preset=smoke", "logger=csv", "callbacks.pictures=null", "data.num_workers=0"),
        *("data/source=amass", f"data.source.path={motions}/amass", f"paths.output_dir={tmp_path}"),
        timeout=600,
    )
    assert "| proposed" in next((tmp_path / "sweeps").rglob("table*.md")).read_text().lower()
