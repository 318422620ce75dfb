import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save

import ljn.building
from ljn import Pipeline
from ljn.building import build
from ljn.cloud.observation import ObservationRecipe
from ljn.cloud.rgb import RgbRecipe
from ljn.modules.joint_detector import JointDetector
from ljn.pipeline.keypoint_finder import KeypointFinder
from ljn.runs import packages
from ljn.runs.checkpoints import CHECKPOINT_VERSION, Provenance, load_module, read_checkpoint
from ljn.runs.packages import PRECISIONS, SHIPPED, find_package, stages_of, write_package

INDEX = json.loads((SHIPPED / "index.json").read_text())
MOST_BYTES = 15e6
"""Of all shipped packages together."""


def about(**changes):
    """What a package says of a tiny detector."""
    net = {
        "_target_": "ljn.nets.simple_baseline.SimpleBaseline",
        "channels": 64,
        "num_blocks": 1,
        "dropout": 0.5,
    }
    config = {
        **{key: {} for key in ("preset", "body", "trainer")},
        "model": net,
        "module": {"_target_": "ljn.modules.joint_detector.JointDetector", "net": dict(net)},
        **{"data": {}, "seed": 0, "name": "tiny", "optimized_metric": "val/mpjpe"},
    }
    texts = {"body_hash": "0123456789abcdef", "data_licence": "none", "run": "tiny"}
    entry = {"version": CHECKPOINT_VERSION, "config": config, **texts, "observation": None, "epoch": 3}
    return {"detector": entry | changes}


def state(stages=None):
    torch.manual_seed(0)
    return {"detector": build((stages or about())["detector"]["config"]["module"]).state_dict()}


@pytest.fixture
def package(tmp_path):
    """A package's file of a tiny detector."""
    path = tmp_path / "tiny.safetensors"
    write_package(path, "tiny", "CC0-1.0", about(), state())
    return path


@pytest.fixture
def shipped(package, monkeypatch):
    """The same as one that ships."""
    monkeypatch.setattr(packages, "SHIPPED", package.parent)
    return package


def with_text(package, edit):
    """The package with what it says of itself edited."""
    data = package.read_bytes()
    end = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:end])
    text = json.loads(header["__metadata__"]["ljn"])
    edit(text)
    header["__metadata__"] = {"ljn": json.dumps(text)}
    written = json.dumps(header).encode()
    package.write_bytes(len(written).to_bytes(8, "little") + written + data[end:])
    return package


def test_a_package_is_read_as_the_checkpoint_that_it_was_made_of(package):
    checkpoint = read_checkpoint(package)
    assert (checkpoint.run, checkpoint.epoch, checkpoint.recipe) == ("tiny", 4, None)
    assert checkpoint.config == about()["detector"]["config"]
    assert checkpoint.file_hash == hashlib.sha256(package.read_bytes()).hexdigest()[:16]
    module, _ = load_module(package, JointDetector)
    assert not module.training
    for name, value in state()["detector"].items():
        stored = module.state_dict()[name]
        assert stored.dtype == value.dtype
        if value.is_floating_point():
            assert (stored - value).norm() <= 0.01 * value.norm() + 1e-6
        else:
            assert torch.equal(stored, value)


@pytest.mark.parametrize("recipe", [ObservationRecipe(64, spacing_m=0.01), RgbRecipe(64, 32), None])
def test_the_recipe_of_a_checkpoint_comes_back(recipe, package):
    content = Provenance({}, "", "", "", recipe).content["observation"]
    read = read_checkpoint(with_text(package, set_stage(observation=content)))
    assert read.recipe == recipe


def test_equal_weights_are_equal_files_whatever_was_there(package, tmp_path):
    before = package.read_bytes()
    write_package(package, "tiny", "CC0-1.0", about(), state())
    assert package.read_bytes() == before
    write_package(tmp_path / "half.safetensors", "half", "CC0-1.0", about(), state(), "half")
    index = json.loads((tmp_path / "index.json").read_text())
    assert set(index) == {"half", "tiny"}
    assert index["tiny"] == {"bytes": len(before), "sha256": hashlib.sha256(before).hexdigest()}
    assert not list(tmp_path.glob("*.tmp"))


@pytest.mark.parametrize("shape", [(96, 64), (24, 16, 32)])
def test_int8_is_within_half_a_step_of_each_row(shape):
    torch.manual_seed(0)
    weight = torch.randn(shape) * torch.logspace(-6, 3, shape[-2])[:, None]
    weight[..., 3, :] = 0
    stored = {f"a.{name}": value for name, value in PRECISIONS["int8"]("x", weight).items()}
    assert stored["a.x"].dtype == torch.int8
    back = packages._state(stored, "a.")["x"]
    step = weight.abs().amax(-1, keepdim=True) / 127
    # Half a step, the rounding of its half-precision scale, and that scale's smallest number.
    assert bool(((back - weight).abs() <= step * (0.5 + 127 * 2**-11) + 127 * 2**-25).all())
    assert bool((back[..., 3, :] == 0).all())


