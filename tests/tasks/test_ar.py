"""task=ar on a recording in memory; recordings in files have tests of their own."""

import json

import av
import numpy as np
import pytest

from ljn.demo import FRAMES
from ljn.pipeline.samples import find_samples
from ljn.system.recording import RgbdFrame
from ljn.tasks.ar import ar


class Held:
    """A person who holds still, 25 frames a second; frames 2 cannot be read."""

    name, fps, num_frames = "held", 25.0, 5

    def __init__(self):
        sample = find_samples(FRAMES)[0]
        self.camera = sample.camera
        self.depth = (sample.frames[0].read().depth / 1000).astype(np.float32)
        self.facts = {"layout": "in memory"}
        self.asked = []
        self.breaks_at = None

    def frames(self, start=0):
        for number in range(start, self.num_frames):
            self.asked.append(number)
            if number == self.breaks_at:
                raise KeyboardInterrupt
            if number == 2:
                yield RgbdFrame(number, f"f{number}", None, error="the file is cut off")
                continue
            moved = np.where(self.depth > 0, self.depth + 0.002 * number, 0).astype(np.float32)
            yield RgbdFrame(number, f"f{number}", moved, timestamp_s=number / 25)


@pytest.fixture
def recording(monkeypatch):
    held = Held()
    monkeypatch.setattr("ljn.tasks.ar._recording", lambda cfg: held)
    return held


def config(compose_config, tmp_path, *overrides):
    return compose_config("task=ar", f"paths.output_dir={tmp_path}", "trainer.accelerator=cpu", *overrides)


def video_length(path):
    with av.open(str(path)) as video:
        return sum(1 for _ in video.decode(video=0))


def test_a_recording_leaves_video_motion_and_a_page(recording, compose_config, tmp_path):
    metrics = ar(config(compose_config, tmp_path))
    assert metrics["ar/frames"] == 5
    assert metrics["ar/failed"] == 1
    directory = tmp_path / "ar" / "held"
    assert video_length(directory / "overlay.mp4") == 5
    motion = np.load(directory / "motion.npz")
    assert motion["poses"].shape == (5, 156)
    assert float(motion["mocap_framerate"]) == 25
    assert "MOTION\nFrames: 5" in (directory / "motion.bvh").read_text()
    summary = json.loads((directory / "summary.json").read_text())
    assert summary["errors"] == {"the file is cut off": 1}
    assert set(summary["frames_per_second"]) >= {"joints and mesh", "overlay", "all"}
    page = (directory / "index.html").read_text()
    assert "the file is cut off" in page
    assert "overlay.mp4" in page


def test_a_call_that_was_cut_off_leaves_a_video_and_the_same_call_goes_on(
    recording, compose_config, tmp_path
):
    whole = tmp_path / "whole"
    cfg = config(compose_config, whole, "task.smooth=true")
    ar(cfg)
    recording.breaks_at, recording.asked = 3, []
    cfg = config(compose_config, tmp_path, "task.smooth=true")
    with pytest.raises(KeyboardInterrupt):
        ar(cfg)
    directory = tmp_path / "ar" / "held"
    assert video_length(directory / "overlay.mp4") == 3
    recording.breaks_at, recording.asked = None, []
    assert ar(cfg)["ar/frames"] == 5
    assert recording.asked == [3, 4]
    assert video_length(directory / "overlay.mp4") == 5
    # As if it had never been cut off.
    for name in ("poses", "trans", "betas"):
        ours, theirs = (np.load(each / "motion.npz")[name] for each in (directory, whole / "ar" / "held"))
        np.testing.assert_array_equal(ours, theirs)
    recording.asked = []
    ar(cfg)
    assert recording.asked == []
    # Other settings begin anew.
    ar(config(compose_config, tmp_path, "task.max_frames=2"))
    assert recording.asked == [0, 1]


@pytest.mark.slow
def test_what_is_complete_is_not_made_again(recording, compose_config, tmp_path, monkeypatch, caplog):
    cfg = config(compose_config, tmp_path, "task.max_frames=2")
    first = ar(cfg)
    directory = tmp_path / "ar" / "held"
    before = {path: path.stat().st_mtime_ns for path in directory.rglob("*") if path.is_file()}
    recording.asked = []
    with caplog.at_level("INFO"):
        assert ar(cfg) == first
    assert recording.asked == []
    assert f"{directory} is complete; predict it again with rerun=true" in caplog.text
    assert {path: path.stat().st_mtime_ns for path in before} == before
    # What somebody has removed is made again, of the frames that are there.
    (directory / "motion.bvh").unlink()
    ar(cfg)
    assert (directory / "motion.bvh").is_file()
    assert recording.asked == []
    ar(config(compose_config, tmp_path, "task.max_frames=2", "rerun=true"))
    assert recording.asked == [0, 1]
    recording.asked = []
    assert ar(config(compose_config, tmp_path))["ar/frames"] == 5
    assert recording.asked == [2, 3, 4]
    assert video_length(directory / "overlay.mp4") == 5


def test_nothing_of_other_settings_is_left(recording, compose_config, tmp_path):
    ar(config(compose_config, tmp_path))
    recording.depth = recording.depth * 0
    with pytest.raises(ValueError, match="none of 5 frames"):
        ar(config(compose_config, tmp_path, "task.smooth=true"))
    left = {path.name for path in (tmp_path / "ar" / "held").iterdir()}
    assert left == {
        "frames",
        "pictures",
        "settings.json",
        "overlay.mp4",
        "overview.jpg",
        "summary.json",
        "index.html",
    }


def test_what_cannot_be_is_named(compose_config, tmp_path):
    with pytest.raises(
        ValueError, match=r"input, recording: expected one of them, got neither; python run.py task=ar"
    ):
        ar(config(compose_config, tmp_path))


def test_a_sensor_that_cannot_be_opened_is_a_user_s_error(compose_config, tmp_path, monkeypatch):
    def fails(*_):
        raise RuntimeError("input: no camera can be opened: is it plugged in?")

    monkeypatch.setattr("ljn.tasks.ar.open_recording", fails)
    with pytest.raises(ValueError, match="is it plugged in"):
        ar(config(compose_config, tmp_path, "task.input=live:realsense"))


def test_a_recording_without_a_person_is_an_error_that_says_why(recording, compose_config, tmp_path):
    recording.depth = recording.depth * 0
    with pytest.raises(ValueError, match=r"none of 5 frames could be predicted: 4 x depth: all pixels are 0"):
        ar(config(compose_config, tmp_path))


def test_true_keypoints_are_those_of_a_recording_whose_truth_is_known(recording, compose_config, tmp_path):
    with pytest.raises(
        ValueError, match=r"task.true_keypoints: expected a recording whose truth is known.*'held'"
    ):
        ar(config(compose_config, tmp_path, "task.true_keypoints=true"))
