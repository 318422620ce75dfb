"""How well missing keypoints are filled in, and the file that it is done with.

python -m tests.benchmarks.keypoint_filling            prints the table
python -m tests.benchmarks.keypoint_filling --write    first makes ljn/pipeline/data/joint_covariance.npz anew

Errors are in pixels of the training camera, over embedded test poses placed as in training.
"""

import sys

import numpy as np
import torch

from datamodules.sources import PoseRecords
from datamodules.sources.embedded import EmbeddedSource
from datamodules.synthesis import DepthSynthesizer, SynthesisSettings
from ljn.body import SMPL, load_body_models
from ljn.body.skeleton import JOINT_INDEX, JOINT_NAMES, NUM_JOINTS, PARENTS
from ljn.cloud.observation import ObservationRecipe
from ljn.geometry.camera import Camera
from ljn.pipeline.filling import COVARIANCE_PATH, fill_missing
from ljn.pipeline.keypoint_orders import ORDERS
from ljn.pipeline.keypoints import MIN_KNOWN

CAMERA = Camera(fx=366.458, fy=366.736, cx=206.470, cy=253.026, width=424, height=512)
NUM_TRAIN, NUM_TEST, SEED = 8192, 1024, 0
NOISES_PX = (0.0, 10.0)
CHUNK = 256


def joint_covariance(layer: SMPL, records: PoseRecords) -> np.ndarray:
    """`(24, 24)`, m^2: covariance of the joints' positions along a direction, over poses and directions.

    Positions are relative to the joints' mean in each pose.
    """
    total = torch.zeros(NUM_JOINTS, NUM_JOINTS, dtype=torch.float64)
    for start in range(0, len(records), CHUNK):
        rows = slice(start, start + CHUNK)
        columns = (records.pose[rows], records.betas[rows], records.gender[rows])
        joints = layer(*map(torch.from_numpy, columns)).joints.double()
        joints = joints - joints.mean(1, keepdim=True)
        total += torch.einsum("bkc,blc->kl", joints, joints)
    return (total / (3 * len(records))).numpy()


def along_the_skeleton(positions: np.ndarray) -> np.ndarray:
    """The simple rule: NaN rows `(24, 2)` lie in the middle of their known neighbours, or at an only one."""
    filled = positions.copy()
    while np.isnan(filled).any():
        before = filled.copy()
        for joint in np.flatnonzero(np.isnan(before).any(1)):
            tied = [child for child in range(NUM_JOINTS) if PARENTS[child] == joint] + [PARENTS[joint]]
            near = [before[other] for other in tied if other >= 0 and not np.isnan(before[other]).any()]
            if near:
                filled[joint] = np.mean(near, 0)
    return filled


RULES = {"covariance": fill_missing, "skeleton": along_the_skeleton}


def errors(keypoints: np.ndarray, noise_px: float, missing: list[int], rule: str) -> np.ndarray:
    """`(samples, missing)`, pixels: how far the filled-in keypoints lie from the truth."""
    noise = noise_px * np.random.default_rng(SEED).standard_normal(keypoints.shape)
    given = keypoints + noise
    given[:, missing] = np.nan
    filled = np.stack([RULES[rule](positions) for positions in given])
    return np.linalg.norm(filled[:, missing] - keypoints[:, missing], axis=-1)


def main() -> None:
    """Make the file where that is asked for; print the table."""
    source = EmbeddedSource()
    bodies = load_body_models(None, source.genders)
    if "--write" in sys.argv:
        covariance = joint_covariance(SMPL(bodies), source.records("train", NUM_TRAIN, SEED))
        np.savez_compressed(COVARIANCE_PATH, covariance=covariance.astype(np.float32))
        print(f"{COVARIANCE_PATH}: {COVARIANCE_PATH.stat().st_size} bytes")

    records = source.records("test", NUM_TEST, SEED)
    recipe, takes = ObservationRecipe(1), ("keypoints",)
    synthesizer = DepthSynthesizer(records, bodies, CAMERA, SynthesisSettings(), recipe, takes, (SEED, 2))
    keys = [(0, index) for index in range(NUM_TEST)]
    chunks = [keys[start : start + CHUNK] for start in range(0, NUM_TEST, CHUNK)]
    keypoints = np.concatenate([synthesizer.batch(chunk)["true_keypoints"].numpy() for chunk in chunks])
    keypoints = keypoints.astype(np.float64)

    cases = {
        f"missing in {name}": [[JOINT_INDEX[joint] for joint in JOINT_NAMES if joint not in order.joints]]
        for name, order in ORDERS.items()
        if len(order.joints) < NUM_JOINTS
    }
    cases["any single joint"] = [[joint] for joint in range(NUM_JOINTS)]
    for joint in ("l_wrist", "l_elbow", "l_ankle", "l_knee", "head"):
        cases[joint] = [[JOINT_INDEX[joint]]]
    rng = np.random.default_rng(SEED)
    of_coco = [JOINT_INDEX[joint] for joint in ORDERS["coco17"].joints]
    cases[f"all but {MIN_KNOWN} of coco17's"] = [
        sorted(set(range(NUM_JOINTS)) - set(rng.choice(of_coco, MIN_KNOWN, replace=False).tolist()))
        for _ in range(20)
    ]
    columns = [(rule, noise) for noise in NOISES_PX for rule in RULES]
    print(f"{'mean error, px':28s}" + "".join(f"{rule:>12s} {noise:2.0f}px" for rule, noise in columns))
    for name, sets in cases.items():
        shown = keypoints if len(sets) == 1 else keypoints[: NUM_TEST // 4]
        means = [
            np.mean([errors(shown, noise, missing, rule).mean() for missing in sets])
            for rule, noise in columns
        ]
        print(f"{name:28s}" + "".join(f"{mean:17.1f}" for mean in means), flush=True)


if __name__ == "__main__":
    main()
