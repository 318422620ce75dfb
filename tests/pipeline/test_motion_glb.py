import json
import struct

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

from ljn.body import SMPL
from ljn.body.skeleton import PARENTS
from ljn.geometry.rotations import BODY_TO_OPENGL
from ljn.pipeline.motion import BodyMotion
from ljn.pipeline.motion_glb import write_glb


def made(body, number=5):
    rng = np.random.default_rng(0)
    betas = rng.standard_normal(10).astype(np.float32)
    rest = body.rest_joints(torch.from_numpy(betas)).numpy()
    pose = 0.4 * rng.standard_normal((1, 72)) + 0.6 * np.arange(number)[:, None] * np.eye(72)[1]
    return BodyMotion(pose.astype(np.float32), rng.standard_normal((number, 3)), betas, rest, 25.0)


def opened(path):
    """The JSON, and a function that reads an accessor: an independent reading of the format."""
    data = path.read_bytes()
    assert struct.unpack("<4sII", data[:12]) == (b"glTF", 2, len(data))
    length = struct.unpack("<I", data[12:16])[0]
    content, start = json.loads(data[20 : 20 + length]), 28 + length

    def read(number):
        accessor = content["accessors"][number]
        view = content["bufferViews"][accessor["bufferView"]]
        kind = {5126: "<f4", 5123: "<u2", 5121: "u1"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor["type"]]
        at = start + view["byteOffset"]
        return np.frombuffer(data[at : at + view["byteLength"]], kind).reshape(accessor["count"], width)

    return content, read


def test_played_as_gltf_says_joints_are_the_motion_s_and_the_mesh_is_near_the_body_s(tmp_path):
    body = SMPL.load()
    motion = made(body)
    write_glb(tmp_path / "a.glb", motion, body)
    content, read = opened(tmp_path / "a.glb")
    animation = content["animations"][0]
    samplers = animation["samplers"]
    np.testing.assert_allclose(read(samplers[0]["input"])[:, 0], np.arange(5) / 25, atol=1e-6)
    turns = [Rotation.from_quat(read(sampler["output"])).as_matrix() for sampler in samplers[:24]]
    root = read(samplers[24]["output"])
    mesh = content["meshes"][0]["primitives"][0]["attributes"]
    rest = np.pad(read(mesh["POSITION"]), ((0, 0), (0, 1)), constant_values=1)
    binds = read(content["skins"][0]["inverseBindMatrices"]).reshape(24, 4, 4).transpose(0, 2, 1)
    up = BODY_TO_OPENGL.numpy()
    for frame in range(5):
        world = []
        for joint, parent in enumerate(PARENTS):
            local = np.eye(4)
            local[:3, :3] = turns[joint][frame]
            local[:3, 3] = root[frame] if parent < 0 else content["nodes"][joint]["translation"]
            world.append(local if parent < 0 else world[parent] @ local)
        world = np.array(world)
        np.testing.assert_allclose(world[:, :3, 3], motion.joints[frame] @ up.T, atol=1e-5)
        skin = np.einsum("vk,vkij->vij", read(mesh["WEIGHTS_0"]), (world @ binds)[read(mesh["JOINTS_0"])])
        found = np.einsum("vij,vj->vi", skin, rest)[:, :3]
        posed = body(*(torch.from_numpy(values)[None] for values in (motion.pose[frame], motion.betas)))
        expected = (posed.vertices[0] - posed.joints[0, 0]).numpy() + motion.root[frame]
        errors = np.linalg.norm(found - expected @ up.T, axis=1)
        assert np.median(errors) < 0.003
        assert errors.max() < 0.06  # the pose correctives, which glTF has none of


def test_a_viewer_opens_it(tmp_path):
    body = SMPL.load()
    write_glb(tmp_path / "a.glb", made(body), body)
    scene = trimesh.load(tmp_path / "a.glb")
    assert sum(len(mesh.faces) for mesh in scene.geometry.values()) == len(body.faces)
