import pickle
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from lightning.fabric.utilities.data import _set_sampler_epoch
from PIL import Image

from datamodules import rgb
from datamodules.rgb import (
    Background,
    ColourStep,
    Garments,
    Photography,
    RgbDataModule,
    RgbSettings,
    RgbSynthesizer,
)
from datamodules.rgb.kernels import material_at
from datamodules.rgb.look import MATERIALS, Look
from datamodules.rgb.surface import ARM, HEAD, LEG, TRUNK, surface_of
from datamodules.sensor import AxialNoise, Clothing, Tilt
from ljn.body import SMPL, SparseSMPL
from ljn.body.skeleton import JOINT_INDEX
from ljn.building import build
from ljn.cloud.rgb import RgbRecipe
from ljn.geometry.camera import Camera, project
from ljn.geometry.rotations import body_to_camera

COLOUR = Camera(fx=1060, fy=1060, cx=959.5, cy=539.5, width=1920, height=1080)
KEYS = [(0, index) for index in range(8)]
STEPS = {
    name: step()
    for name, step in vars(rgb).items()
    if isinstance(step, type) and issubclass(step, ColourStep) and step is not ColourStep
}
LOOKS = ("Skin", "Hair", "Garments", "Patterns", "Lights")
UPRIGHT = RgbSettings().without_variation()


@pytest.fixture(scope="module")
def make(body_models, source):
    """Builds a synthesizer of eight embedded records; float64, upright crops without faults unless told."""
    records = source.records("val", 8, seed=2)
    layer = SparseSMPL(body_models).double()

    def build_one(steps=None, settings=UPRIGHT, kind="black", size=(64, 64), seed=0, path=None, **chain):
        photo = None if steps is None else Photography(steps, **chain)
        given = (records, body_models, COLOUR, settings, RgbRecipe(*size), Background(kind, path), (seed, 0))
        made = RgbSynthesizer(*given, torch.float64, photo)
        made.__dict__["_smpl"] = layer  # building it would take longer than all the rest
        return made

    return build_one


@pytest.fixture(scope="module")
def plain(make):
    return make().batch(KEYS)


@pytest.fixture(scope="module")
def varied(make):
    """Plain figures as in training: other windows, turned, every one mirrored."""
    return make(settings=RgbSettings(mirrored=1), size=(128, 96)).batch(KEYS)


@pytest.fixture(scope="module")
def make_module(body_models, source, tmp_path_factory):
    def make_one(**changes):
        arguments = {
            "source": source, "camera": COLOUR, "synthesis": RgbSettings(), "recipe": RgbRecipe(32, 32),
            "background": Background(), "num_train": 4, "num_val": 2, "num_test": 2, "batch_size": 2, "seed": 0,
            "pool_seed": 0, "eval_seed": 0, "num_workers": 0, "photo": Photography(STEPS),
            "cache_dir": tmp_path_factory.mktemp("rgb"),
        }  # fmt: skip
        data = RgbDataModule(**{**arguments, **changes})
        data._bodies = body_models  # read once for all
        return data

    return make_one


class Gloves(ColourStep):
    """Red hands without shadow."""

    def style(self, look, rng, strength):
        look.paint("gloves", np.array([1.0, 0, 0]))
        look.cut(glove=2.0)
        look.lights, look.ambient[:] = np.zeros((0, 6), np.float32), 1


def is_seen(batch):
    """Where pixels are not black `(B, h, w)`."""
    return batch["rgb"].amax(1) > 0


def at_joints(mask, batch):
    """A mask's values at the pixels of the joints that lie in the crop."""
    pixels = project(batch["joints"], batch["rgb_camera"]).round().long()
    height, width = mask.shape[1:]
    values = []
    for image, (u, v) in zip(mask, pixels.mT):
        is_in = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        values.append(image[v[is_in], u[is_in]])
    return torch.cat(values)


def differ(one, other):
    return (one["rgb"] != other["rgb"]).flatten(1).any(1)


def test_a_batch_holds_what_the_network_and_its_metrics_need(make):
    batch = make(STEPS, size=(64, 32)).batch(KEYS[:2])
    shapes = {name: (tuple(value.shape[1:]), value.dtype) for name, value in batch.items()}
    assert shapes == {
        "rgb": ((3, 64, 32), torch.uint8),
        "rgb_camera": ((4,), torch.float32),
        "joints": ((24, 3), torch.float32),
        "pose": ((72,), torch.float32),
        "betas": ((10,), torch.float32),
        "gender": ((), torch.int64),
        "camera": ((4,), torch.float32),
        "sample_id": ((), torch.int64),
    }


