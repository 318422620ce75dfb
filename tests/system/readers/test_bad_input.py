import json
from functools import partial

import cv2
import numpy as np
import pytest

from ljn.system.readers import LensCamera, Recorder, open_recording
from ljn.system.readers.cameras import read_lens_camera
from ljn.system.readers.timestamps import match, since_first
from ljn.system.recording import RgbdFrame
from tests.system.readers.conftest import DEPTH_CAMERA, RGB_CAMERA, as_tuples, turned
from tests.system.readers.test_layouts import integers, write_camera, write_png, write_tum, write_video


@pytest.fixture
def walk(frames, tmp_path):
    """A recording of our format that may be damaged."""
    with Recorder(tmp_path / "walk", DEPTH_CAMERA) as recorder:
        for i, (depth, rgb) in enumerate(zip(*frames)):
            recorder.write(RgbdFrame(i, f"{i:04d}", depth, rgb, i / 10))
    return tmp_path / "walk"


def errors_of(recording):
    """The numbers of the frames that are marked, and why."""
    found = list(recording.frames())
    assert [frame.number for frame in found] == list(range(recording.num_frames))
    return {frame.number: frame.error for frame in found if frame.error is not None}


def test_what_is_no_recording_is_told_what_was_looked_for(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"input: no folder '.*nowhere'"):
        open_recording(tmp_path / "nowhere")
    with pytest.raises(
        ValueError, match=r"is no recording: looked for .*associations\.txt.*depth/.*rgb\.mp4.*\.bag"
    ):
        open_recording(tmp_path)
    (tmp_path / "rgb.mp4").write_bytes(b"")
    with pytest.raises(ValueError, match="is no recording"):
        open_recording(tmp_path / "rgb.mp4")


def test_empty_folders_are_refused(walk):
    for path in (walk / "rgb").iterdir():
        path.unlink()
    with pytest.raises(FileNotFoundError, match=r"no colour image in '.*rgb'.*remove the folder"):
        open_recording(walk)
    for path in (walk / "depth").iterdir():
        path.unlink()
    with pytest.raises(FileNotFoundError, match="no depth image in"):
        open_recording(walk)


def test_without_a_camera_file_there_is_no_recording(walk):
    (walk / "camera.yaml").unlink()
    with pytest.raises(
        FileNotFoundError, match=r"camera: no camera file in .*write camera\.yaml with fx, fy"
    ):
        open_recording(walk)
    assert open_recording(walk, DEPTH_CAMERA).num_frames == 6


def test_a_camera_of_another_size_is_refused(walk):
    with pytest.raises(ValueError, match=r"depth: expected the camera's 240 x 135 pixels .* got 128 x 106"):
        open_recording(walk, RGB_CAMERA)
    with pytest.raises(ValueError, match=r"rgb: expected the colour camera's 240 x 135 .* got 128 x 106"):
        open_recording(walk, rgb_camera=RGB_CAMERA)


def test_frames_that_are_cut_short_are_marked_and_the_rest_goes_on(walk):
    for name, size in (("depth/0002.png", 0.7), ("rgb/0004.png", 0.5), ("depth/0005.png", 0)):
        content = (walk / name).read_bytes()
        (walk / name).write_bytes(content[: int(size * len(content))])
    recording = open_recording(walk)
    found = list(recording.frames())
    assert [frame.error is None for frame in found] == [True, True, False, True, False, False]
    assert "depth: '" in found[2].error
    assert "damaged" in found[2].error
    assert found[2].depth is None
    assert "rgb: '" in found[4].error
    assert found[4].depth is not None
    assert found[4].rgb is None
    assert recording.facts["unreadable"] == 3
    list(recording.frames(4))
    assert recording.facts["unreadable"] == 3, "each is counted once"


def test_frames_of_another_size_or_kind_are_marked(walk, frames):
    write_png(walk / "depth" / "0001.png", integers(frames[0][1][:-2]))
    write_png(walk / "rgb" / "0002.png", frames[1][2][:, :-2])
    write_png(walk / "depth" / "0003.png", integers(frames[0][3]).astype(np.uint8))
    errors = errors_of(open_recording(walk))
    assert errors.keys() == {1, 2, 3}
    assert "got 128 x 104" in errors[1]
    assert "126 x 106" in errors[2]
    assert "16 bits" in errors[3]