@pytest.mark.parametrize(
    "value", [torch.ones(10), torch.ones(4, 5), torch.ones(8, 8, 8, 8), torch.tensor([1e5]), torch.tensor(3)]
)
def test_small_entries_convolutions_and_numbers_that_half_precision_lacks_keep_their_values(value):
    stored = PRECISIONS["int8"]("x", value)
    assert list(stored) == ["x"]
    assert torch.equal(stored["x"].to(value.dtype), value)


def test_an_unknown_precision_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"precision: expected one of int8, half, got 'int4'"):
        write_package(tmp_path / "x.safetensors", "x", "CC0-1.0", about(), state(), "int4")


def set_stage(**values):
    return lambda text: text["stages"]["detector"].update(values)


def set_config(group, **values):
    return lambda text: text["stages"]["detector"]["config"][group].update(values)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda text: text.update(version=2), r"another version of this library \(package version 2, .*update"),
        (lambda text: text.clear(), "says nothing of a configuration"),
        (lambda text: text.pop("licence"), "expected a package's name, licence and stages"),
        (lambda text: text.update(stages={}), "expected a package's name, licence and stages"),
        (lambda text: text.update(stages={"os": {}}), "expected a package's name, licence and stages"),
        (lambda text: text.update(stages={"mesh": text["stages"]["detector"]}), "holds mesh alone, but no detector"),
        (lambda text: text.update(name="x" * 10**6), "damaged"),
        (set_stage(version=CHECKPOINT_VERSION + 1), "a newer version of this library"),
        (set_stage(run=3), "no whole configuration"),
        (set_stage(epoch="3"), "no whole configuration"),
        (set_stage(config=[]), "no whole configuration"),
        (set_stage(observation={"num_points": 3, "x": 1}), "unexpected keyword"),
        (set_stage(observation={"_target_": "os.system"}), r"expected one of ljn\..*, got 'os\.system'"),
        (set_stage(observation={"_target_": "ljn.cloud.rgb.RgbRecipe", "width_px": 3}), "width_px: expected"),
        (set_config("module", _target_="os.system"), r"os\.system"),
        (set_config("module", net={"_target_": "subprocess.Popen"}), r"subprocess\.Popen"),
        (set_config("preset", name="${oc.env:HOME}"), "no whole configuration"),
    ],
)  # fmt: skip
def test_odd_packages_are_refused(edit, message, package):
    with pytest.raises(ValueError, match=rf"ckpt_path: '.*tiny\.safetensors'.*{message}"):
        read_checkpoint(with_text(package, edit))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda tensors: tensors.update({"detector.net.more": torch.ones(2)}), ""),
        (lambda tensors: tensors.pop(scale_of(tensors)), "int8 without a scale"),
        (lambda tensors: tensors.pop(scale_of(tensors).removesuffix(":scale")), "a scale of nothing"),
        (lambda tensors: tensors.update({"detector.lost:scale": torch.ones(1, 1)}), "a scale of nothing"),
        (lambda tensors: tensors.update({scale_of(tensors): torch.ones(1, 1)}), "its scale do not fit"),
        (lambda tensors: tensors[scale_of(tensors)].fill_(torch.nan), "expected finite numbers"),
    ],
)
def test_weights_that_do_not_fit_are_refused(change, message, package):
    data = package.read_bytes()
    text = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])["__metadata__"]
    tensors = packages.load(data)
    change(tensors)
    package.write_bytes(save(tensors, text))
    with pytest.raises(ValueError, match=rf"ckpt_path: '.*tiny\.safetensors'.*{message}"):
        load_module(package, JointDetector)


def scale_of(tensors):
    return next(name for name in tensors if name.endswith(":scale"))


def test_another_programs_file_is_no_package(tmp_path):
    path = tmp_path / "foreign.safetensors"
    path.write_bytes(save({"weight": torch.ones(2)}, {"format": "pt"}))
    with pytest.raises(ValueError, match="no package that task=package of this library wrote"):
        read_checkpoint(path)
    path.write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(ValueError, match="damaged, truncated or no package at all"):
        read_checkpoint(path)


def test_a_damaged_package_is_refused_in_our_words_or_loads(package):
    whole = package.read_bytes()
    header = 8 + int.from_bytes(whole[:8], "little")
    rng = np.random.default_rng(0)
    refusals = []
    for number in range(120):
        data = bytearray(whole)
        if number % 5 == 0:
            data = data[: rng.integers(len(data))]
        else:
            for _ in range(rng.integers(1, 4)):
                data[rng.integers(header if number % 5 < 4 else len(data))] ^= 1 << rng.integers(8)
        package.write_bytes(data)
        try:
            load_module(package, JointDetector)
        except ValueError as error:
            refusals.append(str(error))
    assert len(refusals) > 50
    for refusal in refusals:
        assert refusal.startswith("ckpt_path: ")
        assert f"'{package}'" in refusal
        assert len(refusal) < 2000


