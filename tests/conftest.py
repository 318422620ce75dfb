import dataclasses
import itertools
import os
import signal
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir

from datamodules.placement import draw_heading
from datamodules.sources.embedded import EmbeddedSource
from datamodules.synthesis import SynthesisSettings
from datamodules.synthetic import SyntheticDepthDataModule
from ljn.body import SMPL, load_body_model, load_body_models
from ljn.body.kinematics import joint_offsets
from ljn.cloud.observation import ObservationRecipe
from ljn.geometry.camera import Camera
from ljn.geometry.rotations import CAMERA_FROM_BODY, rotation_about, rotmat_to_rotvec, rotvec_to_rotmat
from ljn.optional import import_open3d, import_pyrender
from ljn.render import get_renderer
from ljn.tasks.schema import register

# Tests that are started in the background begin with Ctrl-C ignored, and so would the processes that they start.
signal.signal(signal.SIGINT, signal.default_int_handler)

if "PYTEST_XDIST_WORKER" in os.environ:
    # With several threads in each worker, they would wait for one another's cores.
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def compose_config():
    """Compose a configuration as run.py does, from overrides."""
    register()

    def make(*overrides, return_hydra_config=False):
        with initialize_config_dir(str(Path(__file__).parents[1] / "conf"), version_base="1.3"):
            return compose("config", list(overrides), return_hydra_config=return_hydra_config)

    return make


@pytest.fixture(scope="session")
def kinect():
    """The depth camera of a Kinect v2, stood upright."""
    return Camera(fx=366.458, fy=366.736, cx=206.470, cy=253.026, width=424, height=512)


@pytest.fixture(scope="session")
def body():
    """The neutral body."""
    return load_body_model()


@pytest.fixture(scope="session")
def offsets(body):
    """Its joints' rest positions relative to their parents."""
    return joint_offsets(body)


@pytest.fixture(scope="session")
def body_models(source):
    """A body for each gender that the source draws."""
    return load_body_models(None, source.genders)


@pytest.fixture(scope="session")
def source():
    return EmbeddedSource()


@pytest.fixture(scope="session")
def bodies(body_models, source):
    """64 posed meshes `(64, V, 3)` with random headings, and their faces: metres, camera axes, at the origin."""
    records = source.records("train", 64, seed=5)
    rng = np.random.default_rng(5)
    pose = torch.from_numpy(records.pose).double()
    heading = torch.tensor([draw_heading("histogram", rng) for _ in range(64)], dtype=torch.float64)
    root = rotmat_to_rotvec(rotation_about("z", heading) @ rotvec_to_rotmat(pose[:, :3]))
    layer = SMPL(body_models).double()
    pose, betas = torch.cat([root, pose[:, 3:]], -1), torch.from_numpy(records.betas).double()
    vertices = layer(pose, betas, torch.from_numpy(records.gender)).vertices
    return (vertices @ CAMERA_FROM_BODY.T).numpy(), layer.faces


@pytest.fixture(scope="session")
def make_datamodule(kinect, body_models, source, tmp_path_factory):
    """Builds a small data module; each with a cache of its own unless `cache_dir` is given.

    Fields of the settings objects are given flat.
    """
    numbers = itertools.count()

    def make(**changes):
        arguments = {
            "source": source,
            "camera": kinect,
            "num_points": 32,
            "num_train": 40,
            "num_val": 20,
            "num_test": 8,
            "batch_size": 8,
            "seed": 0,
            "pool_seed": 0,
            "eval_seed": 0,
            "num_workers": 0,
        }
        if "cache_dir" not in changes:
            arguments["cache_dir"] = tmp_path_factory.mktemp(f"samples{next(numbers)}")
        given = {**arguments, **changes}
        for name, settings in {"synthesis": SynthesisSettings, "observation": ObservationRecipe}.items():
            keys = given.keys() & {field.name for field in dataclasses.fields(settings)}
            given[name] = settings(**{key: given.pop(key) for key in keys})
        datamodule = SyntheticDepthDataModule(**given)
        if "body_path" not in changes:
            datamodule._bodies = body_models  # read once for all
        return datamodule

    return make


@pytest.fixture(scope="session")
def open3d():
    """The `open3d` module; without it the test is skipped, saying what is missing."""
    try:
        return import_open3d()
    except ImportError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def pyrender():
    """The `pyrender` module; without it, or without EGL, the test is skipped, saying what is missing."""
    try:
        module = import_pyrender()
        get_renderer("pyrender")(
            torch.tensor([[[0.0, 0, 1], [1, 0, 1], [0, 1, 1]]]),
            torch.tensor([[0, 1, 2]]),
            Camera(fx=10, fy=10, cx=4, cy=4, width=8, height=8),
        )
    except ImportError as error:
        pytest.skip(str(error))
    return module
