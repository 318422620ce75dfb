import numpy as np
import pytest

from datamodules.bench import BenchSamples


@pytest.fixture(scope="session")
def samples(tmp_path_factory):
    """The benchmark's first eight samples."""
    return BenchSamples(tmp_path_factory.mktemp("bench"), num_samples=8)


class Standing:
    """Gives the middle of the cloud for every joint; counts its calls."""

    name = "middle"

    def __init__(self):
        self.num_frames = 0

    def __call__(self, frames):
        self.num_frames += len(frames)
        return np.stack([middle(frame) for frame in frames])


def middle(frame):
    v, u = np.nonzero(frame.depth)
    z, camera = frame.depth[v, u], frame.camera
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], -1)
    return np.tile(points.mean(0), (24, 1))


@pytest.fixture
def standing():
    return Standing()


@pytest.fixture
def frames_file(samples, tmp_path):
    """Writes a rendered body, thrice, in the form of real frames, true joints as labels; returns the path."""

    def write(**changes):
        camera, image = samples.camera(0), samples.clean_depth(0)
        joints = np.tile(samples.truth([0]).joints, (3, 1, 1))
        depth = np.tile(image, (3, 1, 1))
        names = ["head", "torso", "l_hand", "r_hand", "l_knee", "r_knee"]
        smpl = [15, 6, 20, 21, 4, 5]
        labels = joints[:, smpl].astype(np.float32)
        arrays = {
            "depth_m": depth,
            "mask": depth > 0,
            "K": np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
            "joints": labels,
            "names": np.array(names),
            "other": labels + np.float32(0.05),
        }
        arrays |= changes
        path = tmp_path / "frames.npz"
        np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
        return path

    return write
