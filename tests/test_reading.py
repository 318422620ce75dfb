"""Files from outside that are damaged, forged or made to exhaust their reader."""

import contextlib
import functools
import json
import pickle
import struct
import time
import zipfile
import zlib

import numpy as np
import pytest
import torch
from PIL import EpsImagePlugin, Image

from datamodules.cache import cached_samples
from datamodules.sources.clips import read_clips, read_split
from ljn.body import load_body_model
from ljn.body.skeleton import PARENTS
from ljn.building import build
from ljn.modules.joint_detector import JointDetector
from ljn.pipeline.inputs import read_camera, read_depth, read_keypoints, read_mask
from ljn.pipeline.keypoints import smpl_keypoints
from ljn.runs.checkpoints import CHECKPOINT_VERSION, load_module, read_checkpoint

CAMERA = {"fx": 366.458, "fy": 366.736, "cx": 11.5, "cy": 9.25, "width": 24, "height": 20}
ADVICE = ("weights_only", "allow_pickle", "pickle.load")


def body_fields(num_vertices=12):
    rng = np.random.default_rng(0)
    return {
        "v_template": rng.normal(size=(num_vertices, 3)),
        "shapedirs": rng.normal(size=(num_vertices, 3, 10)),
        "posedirs": rng.normal(size=(num_vertices, 3, 207)),
        "J_regressor": np.full((24, num_vertices), 1 / num_vertices),
        "weights": np.full((num_vertices, 24), 1 / 24),
        "kintree_table": np.array([[2**32 - 1, *PARENTS[1:]], range(24)]),
        "f": np.array([[0, 1, 2]], np.uint32),
    }


def checkpoint_content():
    """What a run keeps of a tiny detector."""
    net = {"channels": 8, "num_blocks": 1, "dropout": 0.5}
    net["_target_"] = "ljn.nets.simple_baseline.SimpleBaseline"
    config = {
        **{key: {} for key in ("preset", "body", "trainer")},
        "model": net,
        "module": {"_target_": "ljn.modules.joint_detector.JointDetector", "net": dict(net)},
        "data": {"camera": {"_target_": "ljn.geometry.camera.Camera", **CAMERA}},
        **{"seed": 0, "name": "tiny", "optimized_metric": "val/mpjpe"},
    }
    torch.manual_seed(0)
    texts = {"body_hash": "0123456789abcdef", "data_licence": "none", "run": "tiny"}
    return {
        "ljn": {"version": CHECKPOINT_VERSION, "config": config, **texts},
        "state_dict": dict(build(config["module"]).state_dict()),
        "epoch": 0,
    }


def depth_image():
    return np.random.default_rng(0).integers(0, 3000, (20, 24)).astype(np.uint16)


def write_clips(path):
    poses = np.random.default_rng(0).normal(size=(6, 72)).astype(np.float32)
    np.savez_compressed(path, poses=poses, clip=np.array(["walk", "run"] * 3))


def load_weights(path):
    return as_arrays(load_module(path, JointDetector)[0].state_dict())


def read_set(path):
    """A set of samples, one of whose files is at `path`; it may be remade, but never read wrong."""
    samples = {"points": torch.arange(60.0).view(5, 4, 3), "sample_id": torch.arange(5)}
    return as_arrays(cached_samples(path.parents[1], path.parent.name, lambda: samples))


def as_arrays(tensors):
    return {name: value.numpy().copy() for name, value in tensors.items()}


KINDS = {
    # name: how to write and read it, and whether checksums protect its values
    "depth.png": (lambda path: Image.fromarray(depth_image()).save(path), read_depth, True),
    "mask.png": (lambda path: Image.fromarray(depth_image() > 1500).save(path), read_mask, True),
    "depth.npy": (lambda path: np.save(path, depth_image()), read_depth, False),
    "stored.npz": (lambda path: np.savez(path, depth=depth_image()), read_depth, True),
    "compressed.npz": (lambda path: np.savez_compressed(path, depth=depth_image()), read_depth, True),
    "camera.yaml": (
        lambda path: path.write_text("".join(f"{key}: {value}\n" for key, value in CAMERA.items())),
        read_camera,
        False,
    ),
    "camera.json": (lambda path: path.write_text(json.dumps(CAMERA)), read_camera, False),
    "keypoints.json": (
        lambda path: path.write_text(json.dumps([[3.5 + joint, 2.0 * joint, 0.9] for joint in range(24)])),
        lambda path: smpl_keypoints(read_keypoints(path)),
        False,
    ),
    "body.npz": (lambda path: np.savez(path, **body_fields()), lambda path: load_body_model(path).hash, True),
    "body.pkl": (
        lambda path: path.write_bytes(pickle.dumps(body_fields(), protocol=2)),
        lambda path: load_body_model(path).hash,
        False,
    ),
    "clips.npz": (write_clips, read_clips, True),
    "tiny.ckpt": (lambda path: torch.save(checkpoint_content(), path), load_weights, True),
    "set/points.npy": (read_set, read_set, True),
    "set/index.json": (read_set, read_set, True),
}


