import re
from pathlib import Path

import pytest
from hydra.errors import ConfigCompositionException
from omegaconf import open_dict

from datamodules.synthesis import SynthesisSettings
from ljn.building import build, build_each, check_targets
from ljn.cloud.observation import ObservationRecipe
from ljn.report.tables import TABLES
from ljn.tasks.validation import validate

CONF = Path(__file__).parents[2] / "conf"
GROUPS = sorted(
    f"{path.parent.relative_to(CONF)}={path.stem}"
    for path in CONF.rglob("*.yaml")
    if path.parent != CONF and path.relative_to(CONF).parts[0] not in ("hydra", "local", "experiment")
)
EXPERIMENTS = sorted(
    f"experiment={path.relative_to(CONF / 'experiment').with_suffix('')}"
    for path in (CONF / "experiment").rglob("*.yaml")
)


NEEDS = {
    "sweep=search": ("hydra_plugins.hydra_optuna_sweeper", "optuna"),
    "logger=tensorboard": ("tensorboard",) * 2,
}


@pytest.mark.parametrize("choice", GROUPS + EXPERIMENTS)
def test_every_config_composes_validates_and_builds(choice, compose_config, tmp_path):
    if choice in NEEDS:
        module, extra = NEEDS[choice]
        pytest.importorskip(module, reason=f"{module} is not installed: pip install -e '.[{extra}]'")
    overrides = [choice, f"paths.output_dir={tmp_path}"]
    partners = {"module=yardstick": "model=ridge", "module=mesh_regressor": "model=body_network"}
    partners |= dict.fromkeys(("model=ridge", "model=mean_offset"), "module=yardstick")
    of_bodies = [
        f"model={name}"
        for name in ("body_network", "body_network_on_pointnet", "direct_body_network", "kinematic")
    ]
    partners |= dict.fromkeys(of_bodies, "module=mesh_regressor")
    partners |= {"model=cpn": "module=keypoint_detector", "module=keypoint_detector": "model=cpn"}
    partners |= {f"data/photo={name}": "data=rgb" for name in ("plain", "realistic")}
    if choice in partners:
        overrides.append(partners[choice])
    if choice == "data/source=surreal_rgb":
        overrides += ["data=rgb", "data/photo=plain"]
    if "model=cpn" in overrides:
        overrides.append("optimized_metric=val/keypoint_error_px")
    cfg = compose_config(*overrides, return_hydra_config=True)
    with open_dict(cfg):
        del cfg["hydra"]
        cfg.paths.run_dir = str(tmp_path)
    validate(cfg)
    build(cfg.data)
    build(cfg.module)
    build(cfg.trainer, logger=build_each(cfg.logger), callbacks=build_each(cfg.callbacks))


def test_a_network_of_the_other_stage_is_refused(compose_config):
    with pytest.raises(
        ValueError, match=r"net: a JointDetector takes a Detector, got a Hierarchical.*module="
    ):
        build(compose_config("model=body_network").module)
    with pytest.raises(
        ValueError, match=r"net: a MeshRegressor takes a BodyNetwork, got a LocalJointNetwork"
    ):
        build(compose_config("module=mesh_regressor").module)


def test_every_experiment_opens_with_the_command_that_runs_it():
    for choice in EXPERIMENTS:
        name = choice.removeprefix("experiment=")
        text = (CONF / "experiment" / f"{name}.yaml").read_text()
        assert text.startswith(f"# @package _global_\n# python run.py experiment={name}\n"), name
        assert re.search(rf"^name: {name}$", text, re.MULTILINE), name


@pytest.mark.parametrize("preset", sorted(path.stem for path in (CONF / "preset").glob("*.yaml")))
def test_every_network_composes_with_every_preset(preset, compose_config, tmp_path):
    for experiment in ("detector/proposed", "detector/basic", "mesh/proposed", "mesh/basic", "mesh/pointnet"):
        cfg = compose_config(f"preset={preset}", f"experiment={experiment}", f"paths.output_dir={tmp_path}")
        validate(cfg)
        of_stage = cfg.preset.mesh if experiment.startswith("mesh") else cfg.preset
        assert cfg.module.optimizer.lr == of_stage.learning_rate


