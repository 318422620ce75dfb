"""Sweeps whose jobs run side by side, and searches: plugins of Hydra, as extras."""

import json

import pytest
from omegaconf import OmegaConf

JOBS = ("preset=smoke", "logger=csv", "data.num_workers=0", "callbacks.pictures=null")


def needs(plugin, extra):
    pytest.importorskip(
        f"hydra_plugins.{plugin}", reason=f"{plugin} is not installed: pip install -e '.[{extra}]'"
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("launcher", "plugin"),
    [
        ("joblib", "hydra_joblib_launcher"),
        ("parallel", "hydra_joblib_launcher"),
        ("local", "hydra_submitit_launcher"),
    ],
)
def test_jobs_side_by_side_leave_complete_records(launcher, plugin, run_py, tmp_path):
    needs(plugin, "sweep")
    names = ("detector/basic", "detector/mean_offset")
    run_py(
        *("-m", f"hydra/launcher={launcher}", *JOBS),
        *(f"experiment={','.join(names)}", f"paths.output_dir={tmp_path}"),
    )
    records = [json.loads(path.read_text()) for path in tmp_path.glob("runs/*/record.json")]
    assert sorted(record["name"] for record in records) == sorted(names)
    assert [record["status"] for record in records] == ["complete", "complete"]


@pytest.mark.parametrize("launcher", ["parallel", "local", "slurm"])
def test_a_launchers_defaults_compose(launcher, compose_config):
    needs("hydra_submitit_launcher", "sweep")
    needs("hydra_joblib_launcher", "sweep")
    cfg = compose_config(f"hydra/launcher={launcher}", return_hydra_config=True).hydra.launcher
    if launcher == "parallel":
        assert cfg.n_jobs == 2
    else:
        assert (cfg.tasks_per_node, cfg.nodes) == (1, 1)
    if launcher == "slurm":
        assert cfg.gpus_per_node == 1


def test_a_search_varies_rates_radii_and_width(compose_config):
    needs("hydra_optuna_sweeper", "optuna")
    changed = compose_config("sweep=search", "preset.limb_radius_m=0.11", "preset.trunk_radius_m=0.44")
    expected = [0.44 if radius == 0.30 else 0.11 for radius in compose_config().model.radii_m]
    assert list(changed.model.radii_m) == expected
    assert list(compose_config("sweep=search").model.radii_m) == list(compose_config().model.radii_m)


@pytest.mark.slow
def test_a_search_runs_its_trials_and_names_the_best(run_py, tmp_path):
    needs("hydra_optuna_sweeper", "optuna")
    run_py("sweep=search", *JOBS, "hydra.sweeper.n_trials=2", f"paths.output_dir={tmp_path}")
    scores, rates = [], []
    for run_dir in tmp_path.glob("runs/*"):
        assert json.loads((run_dir / "record.json").read_text())["status"] == "complete"
        scores.append(json.loads((run_dir / "metrics.json").read_text())["val/mpjpe"])
        rates.append(OmegaConf.load(run_dir / "config.yaml").module.optimizer.lr)
    assert len(set(rates)) == 2
    [path] = tmp_path.glob("multirun/*/optimization_results.yaml")
    best = OmegaConf.load(path)
    assert best.best_value == pytest.approx(min(scores))
    assert best.best_params["preset.learning_rate"] == rates[scores.index(min(scores))]
