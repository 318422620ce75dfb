"""A prediction of a body that the training never saw, against that body's own joints.

python -m tests.benchmarks.predict_foreign FILE.npz DETECTOR.ckpt MESH.ckpt [PICTURE.png]

FILE.npz holds a mesh of another body model, the Momentum Human Rig, before a camera: `verts` (V, 3), `keypoints70`
(70, 3), metres, camera frame; `faces`; and `K`: fx, fy, cx, cy, the principal point in the image's middle. The mesh is
rendered to depth with noise as in training. The keypoints go in as COCO's 17, exact and with 10 px of noise, and what
comes out is compared with the joints that these are. MHR's joints are not quite SMPL's; the errors contain that.
"""

import argparse

import numpy as np
import torch

from datamodules.noise import add_depth_noise
from ljn import Camera, Pipeline, get_renderer
from ljn.body.skeleton import JOINT_INDEX, ROOT
from ljn.geometry.camera import place_at_root, project
from ljn.geometry.distance import distances_to_mesh
from ljn.pipeline.keypoint_orders import ORDERS
from ljn.pipeline.pictures import draw_prediction
from ljn.pipeline.prediction import Prediction

# Where COCO's keypoints are among MHR's 70: nose, eyes, ears, shoulders, elbows, wrists, hips, knees, ankles.
COCO_OF_MHR = (0, 1, 2, 3, 4, 5, 6, 7, 8, 62, 41, 9, 10, 11, 12, 13, 14)
DEPTH_NOISE_M = 0.001
NOISES_PX = (0.0, 10.0)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    for name in ("file", "detector", "mesh"):
        parser.add_argument(name)
    parser.add_argument("picture", nargs="?")
    arguments = parser.parse_args()
    pipeline = Pipeline.load(arguments.detector, arguments.mesh)
    with np.load(arguments.file) as arrays:
        vertices, faces, coco, intrinsics = (arrays[name] for name in ("verts", "faces", "keypoints70", "K"))
    coco = coco[list(COCO_OF_MHR)]
    fx, fy, cx, cy = intrinsics.tolist()
    camera = Camera(fx, fy, cx, cy, width=round(2 * cx), height=round(2 * cy))
    meshes = torch.from_numpy(vertices)[None], torch.from_numpy(faces).long()
    depth = get_renderer()(*meshes, camera)[0].numpy()
    depth = add_depth_noise(depth, DEPTH_NOISE_M, np.random.default_rng(0))
    keypoints = project(torch.from_numpy(coco), camera.intrinsics()).numpy()

    order = ORDERS["coco17"]
    index = [JOINT_INDEX[joint] for joint in order.joints]
    rows = [[order.names.index(name) for name in names] for names in order.joints.values()]
    truth = np.stack([coco[row].mean(0) for row in rows])
    columns = ("cloud to mesh, median", "95 %", f"MPJPE of {len(index)}: initial", "detector", "mesh")
    print(f"{'mm':24s}" + "".join(f"{column:>24s}" for column in columns))
    for noise_px in NOISES_PX:
        noise = noise_px * np.random.default_rng(1).standard_normal(keypoints.shape)
        found = pipeline(depth, camera, keypoints + noise)
        assert found.vertices is not None
        assert found.faces is not None
        distances = distances_to_mesh(found.points[:, :3], found.vertices, found.faces)
        errors = [
            np.linalg.norm(joints[index] - truth, axis=-1).mean()
            for joints in (found.initial_joints, found.joints, mesh_joints(pipeline, found))
        ]
        values = (np.median(distances), np.percentile(distances, 95), *errors)
        print(f"keypoint noise {noise_px:3.0f} px  " + "".join(f"{1000 * value:24.1f}" for value in values))
        if noise_px == 0 and arguments.picture:
            draw_prediction(found, depth, camera).savefig(arguments.picture)


def mesh_joints(pipeline: Pipeline, found: Prediction) -> np.ndarray:
    """The mesh's own joints `(24, 3)`, metres, camera frame."""
    assert pipeline.regressor is not None
    assert found.pose is not None
    assert found.betas is not None
    body = pipeline.regressor.module.body
    joints = body(torch.from_numpy(found.pose), torch.from_numpy(found.betas)).joints
    return place_at_root(joints, joints[ROOT], torch.from_numpy(found.joints[ROOT])).numpy()


if __name__ == "__main__":
    main()