def test_where_no_frame_can_be_read_nothing_begins(walk):
    for path in (walk / "depth").iterdir():
        path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(ValueError, match=r"none of 6 frames of .* can be read: depth: .* is damaged"):
        open_recording(walk)


def test_images_without_a_partner_are_marked_in_their_place(walk):
    (walk / "rgb" / "0001.png").unlink()
    (walk / "depth" / "0003.png").unlink()
    recording = open_recording(walk)
    errors = errors_of(recording)
    assert errors.keys() == {1, 3}
    assert "no colour image of the frame '0001'" in errors[1]
    assert "no depth image of the frame '0003'" in errors[3]
    assert recording.facts["frames_without_depth"] == recording.facts["frames_without_colours"] == 1


def test_images_without_any_common_name_or_number_are_refused(walk):
    for number, path in enumerate(sorted((walk / "rgb").iterdir())):
        path.rename(path.with_name(f"{100 + number}.png"))
    with pytest.raises(ValueError, match=r"such as '100' and '0000'.; give both the same names"):
        open_recording(walk)


def test_a_video_of_another_length_is_marked_or_refused(frames, scene, tmp_path):
    def record(folder, num_depth, num_rgb):
        with Recorder(folder, DEPTH_CAMERA) as recorder:
            for i in range(num_depth):
                recorder.write(RgbdFrame(i, f"{i:04d}", scene[0]))
        write_video(folder / "rgb.avi", np.stack([scene[1]] * num_rgb))
        return open_recording(folder)

    shorter = record(tmp_path / "a", 6, 4)
    assert errors_of(shorter).keys() == {4, 5}
    assert shorter.facts["frames_without_colours"] == 2
    longer = record(tmp_path / "b", 4, 6)
    assert errors_of(longer) == {}
    assert longer.facts["colours_without_depth"] == 2
    with pytest.raises(
        ValueError, match=r"has 20 frames beside 10 depth images, .* cut them to the same length"
    ):
        record(tmp_path / "c", 10, 20)