def mutated(content, rng):
    """Some bytes replaced, mostly at both ends, where headers are; cut off; or a part copied elsewhere."""
    kind, damaged = rng.random(), bytearray(content)
    if kind < 0.2:
        return content[: rng.integers(len(content))]
    if kind < 0.4:
        start, place = rng.integers(len(content), size=2)
        part = content[start : start + rng.integers(1, 64)]
        damaged[place : place + (len(part) if rng.random() < 0.5 else 0)] = part
        return bytes(damaged)
    for _ in range(rng.integers(1, 4)):
        place = rng.integers(len(damaged) if rng.random() < 0.5 else min(300, len(damaged)))
        place = place if rng.random() < 0.5 else -1 - place
        damaged[place] = rng.integers(256) if rng.random() < 0.5 else damaged[place] ^ 1 << rng.integers(8)
    return bytes(damaged)


def check_message(error):
    text = str(error)
    assert text.isprintable()
    assert len(text) < 2000
    assert not [advice for advice in ADVICE if advice in text]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("num_files", [100, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", KINDS)
def test_a_damaged_file_is_read_as_before_or_refused(name, num_files, tmp_path):
    path, (write, read, has_checksums) = tmp_path / name, KINDS[name]
    write(path)
    whole, expected, rng = path.read_bytes(), read(path), np.random.default_rng(0)
    num_refused = 0
    for _ in range(num_files):
        path.write_bytes(mutated(whole, rng))
        start = time.monotonic()
        try:
            got = read(path)
        except ValueError as error:
            num_refused += 1
            check_message(error)
        else:
            if has_checksums:
                np.testing.assert_equal(got, expected)
        assert time.monotonic() - start < 20
    assert num_refused > num_files / 4 or read is read_set


# Made by hand


def nested(pair, levels=40):
    """A value that names the one below it twice."""
    value = pair("x", "x")
    for _ in range(levels):
        value = pair(value, value)
    return value


def png_of_size(width, height):
    header = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(b"")), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )


def write_zeros(path, name, shape, num_bytes):
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open(name, "w") as file,
    ):
        np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": shape})
        for _ in range(num_bytes >> 20):
            file.write(bytes(1 << 20))


def pickle_of_a_nested_key():
    """Of a dict whose key is `nested` tuples: Python itself would never be done with making it."""
    return b"\x80\x02}" + pickle.dumps(nested(lambda a, b: (a, b)), 2)[2:-1] + b"K\x01s."


def write_nested_key(path):
    torch.save({}, path)
    with zipfile.ZipFile(path) as archive:
        entries = {entry: archive.read(entry) for entry in archive.infolist()}
    with zipfile.ZipFile(path, "w") as archive:
        for entry, data in entries.items():
            archive.writestr(entry, pickle_of_a_nested_key() if entry.filename.endswith("data.pkl") else data)


def write_state(path, **state):
    content = checkpoint_content()
    content["state_dict"] |= state
    torch.save(content, path)


