import shutil
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path

import pytest
from omegaconf import OmegaConf, open_dict

from ljn.runs.identity import config_hash, identity
from ljn.runs.keys import CONFIG_GROUPS, KEYS, Key, is_listed, kind_of
from ljn.runs.sweep import settings
from ljn.tasks.schema import Config

CONF = Path(__file__).parents[2] / "conf"


def leaves(value, key=""):
    """The dotted keys of all values in nested mappings, and the values."""
    if isinstance(value, Mapping) and value:
        for name, entry in value.items():
            yield from leaves(entry, f"{key}.{name}".lstrip("."))
    else:
        yield key, value


def keys_of(conf):
    """All that can be set: the schema's keys, each folder as a group, each file's keys in their package."""
    keys = {field.name for field in fields(Config)}
    for path in conf.rglob("*.yaml"):
        group = ".".join(path.parent.relative_to(conf).parts)
        content = OmegaConf.to_container(OmegaConf.load(path), resolve=False)
        content.pop("defaults", None)
        package = "" if "@package _global_" in path.read_text() else group
        keys |= {group, *(key for key, _ in leaves(content, package))}
    return keys - {""}


def test_every_key_has_a_row_and_every_row_a_key():
    keys = keys_of(CONF)
    assert [key for key in sorted(keys) if not is_listed(key)] == []
    # conf/local is the user's own; a chosen group is no value.
    unused = {row for row in KEYS if not any(key == row or key.startswith(f"{row}.") for key in keys)}
    assert unused == {"local"}


@pytest.mark.parametrize(
    ("file", "line", "key"),
    [
        ("config.yaml", "new: null", "new"),
        ("data/synthetic.yaml", "new: null", "data.new"),
        ("module/mesh_regressor.yaml", "new: {nested: null}", "module.new.nested"),
        ("callbacks/default.yaml", "new: null", "callbacks.new"),
        ("experiment/mesh/chain.yaml", "data: {new: 1}", "data.new"),
        ("data/lens/wide.yaml", "new: null", "data.lens.new"),
        ("data/lens/wide.yaml", "", "data.lens"),
        ("sensor/kinect.yaml", "new: null", "sensor.new"),
    ],
)
def test_a_new_key_without_a_row_is_noticed(file, line, key, tmp_path):
    conf = shutil.copytree(CONF, tmp_path / "conf")
    (conf / file).parent.mkdir(parents=True, exist_ok=True)
    with (conf / file).open("a") as stream:
        stream.write(f"\n{line}\n")
    assert key in {key for key in keys_of(conf) if not is_listed(key)}


def test_what_a_checkpoint_holds():
    groups = "preset model module data body trainer seed name optimized_metric"
    assert sorted(CONFIG_GROUPS) == sorted(groups.split())


def hash_of(cfg, data="data"):
    return config_hash(identity(cfg, data))


@pytest.mark.parametrize("experiment", ["detector/proposed", "mesh/proposed", "detector/ridge"])
def test_the_values_of_the_runs_keys_alone_are_its_identity(experiment, compose_config, monkeypatch):
    monkeypatch.setattr("ljn.runs.identity.predicted_body", lambda cfg: "body")
    cfg = compose_config(f"experiment={experiment}", "paths.run_dir=run")
    plain = OmegaConf.create(OmegaConf.to_container(cfg, resolve=True))
    keys = [key for key, _ in leaves(OmegaConf.to_container(plain))]
    for key in keys:
        OmegaConf.update(plain, key, f"value of {key}")
    kept = {key for key, value in leaves(identity(plain, "data")) if value == f"value of {key}"}
    assert kept == {key for key in keys if Key.RUN in kind_of(key)}


def test_what_differs_in_the_machine_or_the_call_alone_is_one_run(compose_config):
    same = hash_of(compose_config("experiment=detector/proposed"))
    assert hash_of(compose_config("experiment=detector/proposed"), "other") != same
    neutral = """
        paths.output_dir=elsewhere logger=csv group=sweep num_threads=3 preset.name=other data.num_workers=7
        data.prefetch_batches=2 callbacks.pictures=null trainer.accelerator=cpu trainer.devices=2 trainer.strategy=ddp
        data.synthesis.keypoint_noise_px=10.0 data.source.path=the_same_content_elsewhere.npz
    """
    assert hash_of(compose_config("experiment=detector/proposed", *neutral.split())) == same
    for override in (
        *("preset.num_points=512", "+trainer.accumulate_grad_batches=2", "callbacks.best.mode=max"),
        "+callbacks.stop={_target_:lightning.pytorch.callbacks.EarlyStopping,monitor:val/mpjpe}",
    ):
        assert hash_of(compose_config("experiment=detector/proposed", override)) != same, override


def test_a_new_knob_that_is_null_changes_no_identity(compose_config):
    cfg = compose_config("experiment=detector/proposed")
    with open_dict(cfg):
        cfg.data.steps = [{"sigma": 1}, None]
        same = hash_of(cfg)
        cfg.data.new = cfg.data.camera.new = cfg.module.optimizer.new = cfg.data.steps[0].new = None
        cfg.data.sensor = {"noise": None, "holes": {"share": None}}
        assert hash_of(cfg) == same
        cfg.data.steps = [{"sigma": 1}]  # the places of a list count
        assert hash_of(cfg) != same


def test_settings_are_what_tells_rows_apart():
    typed = (
        "experiment=detector/basic", "seed=3", "sweep=demo", "preset=small", "data.num_workers=2", "name=x",
        "hydra/launcher=local", "logger=csv", "callbacks.pictures=null", "trainer.devices=2", "rerun=true",
    )  # fmt: skip
    kept = (
        "+trainer.new=1", "ckpt_path=a.ckpt", "data.observation.num_points=512", "data/source=embedded",
        "debug=overfit", "model=ridge", "preset.num_train=8", "task=evaluate", "~callbacks.best",
    )  # fmt: skip
    assert settings(typed + kept, "small") == tuple(sorted(kept))
