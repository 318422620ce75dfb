import json
from functools import partial

import cv2
import numpy as np
import pytest

from ljn.system.readers import LensCamera, Recorder, open_recording
from ljn.system.recording import RgbdFrame
from tests.system.readers.conftest import DEPTH_CAMERA, RGB_CAMERA, as_tuples, turned
from tests.system.readers.test_layouts import write_tum, write_video


@pytest.mark.slow
def test_damaged_recordings_are_read_or_refused(frames, tmp_path, capsys):
    """Any file of a recording cut, changed or removed: an error of ours or frames, never another."""
    rng = np.random.default_rng(0)
    counts, subjects = {"refused": 0, "all frames": 0, "some frames": 0}, set()
    small = tuple(images[:3] for images in frames)

    def folder(path):
        motion = LensCamera(RGB_CAMERA, (0.1, 0, 0, 0), as_tuples(turned(1, [0.05, 0, 0])))
        with Recorder(path, LensCamera(DEPTH_CAMERA, (0.1, 0, 0, 0)), motion) as recorder:
            for i, depth in enumerate(small[0]):
                rgb = cv2.resize(small[1][i], (RGB_CAMERA.width, RGB_CAMERA.height))
                recorder.write(RgbdFrame(i, f"{i}", depth, rgb, i / 10))

    def video(path):
        with Recorder(path, DEPTH_CAMERA) as recorder:
            for i, depth in enumerate(small[0]):
                recorder.write(RgbdFrame(i, f"{i}", depth))
        write_video(path / "rgb.avi", small[1])

    def arrays(path):
        (path / "depth").mkdir(parents=True)
        for i, depth in enumerate(small[0]):
            np.savez(path / "depth" / f"{i}.npz", depth=depth)
        c = DEPTH_CAMERA
        matrix = [c.fx, 0, 0, 0, c.fy, 0, c.cx, c.cy, 1]
        values = {"width": c.width, "height": c.height, "intrinsic_matrix": matrix, "depth_scale": 1000.0}
        (path / "intrinsic.json").write_text(json.dumps(values))

    lists = (partial(write_tum, frames=small, is_associated=is_it) for is_it in (True, False))
    layouts = (folder, video, arrays, *lists)
    for layout_number, write in enumerate(layouts):
        path = tmp_path / str(layout_number)
        write(path)
        files = sorted(file for file in path.rglob("*") if file.is_file())
        for _ in range(120):
            file = files[rng.integers(len(files))]
            content = file.read_bytes()
            damaged = bytearray(content)
            for _ in range(rng.integers(1, 4)):
                kind = rng.integers(4)
                if kind == 0 and damaged:
                    damaged = damaged[: rng.integers(len(damaged))]
                elif kind == 1 and damaged:
                    for place in rng.integers(0, len(damaged), rng.integers(1, 30)):
                        damaged[place] = rng.integers(256)
                elif kind == 2:
                    place = rng.integers(len(damaged) + 1)
                    damaged[place:place] = rng.bytes(rng.integers(1, 20))
                elif len(damaged) > 40:
                    start = rng.integers(len(damaged) - 30)
                    del damaged[start : start + rng.integers(1, 30)]
            if rng.integers(15) == 0:
                file.unlink()
            else:
                file.write_bytes(damaged)
            try:
                recording = open_recording(path)
                found = list(recording.frames())
                assert len(found) == recording.num_frames
                for frame in found:
                    assert (frame.depth is None) <= (frame.error is not None)
                    if frame.depth is not None:
                        assert np.isfinite(frame.depth).all()
                whole = all(frame.error is None for frame in found)
                counts["all frames" if whole else "some frames"] += 1
            except (ValueError, FileNotFoundError) as error:
                counts["refused"] += 1
                subjects.add(str(error).partition(":")[0])
            file.write_bytes(content)
    with capsys.disabled():
        print(f"\ndamaged recordings: {counts}")
    assert min(counts.values()) > 0
    assert subjects <= {"input", "camera", "rgb", "depth", "timestamps", "depth_scale", "fps"}
