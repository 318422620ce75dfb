import numpy as np
import pytest
import torch

from datamodules.noise import add_depth_noise
from datamodules.placement import place
from ljn.cloud.sampling import sample_cloud
from ljn.render import get_renderer


@pytest.fixture(scope="session")
def noisy_body(bodies, kinect):
    """Makes body `number`'s cloud and the noisy depth image `(H, W)` that it was taken from."""

    def make(number, num_points=2048):
        rng = np.random.default_rng(number)
        mesh = bodies[0][number]
        vertices = mesh + place(mesh, kinect, rng.random(3))
        depth = get_renderer()(torch.from_numpy(vertices)[None], bodies[1], kinect)[0].numpy()
        noisy = add_depth_noise(depth, 0.001, rng)
        return sample_cloud(noisy, kinect, num_points, rng), noisy

    return make