def test_a_class_that_has_moved_is_found_at_its_new_place(package, monkeypatch):
    old = "ljn.nets.once.HereBaseline"
    with_text(package, set_config("model", _target_=old))
    with_text(
        package, lambda text: text["stages"]["detector"]["config"]["module"]["net"].update(_target_=old)
    )
    with pytest.raises(ValueError, match=r"ljn\.nets\.once\.HereBaseline.* cannot be found"):
        read_checkpoint(package)
    new = "ljn.nets.simple_baseline.SimpleBaseline"
    monkeypatch.setitem(ljn.building.MOVED, old, new)
    module, checkpoint = load_module(package, JointDetector)
    assert checkpoint.config["model"]["_target_"] == new
    assert type(module.net).__name__ == "SimpleBaseline"
    # In a checkpoint, too.
    content = {**about()["detector"]}
    content["config"]["module"]["net"]["_target_"] = old
    path = package.with_suffix(".ckpt")
    torch.save({"ljn": content, "epoch": 0, "state_dict": state()["detector"]}, path)
    assert read_checkpoint(path).config["module"]["net"]["_target_"] == new


def test_a_moved_class_is_one_that_a_config_may_name():
    for target in ljn.building.MOVED.values():
        ljn.building.check_targets({"_target_": target})


@pytest.mark.parametrize("name", INDEX)
def test_what_ships_loads(name):
    if "keypoints" in stages_of(SHIPPED / f"{name}.safetensors"):
        assert KeypointFinder.load(name).stage.recipe is not None
    else:
        assert Pipeline.from_pretrained(name).detector.recipe is not None
    assert packages.read_about((SHIPPED / f"{name}.safetensors").read_bytes(), name)["name"] == name


def test_the_larger_weights_beside_their_page_load():
    path = Path(ljn.building.__file__).parents[1] / "docs" / "models" / "base.safetensors"
    pipeline = Pipeline.from_pretrained(path)
    assert pipeline.detector.recipe is not None
    assert pipeline.regressor is not None


def test_what_ships_is_in_the_index_and_small():
    files = {path.stem: path.stat().st_size for path in SHIPPED.glob("*.safetensors")}
    assert set(files) == set(INDEX)
    of_keypoints = {name for name in INDEX if "keypoints" in stages_of(SHIPPED / f"{name}.safetensors")}
    for names in (of_keypoints, set(INDEX) - of_keypoints):
        assert sum(files[name] for name in names) <= MOST_BYTES
    assert {path.suffix for path in SHIPPED.iterdir()} <= {".safetensors", ".json"}


def test_weights_are_found_by_name_or_file(shipped):
    assert find_package("tiny") == shipped
    assert find_package(shipped) == shipped
    assert stages_of(shipped) == ["detector"]
    with pytest.raises(ValueError, match=r"weights: expected the name of weights .* \(tiny\), .*got 'large'"):
        find_package("large")
    with pytest.raises(FileNotFoundError, match=r"name: no file 'nowhere\.safetensors'"):
        find_package("nowhere.safetensors", "name")


def test_a_shipped_file_is_compared_with_its_checksum(shipped):
    data = bytearray(shipped.read_bytes())
    data[-1] ^= 1
    shipped.write_bytes(data)
    with pytest.raises(
        ValueError, match=r"weights: '.*tiny\.safetensors' is damaged: expected \d+ bytes of SHA-256"
    ):
        find_package("tiny")
    shipped.unlink()
    with pytest.raises(FileNotFoundError, match="there is no such file; install the library again"):
        find_package("tiny")


@pytest.mark.parametrize("text", ["[1]", '{"tiny": 3}', '{"../x": {"bytes": 1, "sha256": ""}}', "{", None])
def test_a_damaged_index_is_named(text, shipped):
    index = shipped.with_name("index.json")
    index.unlink() if text is None else index.write_text(text)
    with pytest.raises(ValueError, match=r"index\.json' cannot be read .*; install the library again"):
        find_package("tiny")


def test_a_repository_of_the_hub_is_fetched(package, tmp_path, monkeypatch):
    repository = tmp_path / "hub" / "someone" / "bodies"
    repository.mkdir(parents=True)
    package.rename(repository / "model.safetensors")

    def hf_hub_download(repo_id, filename):
        if not (tmp_path / "hub" / repo_id).is_dir():
            raise OSError("404 Client Error")
        return str(tmp_path / "hub" / repo_id / filename)

    hub = pytest.importorskip("huggingface_hub")
    monkeypatch.setattr(hub, "hf_hub_download", hf_hub_download)
    assert read_checkpoint(find_package("someone/bodies")).run == "tiny"
    with pytest.raises(ValueError, match=r"weights: cannot fetch model\.safetensors of 'no/one' .*404"):
        find_package("no/one")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(ImportError, match="Install it with `pip install huggingface_hub`"):
        find_package("someone/bodies")


def test_reading_packages_needs_no_hub():
    code = "import sys, ljn.runs.packages; assert 'huggingface_hub' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])
