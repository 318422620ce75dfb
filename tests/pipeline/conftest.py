import numpy as np
import pytest
import torch

from datamodules.sources import PoseRecords
from datamodules.synthesis import DepthSynthesizer, SynthesisSettings
from ljn.body import GENDERS
from ljn.cloud.observation import ObservationRecipe
from ljn.modules.joint_detector import JointDetector
from ljn.modules.mesh_regressor import MeshRegressor
from ljn.nets.body_network import DirectBodyNetwork
from ljn.nets.joint_network import LocalJointNetwork
from ljn.nets.pointnet import PointNet
from ljn.pipeline.pipeline import Pipeline
from ljn.pipeline.stages import Stage

NUM_POINTS = 128


@pytest.fixture(scope="session")
def stages():
    """A tiny joint detector and a tiny mesh regressor, untrained, as a pipeline takes them."""
    torch.manual_seed(0)
    sizes = {"local_channels": (8, 8), "global_channels": (8, 16), "group_channels": (8, 16)}
    detector = JointDetector(LocalJointNetwork([0.25] * 24, group_size=16, head_channels=(8,), **sizes))
    trunk = PointNet(78, (8, 8), (8, 16))
    regressor = MeshRegressor(DirectBodyNetwork(trunk, head_channels=(8,), regressor_channels=(8,)))
    recipe = ObservationRecipe(NUM_POINTS, "window", spacing_m=1.5 / 366.458)
    return [Stage(module.eval().requires_grad_(False), recipe, {}) for module in (detector, regressor)]


@pytest.fixture(scope="session")
def pipeline(stages):
    return Pipeline(*stages)


@pytest.fixture(scope="session")
def samples(kinect, body_models):
    """Three training samples, made one by one, each with its noisy depth image `(H, W)`, metres."""
    rng = np.random.default_rng(1)
    pose = np.concatenate([np.full((3, 3), 2 * np.pi / 3**1.5), 0.2 * rng.standard_normal((3, 69))], -1)
    records = PoseRecords(
        pose=pose.astype(np.float32),
        betas=rng.standard_normal((3, 10)).astype(np.float32),
        gender=np.array([GENDERS["female"], GENDERS["male"], GENDERS["female"]]),
        sequence=np.array(["made up"] * 3),
        frame=np.arange(3),
        has_heading=False,
    )
    recipe, takes = ObservationRecipe(NUM_POINTS), ("points", "crop")
    synthesizer = DepthSynthesizer(records, body_models, kinect, SynthesisSettings(), recipe, takes, (7, 0))
    made = [synthesizer.examples([(0, index)]) for index in range(3)]
    return [(batch, depth[0].numpy()) for batch, depth in made]


@pytest.fixture
def given(samples):
    """A valid input: depth (metres), keypoints."""
    batch, depth = samples[0]
    return depth.copy(), batch["keypoints"][0].numpy().copy()