def test_the_thesis_figures_in_comments_are_those_of_the_tables():
    columns = {"APVE": "apve", "MPJPE": "mpjpe_eq38", "PCKh": "pckh"}
    commented = set()
    for name in (choice.removeprefix("experiment=") for choice in EXPERIMENTS):
        text = (CONF / "experiment" / f"{name}.yaml").read_text()
        figures = re.findall(r"([\d.]+) (?:mm|%) (APVE|MPJPE|PCKh)", text)
        if not figures:
            continue
        [table] = re.findall(r"Table 3\.(\d)", text)
        [row] = [row for row in TABLES[f"table_3_{table}"].rows if row.experiment == name]
        expected = {key: row.thesis[key] for key in columns.values() if key in row.thesis}
        assert {columns[label]: float(value) for value, label in figures} == expected, name
        commented.add(name)
    assert commented == {row.experiment for table in TABLES.values() for row in table.rows if row.thesis}


def test_the_cosine_of_the_small_preset_ends_with_the_training(compose_config):
    assert compose_config("preset=small", "trainer.max_epochs=20").module.scheduler.T_max == 20


def test_the_thesis_preset_holds_the_specs_numbers(compose_config):
    cfg = compose_config("preset=thesis", "experiment=detector/proposed")
    assert (cfg.data.num_train, cfg.data.num_val, cfg.data.num_test) == (60000, 5000, 15000)
    assert (cfg.data.observation.num_points, cfg.model.group_size) == (4096, 128)
    assert cfg.module.optimizer._target_ == "torch.optim.RAdam"
    assert (cfg.module.scheduler.step_size, cfg.module.scheduler.gamma) == (5, 0.1)
    assert cfg.data.observation.normals == "knn"
    cfg = compose_config("preset=thesis", "experiment=mesh/proposed")
    mesh, module = cfg.model, cfg.module
    assert (mesh.trunk.num_centres, mesh.trunk.group_sizes) == ([512, 128], [32, 64])
    assert mesh.trunk.channels == [[64, 64, 128], [128, 128, 256]]
    assert mesh.trunk.global_channels == [256, 512, 1024]
    assert (mesh.trunk.carried_channels, mesh.rotation, cfg.data.batch_size) == (None, "rotvec", 16)
    assert (module.optimizer._target_, module.optimizer.lr) == ("torch.optim.RAdam", 1e-3)
    assert (module.loss, module.loss_vertices, module.joint_weight) == ("squared", None, 0)
    pointnet = compose_config("preset=thesis", "experiment=mesh/pointnet").model.trunk
    assert (pointnet.local_channels, pointnet.global_channels) == ([64, 64], [64, 128, 1024])


@pytest.mark.parametrize("preset", ["thesis", "small"])
def test_the_rows_of_the_mesh_regressors_share_one_protocol(preset, compose_config):
    rows = [
        compose_config(f"preset={preset}", f"experiment=mesh/{name}")
        for name in ("proposed", "single", "pointnet", "basic")
    ]
    for row in rows[1:]:
        assert row.data == rows[0].data
        for key in ("loss", "loss_vertices", "joint_weight", "optimizer", "scheduler"):
            assert row.module[key] == rows[0].module[key]
        assert row.model.rotation == rows[0].model.rotation