@pytest.mark.parametrize("name", ["plain", "varied"])
def test_joints_project_onto_the_person(name, request):
    batch = request.getfixturevalue(name)
    on_person = at_joints(is_seen(batch), batch)
    assert len(on_person) > 0.6 * batch["joints"].shape[:2].numel()
    assert on_person.float().mean() > 0.97  # a hand's or a foot's joint can lie a pixel beside it


def test_an_upright_crop_shows_the_whole_person_with_a_margin(plain):
    for seen in is_seen(plain):
        rows, columns = seen.any(1).nonzero()[:, 0], seen.any(0).nonzero()[:, 0]
        sides = [int(places[-1] - places[0] + 1) for places in (rows, columns)]
        assert max(sides) == pytest.approx(64 / 1.1, abs=2)
        for places in (rows, columns):
            assert float(places[0] + places[-1]) / 2 == pytest.approx(31.5, abs=1.1)


@pytest.mark.parametrize("settings", [UPRIGHT, RgbSettings(mirrored=1)], ids=["upright", "varied"])
def test_red_hands_are_where_the_hands_joints_project(make, settings):
    batch = make({"gloves": Gloves()}, settings, size=(128, 96)).batch(KEYS)
    is_red = (batch["rgb"][:, 0].int() - batch["rgb"][:, 1]) > 120
    hands = [JOINT_INDEX[f"{side}_{part}"] for side in ("l", "r") for part in ("wrist", "hand")]
    pixels = project(batch["joints"], batch["rgb_camera"])[:, hands]
    sizes = batch["rgb_camera"][:, 0] / batch["joints"][:, hands, 2].amin(1)
    assert is_red.flatten(1).any(1).sum() >= 5
    for red, places, size in zip(is_red, pixels, sizes):
        for v, u in red.nonzero():
            assert (places - torch.stack([u, v])).norm(dim=-1).min() < 0.14 * size + 1


@pytest.mark.parametrize("name", ["plain", "varied"])
def test_pose_and_shape_give_the_joints(name, request, body_models):
    batch = request.getfixturevalue(name)
    joints = body_to_camera(SMPL(body_models)(batch["pose"], batch["betas"], batch["gender"]).joints)
    own = batch["joints"]
    torch.testing.assert_close(joints - joints[:, :1], own - own[:, :1], atol=1e-5, rtol=0)


def test_a_mirrored_sample_is_the_mirror_image(make):
    turned = replace(UPRIGHT, rotation_deg=30, shift=0.05, scale=(0.8, 1.2))
    one, other = (make(settings=replace(turned, mirrored=share)).batch(KEYS) for share in (0, 1))
    assert torch.equal(one["rgb"].flip(-1), other["rgb"])
    pixels, mirrored = (project(batch["joints"], batch["rgb_camera"]) for batch in (one, other))
    left, right = JOINT_INDEX["l_wrist"], JOINT_INDEX["r_wrist"]
    torch.testing.assert_close(63 - pixels[:, left, 0], mirrored[:, right, 0], atol=1e-3, rtol=0)
    torch.testing.assert_close(pixels[:, left, 1], mirrored[:, right, 1], atol=1e-3, rtol=0)


def test_the_camera_is_turned_about_its_axis_by_no_more_than_the_angle(make, plain):
    turned = make(settings=replace(UPRIGHT, rotation_deg=40)).batch(KEYS)
    angles = []
    for batch in (plain, turned):
        spine = batch["joints"][:, JOINT_INDEX["neck"]] - batch["joints"][:, 0]
        angles.append(torch.atan2(spine[:, 1], spine[:, 0]))
    turn = torch.rad2deg(torch.remainder(angles[1] - angles[0] + torch.pi, 2 * torch.pi) - torch.pi)
    assert turn.abs().max() <= 40.01
    assert turn.std() > 10
    depth = [batch["joints"][..., 2] - batch["joints"][:, :1, 2] for batch in (plain, turned)]
    torch.testing.assert_close(*depth, atol=1e-5, rtol=0)


