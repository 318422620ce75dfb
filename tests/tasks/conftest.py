import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

ROOT = Path(__file__).parents[2]
SMOKE = ("preset=smoke", "logger=csv", "data.num_workers=0")


@pytest.fixture(autouse=True)
def keep_num_threads():
    """Tasks set the number of threads; other tests should not notice."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def smoke_config(compose_config):
    """A configuration that trains in seconds, writing below a directory."""

    def make(directory, *overrides):
        return compose_config(*SMOKE, f"paths.output_dir={directory}", *overrides)

    return make


@pytest.fixture(scope="session")
def run_py():
    """Call run.py as a user does; returns the finished process."""

    def call(*arguments, check=True, timeout=300):
        done = subprocess.run(
            [sys.executable, "run.py", *arguments],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=timeout,
            env=os.environ | {"OMP_NUM_THREADS": "1", "WANDB_MODE": "offline"},
        )
        assert not check or done.returncode == 0, done.stdout + done.stderr
        return done

    return call


@pytest.fixture(scope="session")
def trained(smoke_config, tmp_path_factory):
    """A finished smoke run: its metrics and its directory."""
    from ljn.tasks.train import train

    directory = tmp_path_factory.mktemp("trained")
    cfg = smoke_config(directory, "experiment=detector/proposed")
    metrics = train(cfg)
    return metrics, Path(cfg.paths.run_dir)


@pytest.fixture(scope="session")
def write_checkpoint(smoke_config, tmp_path_factory):
    """Write the checkpoint of an experiment's untrained module as a run does; returns its path."""
    from ljn.body import load_body_models
    from ljn.building import build
    from ljn.runs.checkpoints import Provenance

    data_hashes = [body.hash for body in load_body_models(None, ["female", "male"])]

    def make(experiment, *overrides):
        directory = tmp_path_factory.mktemp("checkpoint")
        cfg = smoke_config(directory, f"experiment={experiment}", f"paths.run_dir={directory}", *overrides)
        torch.manual_seed(0)
        module = build(cfg.module)
        content = {"state_dict": module.state_dict(), "epoch": 0}
        config = OmegaConf.to_container(cfg, resolve=True)
        body_hash = "-".join(sorted({*data_hashes, *module.body_hashes}))
        data = build(cfg.data)
        detector = None if data.detector_file is None else data.detector_file.read_bytes()
        provenance = Provenance(config, body_hash, "none", experiment, data.recipe, detector)
        provenance.on_save_checkpoint(None, module, content)
        path = directory / f"{experiment.replace('/', '_')}.ckpt"
        torch.save(content, path)
        return path

    return make


@pytest.fixture(scope="session")
def checkpoints(write_checkpoint):
    """Checkpoints of an untrained joint detector and an untrained mesh regressor."""
    return [write_checkpoint("detector/proposed"), write_checkpoint("mesh/proposed")]
