"""How well the person is found before a green curtain, and by depth alone, on rendered recordings and a real frame.

    python -m tests.benchmarks.segmentation [--real FOLDER] [--pictures FILE.png] [--people N] [--every FRAMES]

Prints intersection over union with the true mask: the mean over frames, the lowest tenth of them and the lowest; how
many frames were refused; and the time a frame takes. `--real` is a folder with depthkit_chae_{green,depth,mask}.png.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from hydra import compose, initialize_config_dir
from PIL import Image

from ljn.building import build
from ljn.geometry.camera import Camera
from ljn.system.depth_only import DepthOnly, background_plate
from ljn.system.recording import RgbdFrame
from ljn.system.segmentation import GreenCurtain
from ljn.tasks.schema import register

_REAL_CAMERA = Camera(366.0, 366.0, 256.0, 212.0, 512, 424)
_VARIANTS: dict[str, list[str]] = {
    "as it ships": [],
    "turning round (01_01)": ["recording.clip='01_01'", "recording.start=250", "recording.clip_frames=150"],
    "light, yellowish cloth": ["recording.curtain.colour=[0.45,0.75,0.3]"],
    "dark, bluish cloth": ["recording.curtain.colour=[0.1,0.35,0.2]"],
    "uneven light, deep folds, much spill": [
        "recording.curtain.uneven=0.7",
        "recording.curtain.folds_m=0.1",
        "recording.curtain.spill=0.8",
    ],
    "narrow: arms before the wall": ["recording.curtain.width_m=1.2"],
}


class Shot(NamedTuple):
    """A frame, its camera and the true mask."""

    frame: RgbdFrame
    camera: Camera
    mask: np.ndarray


def recording_of(*overrides: str) -> Any:
    """The synthetic recording of `conf/recording`."""
    register()
    with initialize_config_dir(str(Path(__file__).parents[2] / "conf"), version_base="1.3"):
        return build(compose("config", ["task=ar", "recording=synthetic", *overrides]).recording)


def iou(mask: np.ndarray, truth: np.ndarray) -> float:
    """Intersection over union of two masks `(H, W)`."""
    return float(np.count_nonzero(mask & truth) / max(1, np.count_nonzero(mask | truth)))


def measure(name: str, segmenter: Callable[..., np.ndarray], shots: list[Shot]) -> list[np.ndarray | None]:
    """Print a row; returns the masks."""
    values, seconds, masks = [], [], []
    for shot in shots:
        begin = time.process_time()
        try:
            mask = segmenter(shot.frame, shot.camera)
        except ValueError:
            masks.append(None)
            continue
        seconds.append(time.process_time() - begin)
        values.append(iou(mask, shot.mask))
        masks.append(mask)
    found = np.array(values or [np.nan])
    print(
        f"| {name} | {len(shots)} | {len(shots) - len(values)} | {found.mean():.4f} | "
        f"{np.percentile(found, 10):.4f} | {found.min():.4f} | {1000 * np.median(seconds or [np.nan]):.0f} |",
        flush=True,
    )
    return masks


def shots_of(recording: Any, every: int) -> Iterator[Shot]:
    """Every so many frames of a recording."""
    for number in range(0, recording.num_frames, every):
        yield Shot(recording.frame(number), recording.camera, recording.truth(number).mask)


def picture(shots: list[Shot], masks: list[np.ndarray | None]) -> np.ndarray:
    """Rows of colours, depth and mask, RGB, cut to the middle: what is missed magenta, what is too much red."""
    columns = []
    for shot, mask in zip(shots, masks):
        assert shot.frame.rgb is not None
        assert shot.frame.depth is not None
        rgb, middle = shot.frame.rgb, slice(shot.camera.width // 2 - 140, shot.camera.width // 2 + 120)
        grey = np.clip(255 * (1.2 - shot.frame.depth / 4), 0, 255) * (shot.frame.depth > 0)
        depth = cv2.applyColorMap(grey.astype(np.uint8), cv2.COLORMAP_BONE)
        shown = np.zeros_like(rgb)
        if mask is not None:
            shown[mask] = rgb[mask]
            shown[mask & ~shot.mask], shown[shot.mask & ~mask] = (255, 0, 0), (255, 0, 255)
        columns.append(np.vstack([image[:, middle] for image in (rgb, depth, shown)]))
    return cv2.resize(np.hstack(columns), None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA)


def real_shot(folder: Path) -> Shot:
    """The real frame before a green background."""
    names = [folder / f"depthkit_chae_{name}.png" for name in ("green", "depth", "mask")]
    images = [cv2.imread(str(name), cv2.IMREAD_UNCHANGED) for name in names]
    if any(image is None for image in images):
        raise FileNotFoundError(f"--real: expected {', '.join(map(str, names))}")
    green, depth, mask = map(np.asarray, images)
    rgb = np.ascontiguousarray(green[..., ::-1])
    frame = RgbdFrame(0, "depthkit_chae", depth.astype(np.float32) / 1000, rgb)
    return Shot(frame, _REAL_CAMERA, mask > 0)


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--real", type=Path, default=None)
    parser.add_argument("--pictures", type=Path, default=None)
    parser.add_argument(
        "--people", type=int, default=8, help="persons, curtains and lights of the row of many"
    )
    parser.add_argument("--every", type=int, default=10, help="frames from one that is measured to the next")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    print(
        "| curtain | frames | refused | IoU | lowest tenth | lowest | ms |\n|---|---:|---:|---:|---:|---:|---:|"
    )
    first: list[Shot] = []
    measure("(warming up)", GreenCurtain(), list(shots_of(recording_of(), 1000)))
    for name, overrides in _VARIANTS.items():
        shots = list(shots_of(recording_of(*overrides), given.every))
        masks = measure(name, GreenCurtain(), shots)
        if not first:
            first, first_masks = shots, masks
    people = [recording_of(f"recording.seed={seed}") for seed in range(given.people)]
    many = [shot for recording in people for shot in shots_of(recording, 3 * given.every)]
    measure(f"{given.people} persons, curtains and lights", GreenCurtain(), many)
    if given.real is not None:
        measure("depthkit_chae_green.png (real)", GreenCurtain(), [real_shot(given.real)])
    print(
        "\n| depth alone | frames | refused | IoU | lowest tenth | lowest | ms |\n|---|---:|---:|---:|---:|---:|---:|"
    )
    recording = recording_of()
    plate = background_plate(recording.empty_frame(number) for number in range(9))
    measure("a background plate", DepthOnly(plate), first)
    measure("floor and walls taken away", DepthOnly(), first)
    if given.real is not None:
        measure("depthkit_chae (real; nothing but the person)", DepthOnly(), [real_shot(given.real)])
    if given.pictures is not None:
        step = max(1, len(first) // 4)
        shown = Image.fromarray(picture(first[1::step][:4], first_masks[1::step][:4]))
        shown.quantize(128).save(given.pictures, optimize=True)


if __name__ == "__main__":
    main()
