"""Rooms with a person in them, as a depth camera sees them: floor, walls, furniture, others; with the truth."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from datamodules.sensor import Sensor
from datamodules.sources.embedded.source import FAMILY_SHARES, EmbeddedSource
from ljn.body import SMPL, load_body_models
from ljn.geometry.camera import Camera
from ljn.geometry.rotations import CAMERA_FROM_BODY, rotation_about
from ljn.render import get_renderer
from ljn.tasks.schema import register

CAMERAS = {
    "Kinect v2": Camera(365.5, 365.5, 254.9, 205.4, 512, 424),
    "Kinect v2 upright": Camera(366.458, 366.736, 206.470, 253.026, 424, 512),
    "Azure Kinect": Camera(504, 504, 320, 288, 640, 576),
    "Xtion": Camera(290, 290, 159.5, 119.5, 320, 240),
    "phone": Camera(212, 212, 96, 128, 192, 256),
}
SENSORS = ("gaussian", "kinect_v2", "structured_light")
SHARES = {"whole": 0.25, "swapped": 0.1, "mixed": 0.15, "procedural": 0.5}


class Box(NamedTuple):
    """A box that stands on its lower face: `centre` of that, `size` and `turn` about the vertical; metres, radians."""

    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    turn: float = 0.0


@dataclass
class Room:
    """A room: x to the right, y up from the floor, z away from the camera, which is at `(0, height_m, 0)`; metres.

    Attributes:
        walls: x of the left and the right wall, z of the one behind.
        height_m: Of the camera.
        tilt, roll: Of the camera, radians; a positive tilt looks down.
        ceiling_m: Above the floor; the walls have no end.
        boxes, balls: Furniture; a ball is its centre and its radii.
    """

    walls: tuple[float, float, float] = (-2.0, 2.0, 3.5)
    height_m: float = 1.1
    tilt: float = 0.0
    roll: float = 0.0
    ceiling_m: float = 2.6
    boxes: list[Box] = field(default_factory=list)
    balls: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)

    @property
    def world_from_camera(self) -> np.ndarray:
        """Rotation `(3, 3)` of the camera's axes (x right, y down, z forward) into the room's."""
        cos, sin = np.cos(self.tilt), np.sin(self.tilt)
        tilt = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
        cos, sin = np.cos(self.roll), np.sin(self.roll)
        roll = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        return tilt @ np.diag([1.0, -1, 1]) @ roll

    def to_camera(self, points: np.ndarray) -> np.ndarray:
        """Points `(..., 3)` of the room in the camera's frame."""
        return (points - [0, self.height_m, 0]) @ self.world_from_camera

    def depth(self, camera: Camera) -> np.ndarray:
        """The empty room's depth image `(H, W)` float32, metres."""
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
        rays = rays.reshape(-1, 3) @ self.world_from_camera.T
        rays = np.where(np.abs(rays) < 1e-9, 1e-9, rays)  # along the axes
        start = np.array([0, self.height_m, 0])
        left, right, behind = self.walls
        inside = _through(start, rays, np.array([left, 0, -1.0]), np.array([right, self.ceiling_m, behind]))
        nearest = inside[1]
        for box in self.boxes:
            cos, sin = np.cos(box.turn), np.sin(box.turn)
            turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
            half = np.array([box.size[0] / 2, 0, box.size[2] / 2])
            low, high = -half, half + np.array([0, box.size[1], 0])
            enter, leave = _through((start - box.centre) @ turn, rays @ turn, low, high)
            nearest = np.where((enter < leave) & (enter > 0), np.minimum(nearest, enter), nearest)
        for centre, radii in self.balls:
            offset, along = (start - centre) / radii, rays / radii
            a, b, c = (along**2).sum(-1), along @ offset, offset @ offset - 1
            root = b * b - a * c
            enter = (-b - np.sqrt(np.maximum(root, 0))) / a
            nearest = np.where((root > 0) & (enter > 0), np.minimum(nearest, enter), nearest)
        return nearest.reshape(u.shape).astype(np.float32)


