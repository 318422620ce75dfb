import numpy as np
import pytest

from ljn.geometry.camera import Camera
from ljn.system.readers import LensCamera, Recorder
from ljn.system.recording import RgbdFrame

DEPTH_CAMERA = Camera(fx=91.6, fy=91.7, cx=62.5, cy=54.0, width=128, height=106)
RGB_CAMERA = Camera(fx=141.0, fy=141.5, cx=119.0, cy=68.0, width=240, height=135)


def turned(degrees, translation):
    """A motion `(4, 4)` that turns about an axis askew."""
    axis = np.array([0.2, 1.0, -0.3])
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.deg2rad(degrees)
    motion = np.eye(4)
    motion[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    motion[:3, 3] = translation
    return motion


def as_tuples(motion):
    return tuple(map(tuple, motion.tolist()))


def cast(camera, depth_from_camera, pixels=None):
    """What a camera sees of a tilted wall with a box before it.

    Returns depth along its axis, points in the depth camera's frame, and colours that change smoothly over space.
    """
    if pixels is None:
        pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1)
    x, y = (pixels[..., 0] - camera.cx) / camera.fx, (pixels[..., 1] - camera.cy) / camera.fy
    rays = np.stack([x, y, np.ones_like(x)], -1) @ depth_from_camera[:3, :3].T
    origin = depth_from_camera[:3, 3]
    distance = hit(origin, rays)
    points = origin + distance[..., None] * rays
    return distance, points, colours_of(points)


def hit(origin, rays):
    """How many times a ray's length the first surface is away; the rays' z is 1 in their camera's frame."""
    normal, offset = np.array([0.3, 0.1, -1.0]), -2.6
    wall = (offset - origin @ normal) / (rays @ normal)
    low, high = np.array([-0.35, -0.4, 1.5]), np.array([0.25, 0.3, 1.8])
    with np.errstate(divide="ignore"):
        sides = np.stack([(low - origin) / rays, (high - origin) / rays])
    near, far = sides.min(0).max(-1), sides.max(0).min(-1)
    return np.where((near <= far) & (near > 0), np.minimum(near, wall), wall)


def colours_of(points):
    waves = np.stack([np.sin(4 * points[..., 0]), np.cos(5 * points[..., 1]), np.sin(3 * points[..., 2])], -1)
    return np.rint(150 + 80 * waves).astype(np.uint8)


@pytest.fixture(scope="session")
def scene():
    """Depth `(H, W)` float32 metres in whole millimetres, and its colours as registered `(H, W, 3)`."""
    depth, _, colours = cast(DEPTH_CAMERA, np.eye(4))
    return (np.rint(depth * 1000) / 1000).astype(np.float32), colours


@pytest.fixture(scope="session")
def frames(scene):
    """Six frames of it that differ: depths `(6, H, W)` and colours `(6, H, W, 3)`."""
    depth, colours = scene
    depths = np.stack([np.roll(depth, 3 * i, 1) for i in range(6)])
    depths[:, :4, :7] = 0  # nothing measured
    return depths, np.stack([np.roll(colours, 3 * i, 1) for i in range(6)])


@pytest.fixture(scope="session")
def depth_camera():
    return LensCamera(DEPTH_CAMERA)


@pytest.fixture
def walk(frames, tmp_path):
    """A recording of our format, ten frames a second."""
    with Recorder(tmp_path / "walk", DEPTH_CAMERA) as recorder:
        for i, (depth, rgb) in enumerate(zip(*frames)):
            recorder.write(RgbdFrame(i, f"{i:04d}", depth, rgb, i / 10))
    return tmp_path / "walk"