def test_every_part_of_the_rest_pose_is_of_its_material(body):
    surface = surface_of(body)
    look = Look()
    look.cut(
        hair_top=0.8, hair_back=0.5, hair_nape=0.2, collar=0.95, hem=0.0, waist=0.0, sleeve=1.2, trousers=1.5,
        shoe=2.1, glove=2.0, sock=1.7,
    )  # fmt: skip
    joint = dict(zip(JOINT_INDEX, body.J_regressor @ body.v_template))
    chin, top, back, front = surface.head.tolist()
    eye = chin + 0.56 * (top - chin)
    x, y, z = np.transpose(
        [(joint["l_elbow"] + joint["l_wrist"]) / 2, (joint["l_knee"] + joint["l_ankle"]) / 2]
    )
    places = {
        "hair": [(HEAD, 0, top, (back + front) / 2), (HEAD, 0, eye, back)],
        "eyes": [(HEAD, 0.034, eye, front - 0.02), (HEAD, -0.034, eye, front - 0.02)],
        "lips": [(HEAD, 0, chin + 0.27 * (top - chin), front)],
        "shirt": [(TRUNK, *joint["spine3"]), (ARM, *joint["r_elbow"])],
        "trousers": [
            (TRUNK, *(joint["pelvis"] - (0, 0.03, 0))),
            (LEG, *joint["l_knee"]),
            (LEG, *joint["r_hip"]),
        ],
        "socks": [(LEG, *(joint["l_ankle"] + (0, 0.05, 0)))],
        "shoes": [(LEG, *joint["l_foot"])],
        "gloves": [(ARM, *joint["l_hand"]), (ARM, *joint["r_hand"])],
        "skin": [(ARM, x[0], y[0], z[0]), (LEG, x[1], y[1], z[1]), (HEAD, *joint["neck"] + (0, 0.03, 0.0))],
    }
    for name, named in places.items():
        for region, *place in named:
            found = material_at(region, *map(float, place), look.cuts, *surface[3:])
            assert MATERIALS[found] == name, (name, place)


# Chains


def test_a_sample_depends_on_its_key_alone_and_a_synthesizer_survives_its_way_to_another_process(make):
    synthesizer = make(STEPS, RgbSettings())
    batch = synthesizer.batch(KEYS)
    sent = pickle.loads(pickle.dumps(synthesizer)).batch([KEYS[5], KEYS[2]])
    for name, value in batch.items():
        assert torch.equal(value[[5, 2]], sent[name]), name
    assert differ(batch, make(STEPS, RgbSettings(), seed=1).batch(KEYS)).all()
    assert differ(batch, synthesizer.batch([(1, index) for _, index in KEYS])).all()


def test_without_strength_or_share_a_chain_changes_nothing(make, plain):
    assert not differ(plain, make(STEPS, strength=0).batch(KEYS)).any()
    off = {name: replace(step, share=0.0) for name, step in STEPS.items()}
    assert not differ(plain, make(off).batch(KEYS)).any()


def test_every_step_changes_pictures(make):
    full = make(STEPS).batch(KEYS)
    for name, step in STEPS.items():
        assert differ(full, make({**STEPS, name: replace(step, share=0.0)}).batch(KEYS)).sum() >= 2, name


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "field"),
    [(name, field.name) for name, step in STEPS.items() for field in fields(step)],
)
def test_every_option_changes_pictures(make, name, field):
    step = STEPS[name]
    value = getattr(step, field)
    if isinstance(value, tuple):
        other = tuple(0.5 * number for number in value) if len(value) == 2 else (9.0, *value[1:])
    else:
        other = 0.0 if field == "share" else 1.0 if value < 1 else 2 * value
    steps = {kind: STEPS[kind] for kind in (*LOOKS, name)}
    keys = [(epoch, index) for epoch in range(3) for index in range(8)]
    changed = make({**steps, name: replace(step, **{field: other})}).batch(keys)
    assert differ(make(steps).batch(keys), changed).any()


def test_steps_of_bodies_are_welcome_and_those_of_depth_images_refused(make, plain):
    dressed = make({"clothes": Clothing(), "tilt": Tilt()}).batch(KEYS)
    assert differ(plain, dressed).all()
    with pytest.raises(ValueError, match=r"photo\.steps\.axial: expected a step of bodies.*got AxialNoise"):
        Photography({"axial": AxialNoise()})
    with pytest.raises(ValueError, match=r"Garments.gloves: expected a number, got \(1, 2\)"):
        Garments(gloves=(1, 2))


# Backgrounds


def test_backgrounds_are_behind_the_person(make, plain, tmp_path):
    seen = is_seen(plain)
    inside = torch.nn.functional.max_pool2d((~seen).float(), 5, 1, 2) == 0
    outside = torch.nn.functional.max_pool2d(seen.float(), 3, 1, 1) == 0
    assert (plain["rgb"].amax(1)[outside] == 0).all()
    Image.new("RGB", (90, 50), (200, 30, 60)).save(tmp_path / "wall.png")
    for kind, path in (("random", None), ("green", None), ("random", tmp_path)):
        batch = make(kind=kind, path=path).batch(KEYS)
        same = (batch["rgb"] == plain["rgb"]).all(1)[inside]
        assert same.float().mean() > 0.99  # but for slits that are finer than a pixel
        red, green, blue = batch["rgb"].movedim(1, 0)[:, outside].int()
        if kind == "green":
            assert (green > red).all()
            assert (green > blue).all()
            assert green.float().std() > 1
        elif path:
            assert (red == 200).all()
            assert (green == 30).all()
            assert (blue == 60).all()
        else:
            assert red.float().std() > 20
            assert (batch["rgb"][0] != batch["rgb"][1]).any()