YAML_LISTS = "a0: &a0 [x, x]\n" + "".join(f"a{n}: &a{n} [*a{n - 1}, *a{n - 1}]\n" for n in range(1, 40))
YAML_MERGES = "a0: &a0 {x: 1}\n" + "".join(
    f"a{n}: &a{n}\n  <<: [*a{n - 1}, *a{n - 1}]\n" for n in range(1, 40)
)


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("camera.yaml", lambda path: path.write_text(YAML_LISTS)),
        ("camera.yaml", lambda path: path.write_text(YAML_MERGES)),
        ("camera.yaml", lambda path: path.write_text("- " * 40_000)),
        ("camera.yaml", lambda path: path.write_text(f"fx: 0x{'f' * 50_000}\n" * 2)),
        ("camera.json", lambda path: path.write_text(json.dumps(["x" * 60_000]))),
        ("camera.json", lambda path: path.write_text(json.dumps({"x" * 60_000: "\ud800"}))),
        ("keypoints.json", lambda path: path.write_text(json.dumps({"people": {"x" * 5_000_000: 1}}))),
        ("keypoints.json", lambda path: path.write_text(json.dumps({"\x1b[2J" * 1_000_000: [1, 2]}))),
        ("keypoints.json", lambda path: path.write_text(json.dumps([["x" * 5_000_000, 1]] * 2))),
        ("keypoints.json", lambda path: path.write_text(json.dumps({"order": "x" * 5_000_000, "keypoints": []}))),
        ("keypoints.json", lambda path: path.write_text(100_000 * "[")),
        ("depth.png", lambda path: path.write_bytes(png_of_size(60_000, 60_000))),
        ("mask.png", lambda path: path.write_bytes(png_of_size(12_000, 12_000))),
        ("stored.npz", lambda path: write_zeros(path, "depth.npy", (300 << 18,), 300 << 20)),
        ("stored.npz", lambda path: write_zeros(path, "depth.npy", (10**12,), 1 << 20)),
        ("clips.npz", lambda path: write_zeros(path, "poses.npy", (300 << 18,), 300 << 20)),
        ("body.npz", lambda path: write_zeros(path, "weights.npy", (10**6, 10**6), 1 << 20)),
        ("body.pkl", lambda path: path.write_bytes(pickle_of_a_nested_key())),
        ("tiny.ckpt", write_nested_key),
        ("tiny.ckpt", lambda path: write_state(path, wide=torch.zeros(1).expand(10**9, 10**9))),
    ],
)  # fmt: skip
def test_a_small_file_that_stands_for_a_large_one_is_refused(name, write, tmp_path):
    write(tmp_path / name)
    start = time.monotonic()
    with pytest.raises(ValueError, match=f"{name.partition('.')[0]}|keypoints: ") as refusal:
        KINDS[name][1](tmp_path / name)
    check_message(refusal.value)
    assert time.monotonic() - start < 20


@pytest.mark.parametrize("name", ["depth.png", "mask.png"])
def test_a_png_that_is_postscript_starts_nothing(name, tmp_path, monkeypatch):
    started = []
    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", lambda *arguments, **_: started.append(arguments))
    path = tmp_path / name
    path.write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 24 20\n%%EndComments\nshowpage\n%%EOF\n")
    with pytest.raises(ValueError, match=r"png' is damaged, cut off or of another format"):
        KINDS[name][1](path)
    assert started == []


def test_a_table_of_a_million_unknown_clips_is_refused_in_brief(tmp_path):
    write_clips(tmp_path / "clips.npz")
    (tmp_path / "split.json").write_text(
        json.dumps({"train": [str(n) for n in range(200_000)], "val": [], "test": []})
    )
    with pytest.raises(ValueError, match="unknown clips") as refusal:
        read_split(tmp_path / "split.json", read_clips(tmp_path / "clips.npz"))
    check_message(refusal.value)
    (tmp_path / "split.json").write_text(100_000 * "[")
    with pytest.raises(ValueError, match="is no JSON file"):
        read_split(tmp_path / "split.json", read_clips(tmp_path / "clips.npz"))


# Checkpoints of odd content


def edit_state(**values):
    return lambda content, config: content["state_dict"].update(values)


def edit_net(**values):
    return lambda content, config: config["module"]["net"].update(values)


def edit_config(**values):
    return lambda content, config: config.update(values)


def edit_camera(**values):
    return lambda content, config: config["data"]["camera"].update(values)


