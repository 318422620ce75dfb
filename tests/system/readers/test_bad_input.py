import numpy as np
import pytest

from ljn.system.readers import Recorder, open_recording
from ljn.system.readers.timestamps import match, since_first
from ljn.system.recording import RgbdFrame
from tests.system.readers.conftest import DEPTH_CAMERA, RGB_CAMERA
from tests.system.readers.test_layouts import integers, write_camera, write_png, write_tum, write_video


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


def test_two_images_of_one_frame_are_refused(walk, frames):
    np.save(walk / "depth" / "0002.npy", frames[0][0])
    (walk / "depth" / "._0003.png").write_bytes(b"left behind")
    with pytest.raises(ValueError, match=r"'0002\.npy' and '0002\.png' in .* are of one frame"):
        open_recording(walk)


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
        ("0\n" * 3000, "6000 bytes, expected at most 5000"),
    ],
)
def test_timestamps_that_are_none_are_refused(walk, text, message, monkeypatch):
    monkeypatch.setattr("ljn.system.readers.timestamps._MAX_BYTES", 5000)
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
    (walk / "timestamps.csv").write_text("\n".join(f"{i} {i / 5}" for i in range(6)))  # numbers of its own
    assert [frame.timestamp_s for frame in open_recording(walk).frames()] == pytest.approx(
        [i / 5 for i in range(6)]
    )


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
