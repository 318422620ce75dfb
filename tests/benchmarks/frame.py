"""What a frame costs with the weights that ship, by part: python -m tests.benchmarks.frame [WEIGHTS]

One thread, processor time, milliseconds; means over calls.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch

from ljn.cloud.observation import stack_observations
from ljn.demo import FRAMES
from ljn.pipeline.inputs import read_camera, read_depth
from ljn.pipeline.pipeline import Pipeline

CALLS = 30


def cost(call: Callable[[], object]) -> float:
    """Milliseconds of one call."""
    call()
    start = time.process_time()
    for _ in range(CALLS):
        call()
    return 1000 * (time.process_time() - start) / CALLS


def main() -> None:
    """Print the parts."""
    torch.set_num_threads(1)
    start = time.process_time()
    pipeline = Pipeline.from_pretrained(*sys.argv[1:2])
    print(f"loading, once    {1000 * (time.process_time() - start):8.0f}")
    folder = Path(FRAMES) / "kinect_v2"
    depth, camera = read_depth(folder / "depth" / "walking.png"), read_camera(folder / "camera.yaml")
    frame = pipeline.observe(depth, camera)
    detector, regressor = pipeline.detector.module, pipeline.regressor.module  # type: ignore[union-attr]
    seen = stack_observations([frame.detector])
    with torch.inference_mode():
        joints = {"initial_joints": detector(seen)}
        rotmats, betas = (values[-1] for values in regressor(joints))
        parts = {
            "observing it": lambda: pipeline.observe(depth, camera),
            "detector": lambda: detector(seen),
            "regressor": lambda: regressor(joints),
            "body": lambda: regressor.body.from_rotmats(rotmats, betas),
            "the whole frame": lambda: pipeline(depth, camera),
        }
        for name, call in parts.items():
            print(f"{name:17s}{cost(call):8.1f}")


if __name__ == "__main__":
    main()
