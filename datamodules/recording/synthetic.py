"""A recording that is rendered: a person in motion before a green curtain, and the truth of each frame."""

import math
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch

from datamodules.recording.motion import embedded_motion
from datamodules.recording.stage import Curtain, Stage, build_stage
from datamodules.rgb import kernels
from datamodules.rgb.chain import Photo, Photography
from datamodules.rgb.drawing import drawn
from datamodules.rgb.look import MATERIAL, Look
from datamodules.rgb.surface import surface_of
from datamodules.sensor import Sensor
from ljn.body import SparseSMPL, load_body_models
from ljn.body.skeleton import JOINT_INDEX, ROOT
from ljn.geometry.camera import Camera, project
from ljn.geometry.rotations import CAMERA_FROM_BODY, body_to_camera, rotmat_to_rotvec, rotvec_to_rotmat
from ljn.render import Renderer, get_renderer
from ljn.system.recording import RgbdFrame

KINECT_V2 = Camera(366.736, 366.458, 253.026, 206.470, 512, 424)
"""Kinect v2's depth camera, lying."""
_PERSON, _PLACE, _STAGE, _PICTURE, _DEPTH = range(5)
_LOOKS = 100
_MARGIN_PX = 8.0
_AROUND_PX = 4
_AT_ONCE = 32
_COARSER, _SOFT_PX, _SHADOW = 4, 7.0, 0.22


class Truth(NamedTuple):
    """What is true of a frame.

    Attributes:
        mask: `(H, W)` bool, the person.
        joints: `(24, 3)` float32, metres, camera frame.
        vertices: `(V, 3)` float32, metres, camera frame, of the body under the clothes.
        keypoints: `(24, 2)` float32, the joints in the image, pixels.
        pose: `(72,)` float32 axis-angle, radians; the first three turn SMPL's rest frame into body world.
        betas: `(10,)` float32.
        global_orient: `(3,)` float32; with `pose[3:]`, `betas` and `transl` an SMPL layer gives the vertices.
        transl: `(3,)` float32, metres.
    """

    mask: np.ndarray
    joints: np.ndarray
    vertices: np.ndarray
    keypoints: np.ndarray
    pose: np.ndarray
    betas: np.ndarray
    global_orient: np.ndarray
    transl: np.ndarray


