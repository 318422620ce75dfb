"""Properties of all inputs: a mutation of a right one is an error of ours, a doubt, or a result near the clean one."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation

from ljn.body import SMPL
from ljn.geometry.camera import Camera
from ljn.pipeline.depth import body_depth
from ljn.pipeline.inputs import read_camera
from ljn.pipeline.report import Report
from tests.rooms import Room, body_in_room, render

hypothesis = pytest.importorskip("hypothesis", reason="hypothesis is not installed: pip install -e '.[dev]'")
st = hypothesis.strategies
given = hypothesis.given

CAMERA = Camera(106, 106, 48, 64, 96, 128)
DEPTHS = ("<u2", ">u2", "<i4", "<f4", ">f4", "<f8", "<f2")
MASKS = ("none", "boolean", "bytes", "matte", "alpha", "wide", "channel")


def examples(fast, slow):
    """A test with few examples, the same each time, and again with many, marked slow."""

    def settings(number):
        return hypothesis.settings(max_examples=number, deadline=None, derandomize=True, database=None)

    return pytest.mark.parametrize(
        "profile", [settings(fast), pytest.param(settings(slow), marks=pytest.mark.slow)], ids=["few", "many"]
    )


@cache
def person():
    """Somebody who stands before a wall 1.2 m behind: depth `(H, W)`, metres, of the person alone."""
    body = SMPL.load()
    pose = torch.zeros(72)
    pose[:3] = 2 * np.pi / 3**1.5
    pose[3 * 16 + 2], pose[3 * 17 + 2] = -1.1, 1.1
    vertices = body_in_room(body(pose, torch.zeros(10)).vertices.numpy(), (0, 2.2), 0.4)
    return render(vertices, body.faces, Room(), CAMERA)


def is_ours(error):
    assert str(error).startswith(("depth:", "mask:", "camera:"))


def mask_of(kind, body):
    if kind == "none":
        return None
    forms = {
        "boolean": body,
        "bytes": 255 * body.astype(np.uint8),
        "matte": np.where(body, 0.9, 0.05),
        "alpha": np.dstack([np.full((*body.shape, 3), 90, np.uint8), 255 * body.astype(np.uint8)]),
        "wide": binary_dilation(body, iterations=2),
        "channel": body[..., None],
    }
    return forms[kind]


mutations = st.fixed_dictionaries(
    {
        "dtype": st.sampled_from(DEPTHS),
        "mask": st.sampled_from(MASKS),
        "holes": st.sampled_from([0, 0.02, 0.3]),
        "codes": st.sampled_from([0, 0.01, 0.1]),
        "strays": st.integers(0, 12),
        "flips": st.tuples(st.booleans(), st.booleans()),
        "crop": st.integers(0, 3),
        "outside": st.sampled_from(["nothing", "wall", "garbage"]),
        "seed": st.integers(0, 99),
    }
)


@examples(8, 1500)
def test_a_right_image_in_any_form_gives_the_person_or_is_refused_or_doubted(profile):
    @profile
    @given(mutations)
    def check(how):
        rng = np.random.default_rng(how["seed"])
        body, depth = person() > 0, person().copy()
        pixels = np.flatnonzero(body)
        is_integer = np.dtype(how["dtype"]).kind in "iu"
        if how["mask"] != "none" and how["outside"] == "wall":
            depth[~body] = person().max() + 1.2
        depth.flat[rng.choice(pixels, how["strays"], replace=False)] = 5.0
        depth.flat[rng.choice(pixels, int(how["holes"] * len(pixels)), replace=False)] = 0
        coded = rng.choice(pixels, int(how["codes"] * len(pixels)), replace=False)
        image = (1000 * depth).round() if is_integer else depth
        image = image.astype(how["dtype"])
        image.flat[coded] = (
            65535 if image.dtype.itemsize == 2 and is_integer else np.nan if not is_integer else -1
        )
        if how["mask"] not in ("none", "wide") and how["outside"] == "garbage":
            image[~body] = rng.integers(1, 5000, np.count_nonzero(~body)) if is_integer else np.nan
        crop, camera, mask = how["crop"], CAMERA, mask_of(how["mask"], body)
        camera = replace(camera, cx=camera.cx - crop, width=camera.width - crop)
        truth = depth * (depth < 4.9) * body
        truth.flat[coded] = 0
        for axis, name, size in ((0, "cy", "height"), (1, "cx", "width")):
            if how["flips"][axis]:
                # An image that was turned over, with its camera.
                image, truth = np.flip(image, axis), np.flip(truth, axis)
                mask = None if mask is None else np.flip(mask, axis)
                camera = replace(camera, **{name: getattr(CAMERA, size) - 1 - getattr(CAMERA, name)})
                if axis == 1:
                    camera = replace(camera, cx=camera.cx - crop)
        image, truth = image[:, crop:], truth[:, crop:]
        mask = None if mask is None else mask[:, crop:]
        report = Report()
        try:
            found = body_depth(image, camera, mask, report)
        except ValueError as error:
            is_ours(error)
            return
        assert found.shape == image.shape[:2]
        assert found.dtype == np.float32
        if report.warnings:
            return
        is_right = np.abs(found - truth) < 0.01
        either = (found > 0) | (truth > 0)
        assert np.count_nonzero(is_right & either) > 0.9 * np.count_nonzero(either)

    check()


@examples(10, 1000)
def test_a_wrong_camera_or_scale_is_refused_or_doubted_or_gives_a_person_s_size(profile):
    @profile
    @given(
        scale=st.sampled_from([1e-3, 0.1, 0.3, 1.0, 2.5, 10.0, 1e3]),
        focal=st.sampled_from([0.2, 0.4, 1.0, 2.2, 4.0]),
        point=st.tuples(st.integers(0, 95), st.integers(0, 127)),
        dtype=st.sampled_from(["<f4", "<u2", ">u2"]),
    )
    def check(scale, focal, point, dtype):
        camera = replace(CAMERA, fx=focal * CAMERA.fx, fy=focal * CAMERA.fy, cx=point[0], cy=point[1])
        depth = person() * scale
        depth = np.clip(1000 * depth, 0, 65000).astype(dtype) if dtype.endswith("u2") else depth.astype(dtype)
        report = Report()
        try:
            found = body_depth(depth, camera, None, report)
        except ValueError as error:
            is_ours(error)
            return
        size = np.ptp(np.argwhere(found > 0), axis=0) * np.median(found[found > 0]) / camera.fy
        assert report.warnings or 0.8 < size.max() < 2.9

    check()


values = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(10**20), 10**20),
    st.floats(),
    st.text(max_size=8),
    st.lists(st.floats(), max_size=9),
)
keys = st.sampled_from(
    [
        "fx",
        "fy",
        "cx",
        "cy",
        "width",
        "height",
        "ppx",
        "ppy",
        "K",
        "D",
        "camera_matrix",
        "coeffs",
        "intrinsic_matrix",
        "R",
    ]
)


@examples(8, 2000)
def test_a_camera_file_of_any_values_is_a_camera_or_an_error_of_ours(profile, tmp_path):
    import json

    right = {"fx": 366.0, "fy": 366.0, "cx": 206.0, "cy": 253.0, "width": 424, "height": 512}

    @profile
    @given(st.dictionaries(keys, values, max_size=3), st.sets(keys, max_size=2))
    def check(changed, gone):
        content = {key: value for key, value in {**right, **changed}.items() if key not in gone}
        (tmp_path / "camera.json").write_text(json.dumps(content))
        try:
            camera = read_camera(tmp_path / "camera.json")
        except ValueError as error:
            is_ours(error)
        else:
            assert camera.fx > 0
            assert 0 <= camera.cx < camera.width

    check()
