import numpy as np
import pytest

from datamodules.placement import floor_height


def test_the_floor_touches_each_mesh_from_below():
    vertices = np.random.default_rng(0).standard_normal((3, 50, 3))
    heights = floor_height(vertices)
    assert heights.shape == (3,)
    for mesh, height in zip(vertices, heights):
        assert (mesh[:, 2] >= height).all()
        assert (mesh[:, 2] == height).any()
    assert floor_height(vertices[0] + [0, 0, 1.5]) == pytest.approx(heights[0] + 1.5)