def _through(
    start: np.ndarray, rays: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where rays `(N, 3)` enter and leave a box, as multiples of them."""
    first, second = (low - start) / rays, (high - start) / rays
    return np.minimum(first, second).max(-1), np.maximum(first, second).min(-1)


class Scene(NamedTuple):
    """A room as it is seen, and the truth.

    Attributes:
        depth: `(H, W)` float32, metres; 0 where nothing is measured.
        person: `(H, W)` bool, the person's pixels; none in an empty room.
        camera: The camera.
        labels: What is in it: its camera, sensor and pose family, and what makes it difficult.
    """

    depth: np.ndarray
    person: np.ndarray
    camera: Camera
    labels: tuple[str, ...]


def body_in_room(vertices: np.ndarray, at: tuple[float, float], heading: float) -> np.ndarray:
    """A body `(V, 3)` of the body world (z up, x forward) on the floor of a room, its box's middle at x, z."""
    turned = vertices @ rotation_about("z", torch.tensor(heading, dtype=torch.float64)).numpy().T
    points = turned @ CAMERA_FROM_BODY.numpy().T * [1.0, -1, 1]  # y up
    low, high = points.min(0), points.max(0)
    middle = (low + high) / 2
    return points + np.array([at[0] - middle[0], -low[1], at[1] - middle[2]])


def render(vertices: np.ndarray, faces: torch.Tensor, room: Room, camera: Camera) -> np.ndarray:
    """Depth `(H, W)` of a body `(V, 3)` that stands in a room, alone."""
    seen = torch.from_numpy(room.to_camera(vertices)).float()
    return get_renderer("zbuffer")(seen[None], faces, camera)[0].numpy()


def scenes(number: int, split: str = "test", seed: int = 0) -> Iterator[Scene]:
    """Random scenes: embedded poses of all families, all cameras and sensors, rooms with nothing to much in them."""
    register()
    source = EmbeddedSource(shares=SHARES, families=dict.fromkeys(FAMILY_SHARES, 1.0))
    bodies = [SMPL(load_body_models(None, [gender])) for gender in source.genders]
    chains = {name: _sensor(name) for name in SENSORS}
    records = source.records(split, 2 * number, seed)

    def body_of(row: int) -> np.ndarray:
        pose = torch.from_numpy(records.pose[row])
        body = bodies[int(records.gender[row])]
        return body(pose, torch.from_numpy(records.betas[row])).vertices.numpy().astype(np.float64)

    faces = bodies[0].faces
    for index in range(number):
        rng = np.random.default_rng([seed, index])
        name = str(records.sequence[index]).split("|")[0]
        family = name.removeprefix("proc/") if name.startswith("proc/") else "clips"
        kind = str(rng.choice(list(CAMERAS)))
        sensor = str(rng.choice(list(SENSORS)))
        room, vertices, other, labels = _furnished(body_of(index), body_of(number + index), family, rng)
        camera = CAMERAS[kind]
        room.tilt = _tilt_to(room, vertices, camera, rng)
        empty = room.depth(camera)
        body = render(vertices, faces, room, camera)
        if "no person" in labels:
            body = np.zeros_like(body)
        near = empty
        if other is not None:
            second = render(other, faces, room, camera)
            near = np.where((second > 0) & (second < near), second, near)
        person = (body > 0) & (body < near)
        depth = np.where(person, body, near).astype(np.float32)
        chains[sensor].expose(depth, camera, np.zeros((24, 3)), [seed, index])
        if sensor == "gaussian":
            depth[depth > 0] += rng.normal(0, 0.001, np.count_nonzero(depth > 0)).astype(np.float32)
        yield Scene(depth, person & (depth > 0), camera, (kind, sensor, family, *labels))


def _sensor(name: str) -> Sensor:
    with initialize_config_dir(str(Path(__file__).parents[1] / "conf"), version_base="1.3"):
        config = compose("config", [f"data/sensor={name}"]).data.sensor
    return Sensor({}) if config is None else instantiate(config)


def _tilt_to(room: Room, vertices: np.ndarray, camera: Camera, rng: np.random.Generator) -> float:
    """A tilt that has the body more or less in the middle of the image."""
    low, high = vertices.min(0), vertices.max(0)
    up = (low[1] + high[1]) / 2 + rng.normal(0, 0.12) - room.height_m
    away = np.hypot((low[0] + high[0]) / 2, (low[2] + high[2]) / 2)
    return float(-np.arctan2(up, away) + np.arctan((camera.cy - camera.height / 2) / camera.fy))


def _furnished(
    body: np.ndarray, second: np.ndarray, family: str, rng: np.random.Generator
) -> tuple[Room, np.ndarray, np.ndarray | None, list[str]]:
    """A random room, the person in it, maybe somebody else, and what is difficult."""
    labels: list[str] = []
    distance = rng.uniform(1.8, 3.6)
    at = (rng.uniform(-0.25, 0.25) * distance, distance)
    vertices = body_in_room(body, at, rng.uniform(-np.pi, np.pi))
    low, high = vertices.min(0), vertices.max(0)
    behind = high[2] + (rng.uniform(0.03, 0.3) if rng.random() < 0.2 else rng.uniform(0.3, 2.5))
    if behind - high[2] < 0.3:
        labels.append("near the wall")
    room = Room(
        walls=(low[0] - rng.uniform(0.3, 2.5), high[0] + rng.uniform(0.3, 2.5), behind),
        height_m=rng.uniform(0.5, 2.3),
        roll=rng.normal(0, 0.03),
        ceiling_m=rng.uniform(2.4, 3.0),
    )
    if family == "sit" and rng.random() < 0.7:
        # A stool, or a chair, below.
        hips = body_hips(vertices)
        size = rng.uniform(0.35, 0.5)
        if hips[1] > 0.25:
            top = hips[1] - 0.02
            room.boxes.append(Box((hips[0], 0, hips[2]), (size, top, size), rng.uniform(0, 3)))
            labels.append("on a seat")
    for _ in range(rng.integers(0, 4)):
        _furnish(room, low, high, rng)
    other = None
    if rng.random() < 0.15:
        side = rng.choice([-1, 1])
        away = rng.uniform(0.1, 0.9)
        other = body_in_room(second, (0, 0), rng.uniform(-np.pi, np.pi))
        width = np.ptp(other[:, 0]) / 2
        x = high[0] + away + width if side > 0 else low[0] - away - width
        other += [x, 0, at[1] + rng.uniform(-0.6, 1.0)]
        room.walls = (
            min(room.walls[0], x - 1),
            max(room.walls[1], x + 1),
            max(behind, other[:, 2].max() + 0.2),
        )
        labels.append("two people")
    elif rng.random() < 0.08:
        labels.append("no person")
    return room, vertices, other, labels


def body_hips(vertices: np.ndarray) -> np.ndarray:
    """The lowest point of the seat of a body `(V, 3)` in a room: below the middle of its trunk."""
    middle = np.median(vertices, 0)
    near = vertices[np.hypot(vertices[:, 0] - middle[0], vertices[:, 2] - middle[2]) < 0.15]
    return np.array([middle[0], near[:, 1].min(), middle[2]])


def _furnish(room: Room, low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> None:
    """Put something beside, before or behind the person, whose box is given, nowhere nearer than 5 cm."""
    kind = rng.choice(["table", "cabinet", "sofa", "ball", "lamp", "chair"])
    sizes: Mapping[str, tuple[float, float, float]] = {
        "table": (rng.uniform(0.6, 1.6), rng.uniform(0.45, 0.76), rng.uniform(0.5, 0.9)),
        "cabinet": (rng.uniform(0.4, 1.2), rng.uniform(0.6, 1.9), rng.uniform(0.35, 0.6)),
        "sofa": (rng.uniform(0.8, 1.9), 0.42, 0.8),
        "ball": (0.5, 0.5, 0.5),
        "lamp": (0.3, 1.5, 0.3),
        "chair": (0.45, 0.45, 0.45),
    }
    width, height, length = sizes[str(kind)]
    turn = 0.0 if rng.random() < 0.5 else rng.uniform(-0.5, 0.5)
    reach = np.hypot(width, length) / 2
    for _ in range(20):
        x, z = rng.uniform(room.walls[0], room.walls[1]), rng.uniform(1.0, room.walls[2])
        is_apart = x + reach < low[0] - 0.05 or x - reach > high[0] + 0.05
        is_apart |= z - reach > high[2] + 0.05 or z + reach < low[2] - 0.05
        if is_apart and room.walls[0] < x - reach and x + reach < room.walls[1] and z + reach < room.walls[2]:
            break
    else:
        return
    cos, sin = np.cos(turn), np.sin(turn)

    def put(dx: float, y: float, dz: float, size: tuple[float, float, float]) -> None:
        room.boxes.append(Box((x + cos * dx + sin * dz, y, z - sin * dx + cos * dz), size, turn))

    if kind == "table":
        put(0, height - 0.04, 0, (width, 0.04, length))
        for dx in (-1, 1):
            for dz in (-1, 1):
                put(dx * (width / 2 - 0.05), 0, dz * (length / 2 - 0.05), (0.05, height - 0.04, 0.05))
    elif kind in ("sofa", "chair"):
        put(0, 0, 0, (width, height, length))
        put(0, height, length / 2 - 0.05, (width, 0.4, 0.1))
    elif kind == "cabinet":
        put(0, 0, 0, (width, height, length))
    elif kind == "ball":
        radius = rng.uniform(0.12, 0.32)
        room.balls.append((np.array([x, radius, z]), np.full(3, radius)))
    else:
        room.balls.append((np.array([x, 0.75, z]), np.array([0.05, 0.75, 0.05])))
        room.balls.append((np.array([x, 1.5, z]), np.array([0.2, 0.15, 0.2])))
