"""How often right inputs are refused or doubted, and wrong ones found.

python -m tests.benchmarks.input_checks --keypoints [--samples 2000]
python -m tests.benchmarks.input_checks --depth [--samples 2000]
python -m tests.benchmarks.input_checks --scenes [--samples 600]      whole rooms, without a mask
python -m tests.benchmarks.input_checks --fuzz [--samples 2000]        damaged files
python -m tests.benchmarks.input_checks --real DIR --pictures OUT      what is dropped of real frames, as pictures

Samples are embedded test poses of all families, seen from all sides by all sensors.
"""

import argparse
from pathlib import Path

from tests.benchmarks import depth_checks, fuzz_checks, keypoint_checks, real_checks, scene_checks


def main() -> None:
    """Print the tables that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--keypoints", action="store_true", help="2D keypoints held against the body")
    parser.add_argument("--depth", action="store_true", help="the person found in a depth image")
    parser.add_argument("--scenes", action="store_true", help="the person found in a room, without a mask")
    parser.add_argument("--fuzz", action="store_true", help="damaged files")
    parser.add_argument(
        "--real", type=Path, help="the folder of real frames that are not part of the project"
    )
    parser.add_argument("--pictures", type=Path, help="of --real: where its pictures go")
    parser.add_argument("--samples", type=int, default=2000)
    parser.add_argument("--split", default="test", help="train, where thresholds are chosen, or test")
    arguments = parser.parse_args()
    if not (arguments.keypoints or arguments.depth or arguments.scenes or arguments.fuzz or arguments.real):
        parser.error("say what to measure: --keypoints, --depth, --scenes, --fuzz, --real")
    if arguments.keypoints:
        keypoint_checks.measure(arguments.samples, arguments.split)
    if arguments.depth:
        depth_checks.measure(arguments.samples, arguments.split)
    if arguments.scenes:
        scene_checks.measure(arguments.samples, arguments.split)
    if arguments.fuzz:
        fuzz_checks.measure(arguments.samples)
    if arguments.real:
        real_checks.measure(arguments.real, arguments.pictures)


if __name__ == "__main__":
    main()