class SyntheticRecording:
    """A `Recording` of one person in motion before a green curtain, rendered frame by frame as it is asked for.

    The person moves through a clip of the embedded test motion, which no weights that ship have seen, to its end and
    back again for as long as there are frames, with the feet on the floor. A frame depends on the arguments and its
    number alone.

    Args:
        clip: A clip of the test split.
        start: Its first frame that is shown.
        clip_frames: How many of its frames are shown; None for all from there on.
        num_frames: Frames of the recording; None for those of the clip.
        heading_deg: Which way the person faces at first: 0 into the camera, 90 to the image's right.
        distance_m: Depth of the person's pelvis in the mean, metres; raised until the whole clip fits into the image.
        sway_m: How far it wanders to and fro, and sideways.
        gap_m: Between the clip's farthest point and the curtain, metres.
        camera_height_m: Above the floor.
        gender: Of the body, a key of `ljn.body.GENDERS`.
        max_beta: Shape coefficients are normal, drawn again where they exceed this.
        camera: The camera, level; None for Kinect v2's depth camera, lying.
        curtain: None for a room without one.
        person: The chain of a person's clothes, look and light; None for a figure without clothes in plain light.
        picture: The chain of what a colour camera does; None for nothing.
        sensor: The chain of what a depth camera does; None for nothing.
        seed: Of everything that is drawn.
        body_path: See `load_body_models`.
    """

    fps = 30.0

    def __init__(
        self,
        clip: str = "humanoid3d_dance_b",
        start: int = 0,
        clip_frames: int | None = None,
        num_frames: int | None = None,
        heading_deg: float = 0.0,
        distance_m: float = 2.0,
        sway_m: float = 0.1,
        gap_m: float = 0.45,
        camera_height_m: float = 0.95,
        gender: str = "female",
        max_beta: float = 2.0,
        camera: Camera | None = None,
        curtain: Curtain | None = None,
        person: Photography | None = None,
        picture: Photography | None = None,
        sensor: Sensor | None = None,
        seed: int = 3,
        body_path: str | Path | None = None,
    ) -> None:
        numbers = {"distance_m": distance_m, "gap_m": gap_m, "camera_height_m": camera_height_m}
        for name, value in {**numbers, "max_beta": max_beta}.items():
            if not 0 < value < math.inf:
                raise ValueError(f"{name}: expected a number of more than 0, got {value!r}")
        if num_frames is not None and num_frames < 1:
            raise ValueError(f"num_frames: expected 1 or more, or null for the clip's own, got {num_frames}")
        self.motion = embedded_motion(clip, start, clip_frames, heading_deg)
        self.camera = KINECT_V2 if camera is None else camera
        self.num_frames: int = len(self.motion.pose) if num_frames is None else num_frames
        self.distance_m, self.sway_m, self.gap_m = distance_m, sway_m, gap_m
        self.floor_m = camera_height_m
        self.curtain, self.person, self.picture, self.sensor = curtain, person, picture, sensor
        self.seed = seed
        self.body = load_body_models(body_path, (gender,))[0]
        rng = np.random.default_rng([seed, _PERSON])
        betas = rng.standard_normal(10)
        while (outside := np.abs(betas) > max_beta).any():
            betas[outside] = rng.standard_normal(np.count_nonzero(outside))
        self.betas = betas if person is None else person.shape(betas, [seed, _PERSON])

    @property
    def name(self) -> str:
        """See `Recording`."""
        return f"synthetic_{self.motion.name}"

    @property
    def facts(self) -> dict[str, object]:
        """See `Recording`."""
        return {
            "layout": "synthetic",
            "clip": self.motion.name,
            "gender": self.body.gender,
            "seed": self.seed,
            "distance_m": round(self._place[2], 3),
            "curtain": self.curtain is not None,
        }

    def frames(self, start: int = 0) -> Iterator[RgbdFrame]:
        """See `Recording`."""
        for number in range(start, self.num_frames):
            yield self.frame(number)

    def frame(self, number: int) -> RgbdFrame:
        """A frame as the sensor sees it."""
        _, joints, dressed = self._mesh(number)
        metres = self._depth(dressed)
        is_person = (metres > 0) & (metres < self._stage.depth)
        depth = np.where(is_person, metres, self._stage.depth)
        if self.sensor is not None:
            self.sensor.expose(depth, self.camera, joints, [self.seed, _DEPTH, number])
        photo = Photo(self._colour(dressed, joints, is_person), np.zeros((0, 0), np.uint8))
        if self.picture is not None:
            self.picture.photograph(photo, [self.seed, _PICTURE, number])
        rgb = (255 * np.clip(photo.rgb, 0, 1) + 0.5).astype(np.uint8)
        return RgbdFrame(number, f"{number:06d}", depth, rgb, number / self.fps)

    def truth(self, number: int) -> Truth:
        """What is true of a frame."""
        vertices, joints, dressed = self._mesh(number)
        metres = self._depth(dressed)
        pose = torch.from_numpy(self.motion.pose[self._row(number)])
        root = CAMERA_FROM_BODY @ rotvec_to_rotmat(pose[:3])
        keypoints = project(torch.from_numpy(joints), self.camera.intrinsics(torch.float64)).numpy()
        orient, transl = rotmat_to_rotvec(root).numpy(), joints[ROOT] - self._rest_root
        arrays = (joints, vertices, keypoints, pose.numpy(), self.betas, orient, transl)
        mask = (metres > 0) & (metres < self._stage.depth)
        return Truth(mask, *(values.astype(np.float32) for values in arrays))

    def empty_frame(self, number: int = 0) -> RgbdFrame:
        """A frame without the person, for a background plate."""
        depth, photo = self._stage.depth.copy(), Photo(self._stage.rgb, np.zeros((0, 0), np.uint8))
        key = self.num_frames + number
        if self.sensor is not None:
            self.sensor.expose(depth, self.camera, np.zeros((24, 3)), [self.seed, _DEPTH, key])
        if self.picture is not None:
            self.picture.photograph(photo, [self.seed, _PICTURE, key])
        rgb = (255 * np.clip(photo.rgb, 0, 1) + 0.5).astype(np.uint8)
        return RgbdFrame(number, f"empty_{number:06d}", depth, rgb)

    def _row(self, number: int) -> int:
        """The clip's frame that a frame of the recording shows: to the end and back."""
        last = len(self.motion.pose) - 1
        return 0 if last == 0 else last - abs(last - number % (2 * last))

    @cached_property
    def _smpl(self) -> SparseSMPL:
        return SparseSMPL([self.body]).double()

    @cached_property
    def _renderer(self) -> Renderer:
        return get_renderer("zbuffer")

    @cached_property
    def _rest_root(self) -> np.ndarray:
        """The root joint `(3,)` of the shape at rest, where an SMPL layer turns it."""
        with torch.no_grad():
            rest = self._smpl(torch.zeros(1, 72).double(), torch.from_numpy(self.betas)[None])
        return rest.joints[0, ROOT].numpy()

    def _posed(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices `(B, V, 3)`, joints `(B, 24, 3)` and dressed vertices: camera's axes, pelvis and floor at 0."""
        with torch.no_grad():
            pose = torch.from_numpy(self.motion.pose[rows])
            vertices, joints = self._smpl(pose, torch.from_numpy(self.betas).expand(len(rows), -1))
        vertices, joints = body_to_camera(vertices).numpy(), body_to_camera(joints).numpy()
        dressed = vertices.copy()
        if self.person is not None:
            for mesh in dressed:
                self.person.dress(mesh, self.body, [self.seed, _PERSON])
        origin = joints[:, ROOT].copy()
        origin[:, 1] = dressed[..., 1].max(1)  # the floor
        vertices, joints, dressed = (values - origin[:, None] for values in (vertices, joints, dressed))
        return vertices, joints, dressed

    def _sway(self, number: int) -> np.ndarray:
        """Where the person has wandered, `(3,)` metres."""
        phase = np.random.default_rng([self.seed, _PLACE]).uniform(0, 2 * np.pi, 2)
        turns = 2 * np.pi * number / self.fps / np.array([7.0, 5.0]) + phase
        return self.sway_m * np.array([np.sin(turns[0]), 0, np.sin(turns[1])])

    @cached_property
    def _place(self) -> tuple[float, float, float, float]:
        """The pelvis' mean place (x, the floor's y, z), where all fits into the image; and the depth behind all."""
        camera, sway = self.camera, self.sway_m
        depth, farthest, x = self.distance_m, 0.0, 0.0
        meshes = [
            self._posed(np.arange(first, min(first + _AT_ONCE, len(self.motion.pose))))[2]
            for first in range(0, len(self.motion.pose), _AT_ONCE)
        ]
        x = -(max(m[..., 0].max() for m in meshes) + min(m[..., 0].min() for m in meshes)) / 2
        for mesh in meshes:
            farthest = max(farthest, mesh[..., 2].max() + sway)
            axes = (
                (mesh[..., 0] + x, sway, camera.fx, camera.cx, camera.width),
                (mesh[..., 1] + self.floor_m, 0.0, camera.fy, camera.cy, camera.height),
            )
            for along, reach, focal, centre, size in axes:
                low, high = (_MARGIN_PX - centre) / focal, (size - 1 - _MARGIN_PX - centre) / focal
                needed = np.maximum((along + reach) / high, (along - reach) / low) - mesh[..., 2]
                depth = max(depth, float(needed.max()) + sway)
        return x, self.floor_m, depth, depth + farthest + self.gap_m

    def _mesh(self, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices, joints and dressed vertices, metres, camera frame."""
        if not 0 <= number < self.num_frames:
            raise ValueError(f"number: expected a frame from 0 to {self.num_frames - 1}, got {number}")
        place = np.array(self._place[:3]) + self._sway(number)
        vertices, joints, dressed = self._posed(np.array([self._row(number)]))
        return vertices[0] + place, joints[0] + place, dressed[0] + place

    def _depth(self, vertices: np.ndarray) -> np.ndarray:
        mesh, faces = torch.from_numpy(vertices)[None], torch.from_numpy(surface_of(self.body).faces)
        return self._renderer(mesh, faces, self.camera)[0].numpy()

    @cached_property
    def _look(self) -> Look:
        """A look whose clothes are not green; the curtain's light falls on it."""
        look = Look()
        for attempt in range(_LOOKS):
            if self.person is None:
                break
            look = Look()
            self.person.style(look, [self.seed, _PERSON, attempt])
            if not _is_green(look.colours).any():
                break
        return look

    @cached_property
    def _stage(self) -> Stage:
        rng = np.random.default_rng([self.seed, _STAGE])
        return build_stage(self.camera, self.curtain, self._look, self.floor_m, self._place[3], rng)

    def _colour(self, vertices: np.ndarray, joints: np.ndarray, is_person: np.ndarray) -> np.ndarray:
        """The picture `(H, W, 3)` float32, 0-1, as a screen shows it."""
        camera = self.camera
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        box = kernels.image_box(vertices, intrinsics)
        left, top = (max(0, int(low) - _AROUND_PX) for low in (box[0], box[2]))
        right = min(camera.width, int(box[1]) + _AROUND_PX)
        bottom = min(camera.height, int(box[3]) + _AROUND_PX)
        window = slice(top, bottom), slice(left, right)
        centre = 2 * (intrinsics[2:] - (left, top)) + 0.5
        look = self._look
        if self.curtain is not None:
            look = Look(**vars(look))
            self.curtain.shine_on(look)
        size = 2 * (bottom - top), 2 * (right - left)
        fine = np.concatenate([2 * intrinsics[:2], centre])
        person, mask = drawn(vertices, surface_of(self.body), look, fine, size, self._renderer)
        rgb = self._stage.rgb * self._shade(joints, is_person)[..., None]
        rgb[window] = kernels.composed(person, mask, np.ascontiguousarray(rgb[window]))
        return rgb

    def _shade(self, joints: np.ndarray, is_person: np.ndarray) -> np.ndarray:
        """What the person's shadow leaves of the light on curtain and floor, `(H, W)` float32."""
        camera, key = self.camera, self._look.lights[0]
        z, behind = float(joints[ROOT, 2]), self._place[3]
        # Away from the light, and smaller the farther behind; soft, so coarse pixels do.
        across = np.clip(-key[:2] / max(-key[2], 0.3), -0.8, 0.8) * (behind - z)
        scale = z / behind
        moved = (1 - scale) * np.array([camera.cx, camera.cy]) + across / behind * (camera.fx, camera.fy)
        move = np.array([[scale, 0, moved[0]], [0, scale, moved[1]]]) / _COARSER
        size = camera.width // _COARSER, camera.height // _COARSER
        shadow = cv2.warpAffine(is_person.astype(np.float32), move, size)
        shadow = cv2.resize(cv2.GaussianBlur(shadow, (0, 0), _SOFT_PX / _COARSER), is_person.shape[::-1])
        shade = np.where(self._stage.is_curtain, 1 - _SHADOW * shadow, np.float32(1))
        rows = np.flatnonzero(self._stage.is_floor.any(1))
        if len(rows):
            top = int(rows[0])
            depth = self._stage.depth[top:]
            x = (np.arange(camera.width, dtype=np.float32) - camera.cx) / camera.fx * depth
            dark = np.zeros_like(depth)
            for side in ("l", "r"):
                foot = joints[[JOINT_INDEX[f"{side}_ankle"], JOINT_INDEX[f"{side}_foot"]]].mean(0)
                lifted = max(0.0, self.floor_m - foot[1] - 0.05)
                away = (x - foot[0]) ** 2 + (depth - foot[2]) ** 2
                dark = np.maximum(dark, 0.55 / (1 + 8 * lifted) * cv2.exp((-away / 0.03).astype(np.float32)))
            shade[top:] = np.where(self._stage.is_floor[top:], 1 - dark, shade[top:])
        return shade


def _is_green(colours: np.ndarray) -> np.ndarray:
    """Whether cloth `(M, 2, 3)`, linear RGB, would pass for a green curtain."""
    cloth = np.sqrt(np.delete(colours, MATERIAL["skin"], 0))
    red, green, blue = np.moveaxis(cloth, -1, 0)
    return green > 1.08 * np.maximum(red, blue) + 0.02