def test_a_video_that_is_cut_short_or_none_is_told(walk, scene):
    for path in (walk / "rgb").iterdir():
        path.unlink()
    (walk / "rgb").rmdir()
    write_video(walk / "rgb.mkv", np.stack([scene[1]] * 6))
    content = (walk / "rgb.mkv").read_bytes()
    (walk / "rgb.mkv").write_bytes(content[: len(content) // 2])
    recording = open_recording(walk)
    errors = errors_of(recording)
    assert set(errors) <= {2, 3, 4, 5}
    assert len(errors) >= 2
    assert "the video" in errors[5]
    (walk / "rgb.mkv").write_bytes(content[:100])
    with pytest.raises(ValueError, match="damaged"):
        open_recording(walk)


def test_times_that_go_back_are_not_known_and_jumps_are_counted(walk):
    (walk / "timestamps.csv").write_text(
        "name,timestamp_ms\n"
        + "\n".join(f"{i:04d},{t}" for i, t in enumerate([7000, 7100, 7050, 7200, 9200, 9300]))
    )
    recording = open_recording(walk)
    found = list(recording.frames())
    assert [frame.error for frame in found] == [None] * 6
    times = [frame.timestamp_s for frame in found]
    assert times[2] is None
    np.testing.assert_allclose([time for time in times if time is not None], [0, 0.1, 0.2, 2.2, 2.3])
    assert recording.facts["times_that_go_back"] == 1
    assert recording.facts["jumps_in_time"] == 1
    assert recording.fps == pytest.approx(10)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "\n".join(str(33_000 * i) for i in range(6)),
            r"expected seconds in .*name their unit .* name,timestamp_ms",
        ),
        ("0001,soon", "expected lines NAME,SECONDS in .* got 'soon'"),
        ("0001,inf", "got 'inf'"),
        ("\0" * 2**25, "expected at most"),
    ],
)
def test_timestamps_that_are_none_are_refused(walk, text, message):
    (walk / "timestamps.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        open_recording(walk)


def test_timestamps_that_are_too_few_are_left_out_or_missing(walk):
    (walk / "timestamps.csv").write_text("0\n0.1\n0.2")
    recording = open_recording(walk)
    assert {frame.timestamp_s for frame in recording.frames()} == {None}
    assert recording.fps is None
    assert "has 3 times for 6 frames" in recording.facts["timestamps"]
    (walk / "timestamps.csv").write_text(
        "name,timestamp_s\ndepth/0003.png,4.5\n0004.png, 4.6\n\n# end\n0005;nan"
    )
    recording = open_recording(walk)
    times = [frame.timestamp_s for frame in recording.frames()]
    assert times[:3] == [None] * 3
    assert times[3:5] == pytest.approx([0, 0.1])
    assert "no time for 4 of 6" in recording.facts["timestamps"]


def test_depth_in_another_unit_is_refused(frames, tmp_path):
    write_png(tmp_path / "depth" / "a.png", np.rint(10 * frames[0][0]).astype(np.uint16))
    write_camera(tmp_path / "camera.json")
    with pytest.raises(ValueError, match=r"another unit\? Integers are millimetres unless depth_scale"):
        open_recording(tmp_path)
    assert open_recording(tmp_path, depth_scale=10).facts["depth_scale"] == 10
    with pytest.raises(ValueError, match="depth_scale: expected a positive number"):
        open_recording(tmp_path, depth_scale=-1)
    np.save(tmp_path / "depth" / "a.npy", 1000 * frames[0][0])
    (tmp_path / "depth" / "a.png").unlink()
    with pytest.raises(ValueError, match=r"nearer than \d+ m: another unit"):
        open_recording(tmp_path)


def test_lists_of_tum_that_are_wrong_are_refused(frames, tmp_path):
    write_tum(tmp_path, frames, False)
    text = (tmp_path / "rgb.txt").read_text()
    (tmp_path / "rgb.txt").write_text(text.replace("13050311", "13050312"))
    with pytest.raises(ValueError, match=r"no image of .* within 0\.02 s .*are both of one clock"):
        open_recording(tmp_path)
    (tmp_path / "rgb.txt").write_text("# nothing")
    with pytest.raises(ValueError, match=r"expected lines TIMESTAMP FILE in .*, got none"):
        open_recording(tmp_path)
    (tmp_path / "rgb.txt").write_text("1.0 a.png b.png")
    with pytest.raises(ValueError, match=r"got '1\.0 a\.png b\.png'"):
        open_recording(tmp_path)
    (tmp_path / "associations.txt").write_text("now rgb/a.png 1.0 depth/a.png")
    with pytest.raises(ValueError, match=r"expected a timestamp in seconds in .*, got 'now'"):
        open_recording(tmp_path)
    (tmp_path / "associations.txt").write_text("# nothing")
    with pytest.raises(ValueError, match="no frames in"):
        open_recording(tmp_path)


# Cameras


def test_a_colour_camera_is_read_with_its_lens_and_place(tmp_path):
    motion = turned(20, [0.05, -0.01, 0.002])
    x, y, z, w = rotation_as_quaternion(motion[:3, :3])
    place = {"translation": motion[:3, 3].tolist()}
    forms = [
        {"extrinsics": {"rotation": motion[:3, :3].tolist(), **place}},
        {"extrinsics": {"quaternion_xyzw": [x, y, z, w], **place}},
        {"extrinsics": {"quaternion_wxyz": [w, x, y, z], **place}},
        {"extrinsics": {"rgb_from_depth": motion.tolist()}},
        {"extrinsics": motion.ravel().tolist()},
        {"rgb_from_depth": motion.tolist()},
    ]
    lens = {"distortion_model": "plumb_bob", "distortion_coefficients": [0.1, -0.2, 0.001, 0.002, 0.05]}
    for form in forms:
        write_camera(tmp_path / "rgb_camera.yaml", RGB_CAMERA, **lens, **form)
        found, others = read_lens_camera(tmp_path / "rgb_camera.yaml", is_rgb=True)
        assert found.camera == RGB_CAMERA
        assert found.distortion == (0.1, -0.2, 0.001, 0.002, 0.05)
        np.testing.assert_allclose(found.motion, motion, atol=1e-9)
        assert others == {}
    write_camera(tmp_path / "rgb_camera.yaml", RGB_CAMERA)
    assert read_lens_camera(tmp_path / "rgb_camera.yaml", is_rgb=True)[0] == LensCamera(RGB_CAMERA)


def rotation_as_quaternion(turn):
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(turn).as_quat().tolist()


SHIFT = {"translation": [0.05, 0, 0]}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"extrinsics": {"rotation": [[1, 0], [0, 1]], **SHIFT}}, "rotation: expected 9 numbers"),
        (
            {"extrinsics": {"rotation": np.eye(3).tolist(), "translation": [52.0, 0, 0]}},
            "got 52: millimetres",
        ),
        ({"extrinsics": {"rotation": (2 * np.eye(3)).tolist(), **SHIFT}}, "expected a rotation"),
        ({"extrinsics": {"rotation": np.diag([1.0, 1, -1]).tolist(), **SHIFT}}, "expected a rotation"),
        ({"extrinsics": {"quaternion_xyzw": [1, 1, 0, 0], **SHIFT}}, "unit quaternion"),
        ({"extrinsics": {"quaternion": [0, 0, 0, 1], **SHIFT}}, "got quaternion"),
        ({"extrinsics": {"rotation": np.eye(3).tolist()}}, "translation: expected 3 numbers, got None"),
        ({"extrinsics": np.eye(4)[:3].tolist()}, "expected 16 numbers"),
        ({"rgb_from_depth": (np.eye(4) + 1e-3).tolist()}, "last row 0, 0, 0, 1"),
        ({"extrinsics": "left"}, "expected 16 numbers"),
        ({"distortion_model": "equidistant", "D": [0.1, 0, 0, 0]}, "'equidistant', a fisheye"),
        ({"distortion_coefficients": [0.1, 0.2, 0.3]}, "expected 4, 5 or 8 of OpenCV's coefficients"),
        ({"distortion_coefficients": [0.1] * 12}, "expected 4, 5 or 8"),
        ({"distortion_coefficients": [0.1, "nan", 0, 0]}, "expected finite numbers"),
        ({"k1": 0.1}, "k1 are unknown"),
    ],
)
def test_a_wrong_colour_camera_is_refused(values, message, tmp_path):
    write_camera(tmp_path / "rgb_camera.yaml", RGB_CAMERA, **values)
    with pytest.raises(ValueError, match=message):
        read_lens_camera(tmp_path / "rgb_camera.yaml", is_rgb=True)


