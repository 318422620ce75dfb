"""A motion as one animated `.glb`: the mesh with a skeleton, which viewers and Blender play."""

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ljn.body.skeleton import JOINT_NAMES, NUM_JOINTS, PARENTS, ROOT
from ljn.body.smpl import SMPL
from ljn.geometry.rotations import BODY_TO_OPENGL
from ljn.pipeline.motion import BodyMotion
from ljn.render.shading import vertex_normals
from ljn.runs.files import write_atomically

_NUM_WEIGHTS = 4  # of a vertex, which is what glTF has room for
_FLOAT, _SHORT, _BYTE = 5126, 5123, 5121  # glTF's codes
_SHAPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_VERTICES, _INDICES = 34962, 34963  # what a buffer is for
_SKIN_COLOUR = [0.62, 0.68, 0.78, 1.0]


@torch.inference_mode()
def write_glb(path: Path, motion: BodyMotion, body: SMPL) -> None:
    """Write the animated mesh, metres, y up.

    Joints move as in the motion. The mesh is skinned to its four strongest joints a vertex, without SMPL's pose
    correctives, which the format does not know: at bent elbows and knees it is some millimetres thinner.

    Args:
        path: The file.
        motion: The motion.
        body: The body that it is of.
    """
    number = len(motion.pose)
    betas = torch.from_numpy(np.asarray(motion.betas, np.float32))[None].to(body.faces.device)
    rest = body(betas.new_zeros(1, 3 * NUM_JOINTS), betas).vertices[0].cpu().numpy()
    faces = body.faces.cpu().numpy()
    weights = body.skinning_weights.cpu().numpy()  # (V, 24)
    strongest = np.argsort(-weights, 1)[:, :_NUM_WEIGHTS]
    shares = np.take_along_axis(weights, strongest, 1)
    shares /= shares.sum(1, keepdims=True)

    local = Rotation.from_rotvec(motion.pose.reshape(-1, 3)).as_matrix().reshape(number, NUM_JOINTS, 3, 3)
    up = BODY_TO_OPENGL.numpy()  # glTF's axes are OpenGL's
    local[:, ROOT] = up @ local[:, ROOT]
    quaternions = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_quat().reshape(number, NUM_JOINTS, 4)
    # Neighbours on the same side of the sphere, or players would turn the long way round.
    flips = np.cumprod(np.where((quaternions[1:] * quaternions[:-1]).sum(-1) < 0, -1.0, 1.0), 0)
    quaternions[1:] *= flips[..., None]
    bind = np.tile(np.eye(4), (NUM_JOINTS, 1, 1))
    bind[:, :3, 3] = -motion.rest_joints

    normals = vertex_normals(rest, faces)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    buffer = _Buffer()
    attributes = {
        "POSITION": buffer.add(rest, _FLOAT, _VERTICES, bounds=True),
        "NORMAL": buffer.add(normals, _FLOAT, _VERTICES),
        "JOINTS_0": buffer.add(strongest, _BYTE, _VERTICES),
        "WEIGHTS_0": buffer.add(shares, _FLOAT, _VERTICES),
    }
    indices = buffer.add(faces.reshape(-1, 1), _SHORT, _INDICES)
    binds = buffer.add(bind.transpose(0, 2, 1).reshape(-1, 16), _FLOAT)  # column by column
    times = buffer.add(np.arange(number)[:, None] / motion.rate_hz, _FLOAT, bounds=True)
    samplers = [
        {"input": times, "output": buffer.add(quaternions[:, joint], _FLOAT)} for joint in range(NUM_JOINTS)
    ]
    channels: list[dict[str, Any]] = [
        {"sampler": joint, "target": {"node": joint, "path": "rotation"}} for joint in range(NUM_JOINTS)
    ]
    samplers.append({"input": times, "output": buffer.add(motion.root @ up.T, _FLOAT)})
    channels.append({"sampler": NUM_JOINTS, "target": {"node": ROOT, "path": "translation"}})

    offsets = motion.rest_joints - motion.rest_joints[[max(parent, ROOT) for parent in PARENTS]]
    nodes: list[dict[str, Any]] = []
    for joint, name in enumerate(JOINT_NAMES):
        place = (motion.root[0] @ up.T) if joint == ROOT else offsets[joint]
        node: dict[str, Any] = {"name": name, "translation": place.tolist()}
        if children := [child for child, parent in enumerate(PARENTS) if parent == joint]:
            node["children"] = children
        nodes.append(node)
    nodes.append({"name": "body", "mesh": 0, "skin": 0})
    primitive = {"attributes": attributes, "indices": indices, "material": 0}
    colour = {"baseColorFactor": _SKIN_COLOUR, "metallicFactor": 0.0, "roughnessFactor": 0.8}
    content = {
        "asset": {"version": "2.0", "generator": "ljn"},
        "scene": 0,
        "scenes": [{"nodes": [ROOT, NUM_JOINTS]}],
        "nodes": nodes,
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"pbrMetallicRoughness": colour}],
        "skins": [{"joints": list(range(NUM_JOINTS)), "inverseBindMatrices": binds, "skeleton": ROOT}],
        "animations": [{"name": "motion", "samplers": samplers, "channels": channels}],
        **buffer.content,
    }
    write_atomically(path, _packed(content, bytes(buffer.data)))


class _Buffer:
    """The binary part, and what of it is where."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, values: np.ndarray, code: int, use: int | None = None, bounds: bool = False) -> int:
        """Append `(N, C)`; returns its number."""
        kind = {_FLOAT: "<f4", _SHORT: "<u2", _BYTE: "u1"}[code]
        data = np.ascontiguousarray(values, dtype=kind)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": data.nbytes}
        self.views.append(view if use is None else {**view, "target": use})
        self.data += data.tobytes()
        self.data += bytes(-len(self.data) % 4)
        accessor = {
            "bufferView": len(self.views) - 1,
            "componentType": code,
            "count": len(data),
            "type": _SHAPES[data.shape[1]],
        }
        if bounds:
            accessor |= {"min": data.min(0).tolist(), "max": data.max(0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    @property
    def content(self) -> dict[str, Any]:
        """Its part of the file's JSON."""
        return {
            "buffers": [{"byteLength": len(self.data)}],
            "bufferViews": self.views,
            "accessors": self.accessors,
        }


def _packed(content: Mapping[str, Any], data: bytes) -> bytes:
    """A `.glb` file: its header, the JSON and the binary part."""
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = b"".join(
        struct.pack("<I4s", len(part), name) + part for name, part in ((b"JSON", text), (b"BIN\0", data))
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