@functools.cache
def weight_name():
    return next(iter(checkpoint_content()["state_dict"]))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda content, config: content["state_dict"].update({weight_name(): None}), "expected a tensor of plain"),
        (lambda content, config: content["state_dict"].update({3: torch.ones(1)}), "expected names, got 3"),
        (edit_state(extra=torch.ones(2)), "weights of another model"),
        (edit_state(extra=torch.eye(2).to_sparse()), "expected a tensor of plain numbers, got torch.sparse_coo"),
        (edit_state(extra=torch.ones(2, dtype=torch.complex64)), "got .* of torch.complex64"),
        (edit_state(extra=torch.ones(2, device="meta")), "expected numbers that are in the file"),
        (edit_state(extra=torch.tensor([1.0, np.nan])), "extra: expected finite numbers"),
        (edit_state(extra=torch.tensor([1e300], dtype=torch.float64)), "extra: expected finite numbers"),
        (lambda content, config: content["state_dict"].clear(), "weights of another model"),
        (lambda content, config: content.pop("ljn"), "no checkpoint that a run of this library wrote"),
        (lambda content, config: content["ljn"].update(version=99), "written by a newer version"),
        (lambda content, config: content["ljn"].update(version=0), "written by an older version"),
        (lambda content, config: content["ljn"].update(version="1"), "no whole configuration"),
        (lambda content, config: content.update(ljn={}), "no whole configuration"),
        (lambda content, config: config.pop("body"), "no whole configuration"),
        (edit_config(name="${oc.env:HOME}"), "no whole configuration"),
        (lambda content, config: content.update(epoch=2**40), "no whole configuration"),
        (lambda content, config: content["ljn"].update(run="x" * 5000), "no whole configuration"),
        (edit_config(name="???"), "no whole configuration"),
        (edit_config(data=[]), "no whole configuration"),
        (edit_config(tags={3: "x"}), "no whole configuration"),
        (edit_config(tags=torch.ones(2)), "no whole configuration"),
        (edit_config(tags=nested(lambda a, b: [a, b], 25)), "no whole configuration"),
        (edit_config(tags=nested(lambda a, b: {"a": a, "b": b}, 25)), "no whole configuration"),
        (edit_camera(fx=0), "focal lengths and image size must be positive"),
        (edit_camera(fx=float("nan")), "focal lengths and image size must be positive"),
        (edit_camera(fx="wide"), "expected six numbers"),
        (edit_camera(width=10**9), "in all at the most"),
        (edit_net(channels=16), r"weights of another model.*'net\."),
        (edit_net(channels=10**9), "weights of another model"),
        (edit_net(channels=10**30), ""),
        (edit_net(channels="x" * 100_000), ""),
        (edit_net(num_blocks=10**9), "a smaller one than its configuration says"),
        (edit_net(dropout=5), ""),
        (edit_net(_target_="os.system"), r"checkpoint's config.*os\.system"),
        (edit_net(_target_="x" * 100_000), "is outside the modules"),
        (edit_net(_target_="ljn.nets..x"), "cannot be found"),
        (edit_net(_target_="ljn.geometry.camera.Camera"), ""),
        (lambda content, config: config["module"].pop("net"), "expected a network"),
        (lambda content, config: config["module"].update(optimizer=3, surprise=1), ""),
    ],
)  # fmt: skip
def test_a_checkpoint_of_odd_content_is_refused(edit, message, tmp_path):
    content = checkpoint_content()
    edit(content, content["ljn"]["config"])
    torch.save(content, tmp_path / "tiny.ckpt")
    with pytest.raises(ValueError, match=rf"ckpt_path: '.*tiny\.ckpt'.*{message}") as refusal:
        load_module(tmp_path / "tiny.ckpt", JointDetector)
    check_message(refusal.value)


def test_weights_that_pytorch_would_leave_to_chance_are_refused(tmp_path):
    torch.save(checkpoint_content(), tmp_path / "tiny.ckpt")
    content = bytearray((tmp_path / "tiny.ckpt").read_bytes())
    entry = content.rindex(b"tiny/data/1") - 46  # of the central directory
    content[entry + 38] |= 0x10  # a folder, in the attributes
    (tmp_path / "tiny.ckpt").write_bytes(content)
    with pytest.raises(ValueError, match="attributes of files, which PyTorch does not write"):
        load_weights(tmp_path / "tiny.ckpt")


def test_objects_in_a_checkpoint_are_refused_without_advice_to_load_them(tmp_path):
    torch.save({"state_dict": {}, "object": contextlib.nullcontext()}, tmp_path / "objects.ckpt")
    with pytest.raises(ValueError, match="holds Python objects, which are never loaded") as refusal:
        load_module(tmp_path / "objects.ckpt", JointDetector)
    check_message(refusal.value)


def test_checking_a_checkpoint_draws_no_random_number(tmp_path):
    torch.save(checkpoint_content(), tmp_path / "tiny.ckpt")
    before = torch.get_rng_state()
    read_checkpoint(tmp_path / "tiny.ckpt")
    assert torch.equal(torch.get_rng_state(), before)
