"""The embedded data do not change by accident: results are comparable within one version of them only.

Whoever changes them on purpose raises `POSES_VERSION` or `SAMPLES_VERSION` and writes the new values here
(`python -m tests.test_frozen` prints them).
"""

import pytest
import torch

from datamodules.sources.embedded import EmbeddedSource
from datamodules.sources.embedded.records import POSES_VERSION
from datamodules.synthesis import SAMPLES_VERSION, DepthSynthesizer, SynthesisSettings
from ljn.body import GENDERS, load_body_models
from ljn.cloud.observation import ObservationRecipe
from ljn.data import SPLITS
from ljn.geometry.camera import Camera

KINECT = Camera(fx=366.458, fy=366.736, cx=206.470, cy=253.026, width=424, height=512)
VERSIONS = (POSES_VERSION, SAMPLES_VERSION)
FROZEN = {
    (1, 1): {
        "bodies": {"female": "6748ab1ac924a90f", "male": "ab7ff6d1c3d77b1b", "neutral": "f8442be8982ecbab"},
        "poses": {"train": "8a86d969da26eea5", "val": "f3f110654db84b59", "test": "5425c9021a580d85"},
        "samples": [
            [-1.02869, -0.02007, 2.3564, 0.2623, -0.00149, -0.69991, -0.99432, -0.04492, 2.38798],
            [-0.51608, -0.05113, 2.09458, 0.10032, -0.06064, -0.75177, -0.51206, -0.12157, 2.1408],
            [0.4402, 0.67727, 1.83858, -0.03783, -0.18034, -0.63649, 0.47358, 0.64485, 1.8788],
            [0.32002, -0.20255, 1.54313, -0.1792, -0.02727, -0.6268, 0.271, -0.26816, 1.73578],
        ],
    }
}


def bodies():
    return {body.gender: body.hash for body in load_body_models(None, list(GENDERS))}


def poses():
    source = EmbeddedSource()
    return {split: source.records(split, 256, seed=0).hash for split in SPLITS}


def samples():
    """Mean position of the cloud, of its normals and of the initial joints of a few fixed test samples."""
    source = EmbeddedSource()
    synthesizer = DepthSynthesizer(
        source.records("test", 4, seed=0),
        load_body_models(None, source.genders),
        KINECT,
        SynthesisSettings(),
        ObservationRecipe(num_points=1024),
        ("points",),
        (0, SPLITS.index("test")),
        torch.float64,
    )
    batch = synthesizer.batch([(0, index) for index in range(4)])
    means = [batch["points"].double().mean(1), batch["initial_joints"].double().mean(1)]
    return [[round(value, 5) for value in row] for row in torch.cat(means, -1).tolist()]


@pytest.fixture(scope="module")
def frozen():
    assert VERSIONS in FROZEN, "a new version: write its values here"
    return FROZEN[VERSIONS]


def test_the_bodies_are_those_of_this_version(frozen):
    assert bodies() == frozen["bodies"]


def test_the_poses_are_those_of_this_version(frozen):
    assert poses() == frozen["poses"]


def test_the_samples_are_those_of_this_version(frozen):
    torch.testing.assert_close(torch.tensor(samples()), torch.tensor(frozen["samples"]), atol=5e-4, rtol=0)


if __name__ == "__main__":
    print({VERSIONS: {"bodies": bodies(), "poses": poses(), "samples": samples()}})
