import json

import cv2
import numpy as np
import pytest
from PIL import Image

from ljn.geometry.camera import Camera
from ljn.system.readers import LensCamera, Recorder, open_recording
from ljn.system.recording import RgbdFrame
from tests.system.readers.conftest import DEPTH_CAMERA, RGB_CAMERA, as_tuples, cast, turned

TIMES = np.array([0, 0.033, 0.068, 0.099, 0.133, 0.166])


def write_png(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)


def integers(depth, scale=1000):
    return np.rint(depth * scale).astype(np.uint16)


def write_camera(path, camera=DEPTH_CAMERA, **more):
    path.write_text(json.dumps({**vars(camera), **more}))


def write_folder(folder, frames):
    with Recorder(folder, DEPTH_CAMERA) as recorder:
        for i, (depth, rgb) in enumerate(zip(*frames)):
            recorder.write(RgbdFrame(i, f"frame_{i}", depth, rgb, float(TIMES[i])))


def write_arrays(folder, frames):
    """As .npy and .npz, floats in metres with gaps of all kinds, colours as PNG in `color`."""
    (folder / "depth").mkdir(parents=True)
    for i, (depth, rgb) in enumerate(zip(*frames)):
        depth = np.where(depth == 0, [np.nan, -1.0, np.inf, 0, 99.0, -np.inf, np.nan][i], depth)
        if i % 2:
            np.save(folder / "depth" / f"frame_{i}.npy", depth)
        else:
            np.savez(folder / "depth" / f"frame_{i}.npz", depth=depth.astype(np.float32))
        write_png(folder / "color" / f"frame_{i}.png", rgb)
    write_camera(folder / "camera.json", fps=30)
    (folder / "timestamps.txt").write_text("\n".join(map(str, 100 + TIMES)))


def write_tum(folder, frames, is_associated, shift=0.004):
    lists = {"rgb": [], "depth": [], "associations": []}
    for i, (depth, rgb) in enumerate(zip(*frames)):
        time = 1305031102.0 + TIMES[i]
        names = f"rgb/{time + shift:.6f}.png", f"depth/{time:.6f}.png"
        write_png(folder / names[0], rgb)
        write_png(folder / names[1], integers(depth, 5000))
        lists["rgb"].append(f"{time + shift:.6f} {names[0]}")
        lists["depth"].append(f"{time:.6f} {names[1]}")
        lists["associations"].append(f"{lists['rgb'][-1]} {lists['depth'][-1]}")
    for name in ["associations"] if is_associated else ["rgb", "depth"]:
        (folder / f"{name}.txt").write_text("\n".join(["# timestamp filename", *lists[name]]))
    write_camera(folder / "camera.yaml")


def write_open3d(folder, frames):
    for i, (depth, rgb) in enumerate(zip(*frames)):
        write_png(folder / "color" / f"{i:05d}.png", rgb)
        write_png(folder / "depth" / f"{i:05d}.png", integers(depth))
    c = DEPTH_CAMERA
    matrix = [c.fx, 0, 0, 0, c.fy, 0, c.cx, c.cy, 1]
    values = {
        "width": c.width,
        "height": c.height,
        "intrinsic_matrix": matrix,
        "depth_scale": 1000.0,
        "fps": 30.0,
    }
    (folder / "intrinsic.json").write_text(json.dumps({**values, "device_name": "Intel RealSense D435"}))


def write_recorder(folder, frames):
    """What Open3D's realsense_recorder.py writes."""
    write_open3d(folder, frames)
    values = json.loads((folder / "intrinsic.json").read_text())
    (folder / "intrinsic.json").unlink()
    kept = {key: values[key] for key in ("width", "height", "intrinsic_matrix")}
    (folder / "camera_intrinsic.json").write_text(json.dumps(kept))


def write_numbered(folder, frames):
    """Of one number, but of other names and of more digits."""
    for i, (depth, rgb) in enumerate(zip(*frames)):
        write_png(folder / "rgb" / f"img{i + 8}.png", rgb)
        write_png(folder / "depth" / f"depth_{i + 8:04d}_mm.png", integers(depth))
    write_camera(folder / "camera.yml")