def test_backgrounds_that_are_not_there_are_named(make_module, tmp_path):
    with pytest.raises(ValueError, match="kind: expected one of black, random, green, own, got 'blue'"):
        Background("blue")
    data = make_module(background=Background("random", tmp_path / "none"))
    with pytest.raises(FileNotFoundError, match=r"background\.path: no image .* in the folder"):
        data.prepare_data()
    (tmp_path / "a.png").write_text("no image")
    with pytest.raises(ValueError, match=r"background\.path: .*a\.png' cannot be read"):
        Background("random", tmp_path).image(8, 8, np.random.default_rng(0))


# The data module


def batches_of(data, epoch):
    data.setup("fit")
    loader = data.train_dataloader()
    _set_sampler_epoch(loader, epoch)
    return list(loader)


def test_training_batches_are_the_same_for_any_number_of_workers_and_wherever_a_run_is_resumed(make_module):
    whole = make_module()
    runs = [batches_of(whole, 0), batches_of(whole, 1)]
    resumed = batches_of(make_module(num_workers=1), 1)
    for one, other in zip(runs[1], resumed, strict=True):
        assert set(one) == set(other)
        assert all(torch.equal(one[name], other[name]) for name in one)
    first = torch.cat([batch["rgb"] for batch in runs[0]])
    assert (first != torch.cat([batch["rgb"] for batch in runs[1]])).flatten(1).any(1).all()


def test_fixed_sets_are_made_once_upright_and_without_the_training_seed(make_module, tmp_path):
    sets = []
    for changes in ({}, {"seed": 5, "synthesis": RgbSettings(scale=(1, 2), rotation_deg=10)}):
        data = make_module(num_val=2, cache_dir=tmp_path, **changes)
        data.setup("validate")
        sets.append(next(iter(data.val_dataloader())))
    assert all(torch.equal(sets[0][name], sets[1][name]) for name in sets[0])
    assert len(list(tmp_path.glob("val-*"))) == 2  # poses and samples
    examples, crops = data.examples("val", [0, 1])
    assert torch.equal(crops, sets[0]["rgb"])
    assert torch.equal(examples["joints"], sets[0]["joints"])


def test_the_key_of_a_fixed_set_follows_its_settings(make_module):
    changes = [
        {},
        {"eval_seed": 1},
        {"recipe": RgbRecipe(32, 64)},
        {"background": Background("green")},
        {"photo": None},
        {"photo": Photography({**STEPS, "Skin": replace(STEPS["Skin"], spread=0.1)})},
        {"synthesis": RgbSettings(heading="histogram")},
        {"camera": replace(COLOUR, fx=1000)},
    ]
    assert len({make_module(**change).fixed_key("val") for change in changes}) == len(changes)


def test_what_a_module_says_of_itself(make_module):
    data = make_module()
    assert data.recipe == RgbRecipe(32, 32)
    assert data.takes == ("rgb",)
    assert data.describe(("val",))["version"] == "rgb 1"
    data.takes = ("points", "rgb")
    with pytest.raises(ValueError, match="colour crops have rgb, rgb_camera, but the network takes points"):
        data.setup("fit")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scale": (1.2, 0.8)}, "scale: expected two numbers, 0 < lowest <= highest"),
        ({"heading": "up"}, "heading: expected one of"),
        ({"rotation_deg": 200}, "rotation_deg: expected a number between 0 and 180, got 200"),
        ({"mirrored": -0.1}, "mirrored: expected a number between 0 and 1"),
        ({"shift": float("nan")}, "shift: expected a number"),
    ],
)
def test_settings_that_make_no_sense_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        RgbSettings(**change)


def test_the_configs_defaults_are_the_classes(compose_config):
    cfg = compose_config("data=rgb")
    data = build(cfg.data)
    assert (data.synthesis, data.recipe, data.background) == (RgbSettings(), RgbRecipe(), Background())
    chain = {type(step).__name__: replace(step, share=1.0) for step in data.photo.steps.values()}
    assert chain == {name: STEPS.get(name) or replace(step, share=1.0) for name, step in chain.items()}
    assert chain.keys() - STEPS.keys() == {"Tilt", "WideShapes", "Clothing"}
    assert STEPS.keys() <= chain.keys()
