"""Damaged files read: how many are refused as they should be; see `input_checks`."""

import io
import json
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ljn.pipeline.inputs import read_camera, read_depth, read_keypoints, read_mask


def measure(number: int) -> None:
    """Print the table: of each kind of file, `number` with bytes changed, cut off or added."""
    print("| | files | read | refused | other errors |\n|---|" + 4 * "---:|")
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, (content, read) in _files().items():
            path, counts, rng = Path(folder) / name, Counter[str](), np.random.default_rng(0)
            for _ in range(number):
                path.write_bytes(_damaged(content, rng))
                counts[_outcome(path, read)] += 1
            others = {kind: count for kind, count in counts.items() if kind not in ("read", "refused")}
            shown = ", ".join(f"{count} {kind}" for kind, count in others.items()) or "0"
            print(f"| {name} | {number} | {counts['read']} | {counts['refused']} | {shown} |")


def _outcome(path: Path, read: Callable[[Path], Any]) -> str:
    try:
        read(path)
    except (ValueError, FileNotFoundError):
        return "refused"
    except Exception as error:
        return type(error).__name__
    return "read"


def _damaged(content: bytes, rng: np.random.Generator) -> bytes:
    data = bytearray(content)
    for _ in range(rng.integers(1, 4)):
        place, kind = int(rng.integers(len(data))), rng.integers(4)
        if kind == 0:
            data[place] = rng.integers(256)
        elif kind == 1:
            data[place] ^= 1 << int(rng.integers(8))
        elif kind == 2:
            data[place:place] = rng.bytes(int(rng.integers(1, 9)))
        else:
            del data[place : place + int(rng.integers(1, len(data)))]
        if not data:
            return b""
    return bytes(data)


def _files() -> dict[str, tuple[bytes, Callable[[Path], Any]]]:
    depth = np.random.default_rng(0).integers(0, 4000, (24, 20)).astype(np.uint16)
    person = [[float(u), float(v), 0.9] for u, v in np.random.default_rng(1).integers(0, 400, (25, 2))]
    flat = [number for point in person for number in point]
    camera = {"fx": 366.0, "fy": 366.0, "cx": 206.0, "cy": 253.0, "width": 424, "height": 512}

    def saved(write: Callable[[io.BytesIO], Any]) -> bytes:
        stream = io.BytesIO()
        write(stream)
        return stream.getvalue()

    return {
        "depth.png": (saved(lambda file: Image.fromarray(depth).save(file, "PNG")), read_depth),
        "depth.npy": (saved(lambda file: np.save(file, depth)), read_depth),
        "depth.npz": (saved(lambda file: np.savez_compressed(file, depth=depth)), read_depth),
        "mask.png": (
            saved(lambda file: Image.fromarray((depth > 2000).astype(np.uint8) * 255).save(file, "PNG")),
            read_mask,
        ),
        "camera.json": (json.dumps(camera).encode(), read_camera),
        "camera.yaml": ("\n".join(f"{key}: {value}" for key, value in camera.items()).encode(), read_camera),
        "openpose.json": (json.dumps({"people": [{"pose_keypoints_2d": flat}]}).encode(), read_keypoints),
        "coco.json": (
            json.dumps([{"image_id": 1, "keypoints": flat[:51], "score": 0.9}]).encode(),
            read_keypoints,
        ),
    }