LAYOUTS = {
    "folder": write_folder,
    "arrays": write_arrays,
    "associations": lambda folder, frames: write_tum(folder, frames, True),
    "lists": lambda folder, frames: write_tum(folder, frames, False),
    "open3d": write_open3d,
    "recorder": write_recorder,
    "numbered": write_numbered,
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_same_frames_come_back_from_every_layout(layout, frames, tmp_path):
    LAYOUTS[layout](tmp_path / "walk", frames)
    recording = open_recording(tmp_path / "walk")
    assert recording.name == "walk"
    assert recording.camera == DEPTH_CAMERA
    assert recording.num_frames == 6
    found = list(recording.frames())
    assert [frame.number for frame in found] == list(range(6))
    assert [frame.error for frame in found] == [None] * 6
    for frame, depth, rgb in zip(found, *frames):
        assert frame.depth.dtype == np.float32
        np.testing.assert_allclose(frame.depth, depth, atol=1e-4)
        np.testing.assert_array_equal(frame.depth == 0, depth == 0)
        np.testing.assert_array_equal(frame.rgb, rgb)
    later = list(recording.frames(4))
    assert [frame.number for frame in later] == [4, 5]
    np.testing.assert_array_equal(later[0].rgb, found[4].rgb)
    assert recording.facts["frames"] == 6
    assert "unreadable" not in recording.facts
    if layout in ("folder", "arrays", "associations", "lists"):
        np.testing.assert_allclose([frame.timestamp_s for frame in found], TIMES, atol=1e-5)
        assert recording.fps == pytest.approx(30, abs=0.5)
    else:
        assert {frame.timestamp_s for frame in found} == {None}


def test_frames_are_read_when_they_are_asked_for(frames, tmp_path):
    write_folder(tmp_path, frames)
    found = open_recording(tmp_path).frames()
    next(found)
    (tmp_path / "rgb" / "frame_1.png").unlink()
    assert "no file" in next(found).error


def test_more_than_ten_frames_come_in_the_order_of_their_numbers(scene, tmp_path):
    with Recorder(tmp_path, DEPTH_CAMERA) as recorder:
        for i in range(12):
            recorder.write(RgbdFrame(i, f"frame_{i}", scene[0]))
    assert [frame.name for frame in open_recording(tmp_path).frames()] == [f"frame_{i}" for i in range(12)]


def write_video(path, images, fps=20):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), fps, images.shape[2:0:-1])
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    writer.release()


@pytest.mark.parametrize("suffix", [".avi", ".mkv", ".mp4"])
def test_a_video_s_frames_belong_to_the_depth_images_in_their_order(suffix, frames, tmp_path):
    with Recorder(tmp_path, DEPTH_CAMERA) as recorder:
        for i, depth in enumerate(frames[0]):
            recorder.write(RgbdFrame(i, f"{i:04d}", depth))
    write_video(tmp_path / f"rgb{suffix}", frames[1])
    recording = open_recording(tmp_path)
    assert recording.fps == 20
    for start in (0, 3):
        found = list(recording.frames(start))
        assert [frame.number for frame in found] == list(range(start, 6))
        for frame, rgb in zip(found, frames[1][start:]):
            assert np.abs(frame.rgb.astype(int) - rgb).mean() < 6  # compressed with losses
            np.testing.assert_allclose(frame.depth, frames[0][frame.number], atol=1e-4)


def test_depth_alone_is_a_recording_without_colours(frames, tmp_path):
    with Recorder(tmp_path, DEPTH_CAMERA) as recorder:
        recorder.write(RgbdFrame(0, "a", frames[0][0]))
    recording = open_recording(tmp_path)
    (frame,) = recording.frames()
    assert frame.rgb is None
    assert frame.error is None
    assert recording.facts["colours"] == "none"