@pytest.mark.parametrize(("override", "name"), [("data.num_pionts=3", "num_pionts"), ("seed=many", "seed")])
def test_a_misspelt_key_and_a_value_of_the_wrong_type_are_rejected(override, name, compose_config):
    with pytest.raises(ConfigCompositionException, match=name):
        compose_config(override)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["model.radii_m=[0.2,0.3]"], r"model\.radii_m: expected 24 radii, one for each joint \(pelvis.*got 2"),
        (["model.radii_m=0.2"], r"model\.radii_m: expected 24 radii.*got 0\.2"),
        (["data.observation.num_points=0"], r"data\.observation\.num_points: expected an integer of 1 or more, got 0"),
        (["data.batch_size=null"], r"data\.batch_size: expected an integer of 1 or more, got None"),
        (["data.eval_seed=-1"], r"data\.eval_seed: expected an integer of 0 or more, got -1"),
        (
            ["experiment=mesh/proposed", "data.observation.num_points=100"],
            r"preset\.mesh\.num_centres\): expected at most data\.observation\.num_points=100 .*got \[128, 32\]; set "
            r"data\.observation\.num_points=128 or more, or preset\.mesh\.num_centres=\[100,32\]",
        ),
        (
            ["experiment=mesh/basic", "preset.mesh.num_centres=[16,32]"],
            r"expected no number greater than the one before, got \[16, 32\].*set preset\.mesh\.num_centres=\[32,16\]",
        ),
        (
            ["experiment=mesh/proposed", "preset.mesh.group_sizes=[0,4]"],
            r"preset\.mesh\.group_sizes\): expected an integer of 1 or more .*got \[0, 4\]",
        ),
        *(
            ([f"preset.learning_rate={rate}"], r"module\.optimizer\.lr: expected a positive finite number")
            for rate in ("0", "nan", "null", "true")
        ),
        (["num_threads=-2"], r"num_threads: expected 1 or more, or null, got -2"),
        (["callbacks.best.monitor=val/mjpe"], r"callbacks\.best\.monitor: no metric 'val/mjpe'.*val/mpjpe"),
        (["optimized_metric=val/pckh"], r"callbacks\.best\.mode: 'min' would keep the worst.*mode=max"),
        (["optimized_metric=val/initial_mean_distance_px"], r"callbacks\.best\.monitor: .* describes the data"),
        (["tables=[table_9]"], r"tables: expected some of table_3_2.*got table_9"),
        (["model._target_=os.system"], r"model: `_target_: os\.system` is outside the modules"),
        (["paths.cache_dir=/dev/null/x"], r"paths\.cache_dir: cannot write in '/dev/null/x'"),
        (["paths.output_dir=/dev/null/x"], r"paths\.output_dir: cannot write in '/dev/null/x'.*choose another"),
    ],
)  # fmt: skip
def test_what_types_cannot_say_is_validated(overrides, message, compose_config, tmp_path):
    cfg = compose_config(f"paths.output_dir={tmp_path}", *overrides)
    with pytest.raises(ValueError, match=message):
        validate(cfg)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("data.synthesis.distance_m=2", "distance_m: expected two numbers, lowest and highest, got 2"),
        ("data.synthesis.distance_m=[3,1]", "distance_m: expected 0 < lowest <= highest"),
        ("data.synthesis.depth_noise_m=nan", "depth_noise_m: expected a number of 0 or more, got nan"),
        ("data.synthesis.margin_px=300", "margin_px: a clear border of 300"),
        ("data.synthesis.heading=sideways", "heading: expected one of source, histogram, uniform, got 'sideways'"),
    ],
)  # fmt: skip
def test_bad_values_of_the_data_are_named_when_it_is_built(override, message, compose_config):
    with pytest.raises(ValueError, match=message):
        build(compose_config(override).data)


@pytest.mark.parametrize(
    "target",
    [
        "os.system", "builtins.eval", "torch.load", "ljn.runs.record.subprocess.run", "ljn.tasks.train.os.system",
        "datamodules.cache.shutil.rmtree", "lightning.pytorch.trainer.trainer.os.system",
        "torch.optim.optimizer.torch.load", "lightning.pytorch.cli.instantiate_class",
        "lightning.pytorch.cli.LightningCLI", "lightning.pytorch.profilers.SimpleProfiler", "ljn.tasks.train.train",
        "ljn.nets.layers.perceptron", "ljn.nets.layers.no_such_thing",
    ],
)  # fmt: skip
def test_a_target_cannot_reach_code_outside_the_allow_list(target):
    with pytest.raises(ValueError, match="_target_"):
        check_targets({"module": {"net": [{"_target_": target}]}})


def test_settings_objects_have_the_defaults_of_their_yaml(compose_config):
    data = compose_config("preset=thesis").data
    assert build(data.synthesis) == SynthesisSettings()
    assert build(data.observation) == ObservationRecipe(normals="knn")


def test_no_config_reaches_an_object(compose_config, tmp_path):
    from omegaconf import DictConfig, ListConfig

    cfg = compose_config("experiment=detector/proposed", f"paths.run_dir={tmp_path}", "tags=[a,b]")
    module, data = build(cfg.module), build(cfg.data)
    parts = [data, data.camera, data.synthesis, data.observation, data.source]
    for owner in (module, module.net, *parts, *build_each(cfg.callbacks), *build_each(cfg.logger)):
        for name, value in vars(owner).items():
            assert not isinstance(value, DictConfig | ListConfig), name