def test_a_depth_camera_has_no_place(tmp_path):
    write_camera(tmp_path / "camera.yaml", DEPTH_CAMERA, rgb_from_depth=as_tuples(np.eye(4)))
    with pytest.raises(ValueError, match="rgb_from_depth are unknown"):
        read_lens_camera(tmp_path / "camera.yaml")


# Times


def test_each_image_is_matched_once_with_the_nearest_in_time():
    rng = np.random.default_rng(0)
    for _ in range(50):
        a, b = rng.uniform(0, 1, rng.integers(1, 30)), rng.uniform(0, 1, rng.integers(1, 30))
        found = match(a, b, 0.02)
        taken = [j for j in found if j is not None]
        assert len(taken) == len(set(taken))
        nearest = np.abs(a[:, None] - b).argmin(1)
        for i, j in enumerate(found):
            rivals = np.flatnonzero(nearest == nearest[i])
            distances = np.abs(a[rivals] - b[nearest[i]])
            wins = rivals[distances.argmin()] == i and distances.min() <= 0.02
            assert j == (nearest[i] if wins else None)
    assert match([1.0], []) == [None]
    assert match([], [1.0]) == []


def test_times_begin_at_the_first_that_is_known():
    assert since_first([None, 5.0, None, 5.5]) == ([None, 0.0, None, 0.5], {})
    assert since_first([]) == ([], {})
    assert since_first([3.0, 3.0]) == ([0.0, None], {"times_that_go_back": 1})


# Anything


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