def test_tum_s_frames_without_a_partner_in_time_are_marked(frames, tmp_path):
    write_tum(tmp_path, frames, False)
    lines = (tmp_path / "rgb.txt").read_text().splitlines()
    time, name = lines[3].split()
    lines[3] = f"{float(time) - 0.03:.6f} {name}"  # now nearest to the frame before, which has a nearer one
    (tmp_path / "rgb.txt").write_text("\n".join(lines))
    recording = open_recording(tmp_path)
    assert [frame.error is not None for frame in recording.frames()] == [
        False,
        False,
        True,
        False,
        False,
        False,
    ]
    assert recording.facts["frames_without_colours"] == 1
    assert recording.facts["colours_without_depth"] == 1


def test_associations_may_name_depth_first_and_another_scale(frames, tmp_path):
    write_tum(tmp_path, frames, True)
    lines = [line.split() for line in (tmp_path / "associations.txt").read_text().splitlines()[1:]]
    (tmp_path / "associations.txt").write_text("\n".join(" ".join(line[2:] + line[:2]) for line in lines))
    frame = next(open_recording(tmp_path, depth_scale=2500).frames())
    np.testing.assert_allclose(frame.depth, 2 * frames[0][0], atol=1e-4)
    np.testing.assert_array_equal(frame.rgb, frames[1][0])


def test_colours_of_another_camera_are_registered_as_they_are_read(scene, tmp_path):
    motion = turned(3, [-0.05, 0, 0])
    camera = LensCamera(RGB_CAMERA, (0.05, -0.02, 0.0, 0.001, 0.0), as_tuples(motion))
    rgb = cast(RGB_CAMERA, np.linalg.inv(motion))[2]
    with Recorder(tmp_path / "a", LensCamera(DEPTH_CAMERA, (-0.1, 0.01, 0, 0)), camera) as recorder:
        recorder.write(RgbdFrame(0, "a", scene[0], rgb))
    recording = open_recording(tmp_path / "a")
    (frame,) = recording.frames()
    assert frame.rgb.shape == (*frame.depth.shape, 3)
    assert recording.facts["undistorted"] == "depth and colour"
    assert "extrinsics" in recording.facts["registration"]
    # The same by arguments in place of files.
    for name in ("camera.yaml", "rgb_camera.yaml"):
        (tmp_path / "a" / name).rename(tmp_path / name)
    given = open_recording(tmp_path / "a", tmp_path / "camera.yaml", tmp_path / "rgb_camera.yaml")
    np.testing.assert_array_equal(next(given.frames()).rgb, frame.rgb)
    given = open_recording(tmp_path / "a", LensCamera(DEPTH_CAMERA, (-0.1, 0.01, 0, 0)), camera)
    np.testing.assert_array_equal(next(given.frames()).rgb, frame.rgb)


def test_colours_of_another_size_without_their_camera_are_refused_with_the_fix(frames, tmp_path):
    write_folder(tmp_path, frames)
    for path in (tmp_path / "rgb").iterdir():
        write_png(path, np.zeros((135, 240, 3), np.uint8))
    with pytest.raises(ValueError, match=r"240 x 135 .* 128 x 106 have to be registered: give their camera"):
        open_recording(tmp_path)


def test_a_recorder_refuses_what_does_not_fit_its_cameras(scene, tmp_path):
    depth, rgb = scene
    recorder = Recorder(tmp_path / "a", Camera(90, 90, 60, 50, 120, 106))
    with pytest.raises(ValueError, match=r"depth: expected float metres of shape \(106, 120\).*\(106, 128\)"):
        recorder.write(RgbdFrame(0, "a", depth, rgb))
    with Recorder(tmp_path / "b", DEPTH_CAMERA) as recorder:
        with pytest.raises(ValueError, match="depth: expected float metres"):
            recorder.write(RgbdFrame(0, "a", integers(depth), rgb))
        recorder.write(RgbdFrame(0, "a", None, None, None, "cut off"))
        recorder.write(RgbdFrame(1, "b", depth, rgb))
    with pytest.raises(FileExistsError, match="not empty"):
        Recorder(tmp_path / "b", DEPTH_CAMERA)
    assert [frame.name for frame in open_recording(tmp_path / "b").frames()] == ["b"]
