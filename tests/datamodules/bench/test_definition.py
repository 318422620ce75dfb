import re
from dataclasses import fields, replace

import numpy as np
import pytest

from datamodules.bench.definition import (
    DISTANCE_M,
    FOCAL_FACTORS,
    KINECT_V2,
    MARGIN_PX,
    PATH,
    PIXEL_FACTORS,
    Poser,
    make_definition,
    read_definition,
    write_definition,
)
from ljn.geometry.camera import project

HASH = "70d8dd1c15714015"


@pytest.fixture(scope="module")
def definition():
    return read_definition()


def test_the_definition_that_ships_is_that_of_its_version(definition):
    assert len(definition) == 2000
    assert definition.hash == HASH
    assert PATH.stat().st_size < 700_000


def test_the_command_makes_the_first_samples_of_the_file_again(definition):
    made, stored = make_definition(40), definition.first(40)
    for field in fields(made):
        first, second = getattr(made, field.name), getattr(stored, field.name)
        if first.dtype.kind == "f":  # a last bit may differ between machines
            np.testing.assert_allclose(first.astype(float), second.astype(float), atol=2e-3)
        else:
            assert (first == second).all(), field.name


@pytest.mark.slow
def test_the_command_makes_the_file_again():
    assert make_definition().hash == HASH


def test_what_is_drawn_covers_its_ranges(definition):
    focal = definition.intrinsics[:, 0] / KINECT_V2.fx * KINECT_V2.width / definition.size[:, 0]
    pixels = definition.size[:, 0] / KINECT_V2.width
    for values, (low, high) in ((focal, FOCAL_FACTORS), (pixels, PIXEL_FACTORS)):
        assert low * 0.99 <= values.min() < low * 1.05
        assert high * 0.95 < values.max() <= high * 1.01
    assert len(set(definition.seed.tolist())) == 2000
    assert set(definition.gender.tolist()) == {0, 1}
    assert {"clip", "recombined", "walk", "lie"} < set(definition.kind.tolist())


def test_every_body_is_in_its_image_at_a_distance_of_the_range(definition):
    part = definition.first(48)
    vertices, _ = Poser()(part.pose, part.betas, part.gender)
    for index, mesh in enumerate(vertices):
        camera = part.camera(index)
        mesh = mesh + mesh.new_tensor(part.transl[index])
        pixels = project(mesh, camera.intrinsics(mesh.dtype)).numpy()
        assert (pixels >= MARGIN_PX - 0.01).all()
        assert (pixels <= np.array([camera.width, camera.height]) - 1 - MARGIN_PX + 0.01).all()
        centre = float(mesh[:, 2].min() + mesh[:, 2].max()) / 2
        assert DISTANCE_M[0] - 1e-3 <= centre <= DISTANCE_M[1] + 1e-3


def test_a_file_is_read_as_it_was_written_and_another_is_refused(definition, tmp_path):
    write_definition(definition.first(3), tmp_path / "a.npz")
    assert read_definition(tmp_path / "a.npz").hash == definition.first(3).hash
    with pytest.raises(FileNotFoundError, match=re.escape("python -m datamodules.bench --output FILE")):
        read_definition(tmp_path / "b.npz")
    (tmp_path / "c.npz").write_bytes(b"PK no")
    np.savez(tmp_path / "d.npz", pose=np.zeros((2, 72)))
    for name in ("c", "d"):
        with pytest.raises(ValueError, match=rf"{name}\.npz' is no definition of a benchmark"):
            read_definition(tmp_path / f"{name}.npz")
    with pytest.raises(ValueError, match=r"betas: expected float16 of shape \(3, 10\), got float64"):
        replace(definition.first(3), betas=np.zeros((3, 10)))
    broken = definition.first(3).pose.copy()
    broken[1, 2] = np.nan
    with pytest.raises(ValueError, match="pose: NaN or infinite"):
        replace(definition.first(3), pose=broken)
