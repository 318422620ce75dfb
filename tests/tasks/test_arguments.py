import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from ljn.tasks.arguments import prepare_arguments


def value_of(argument):
    [override] = OverridesParser.create().parse_overrides(prepare_arguments([argument]))
    assert not override.is_sweep_override()
    return override.value()


@pytest.mark.parametrize(
    "name",
    [
        "2023_04_01",
        "1e3",
        "seq=1",
        "my frames (1)",
        "héllo",
        "it's",
        'a "b"',
        "end\\",
        "a: b",
        "-",
        "true",
        "x",
    ],
)
def test_a_path_reaches_its_task_as_it_was_typed(name):
    assert value_of(f"task.input={name}") == name


@pytest.mark.parametrize("name", ["frame,1", "[1]", "'quoted'", "null", "glob(x)"])
def test_so_does_one_that_could_mean_something_else_where_it_exists(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert prepare_arguments([f"ckpt_path={name}"]) == [f"ckpt_path={name}"]
    (tmp_path / name).mkdir()
    assert value_of(f"ckpt_path={name}") == name


def test_home_is_found(monkeypatch):
    monkeypatch.setenv("HOME", "/home/of me")
    assert value_of("body.path=~/bodies") == "/home/of me/bodies"


def test_all_else_is_left_alone():
    for argument in (
        *("ckpt_path='a b'", "ckpt_path=", "task.input=${paths.output_dir}/x", "data.batch_size=5", "-m"),
        *("preset.name=a=b", "experiment=a,b", "ckpt_path", "~data.source"),
    ):
        assert prepare_arguments([argument]) == [argument]
    assert prepare_arguments(prepare_arguments(["ckpt_path=a=b"])) == ["ckpt_path='a=b'"]


def test_a_key_that_has_moved_is_named(run_py):
    done = run_py("input=depth.png", check=False)
    assert done.returncode == 1
    assert (
        done.stderr
        == "error: input: only task=predict and task=ar read this; add task=predict, or leave it out\n"
    )
    assert prepare_arguments(["task=predict", "input=a=b.png"]) == ["task=predict", "task.input='a=b.png'"]


def test_a_short_key_that_is_no_path_is_left_unquoted():
    given = ["task=predict", "strict=true", "mask_id=3"]
    assert prepare_arguments(given) == ["task=predict", "task.strict=true", "task.mask_id=3"]


def test_a_key_of_several_tasks_is_short_in_each():
    for task in ("task=predict", "task=demo", "task=package"):
        assert prepare_arguments([task, "mesh_ckpt_path=a=b"]) == [task, "task.mesh_ckpt_path='a=b'"]
    with pytest.raises(
        ValueError,
        match="mesh_ckpt_path: only task=predict, task=ar, task=demo, task=package and task=benchmark read this",
    ):
        prepare_arguments(["task=train", "mesh_ckpt_path=x"])


@pytest.mark.parametrize(
    ("argument", "extra"),
    [("hydra/launcher=parallel", "sweep"), ("hydra/launcher=slurm", "sweep"), ("sweep=search", "optuna")],
)
def test_a_plugin_that_is_missing_is_named_with_its_command(argument, extra, monkeypatch):
    monkeypatch.setattr("ljn.tasks.arguments.find_spec", lambda name: None)
    with pytest.raises(ImportError, match=rf"{argument}: .*pip install -e '\.\[{extra}\]'"):
        prepare_arguments(["-m", argument])
    assert prepare_arguments(["hydra/launcher=basic"]) == ["hydra/launcher=basic"]
