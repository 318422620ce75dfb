"""What goes wrong with recordings, from the command to the page: nothing is silently wrong, and the rest is done."""

import json
import re
import shutil

import cv2
import numpy as np
import pytest

from datamodules.recording import write_recording
from ljn.building import build
from ljn.pipeline.pipeline import Pipeline
from ljn.system.readers import Recorder, open_recording
from ljn.tasks.ar import ar

NUM = 6


@pytest.fixture(scope="module")
def good(compose_config, tmp_path_factory):
    """A recording of six frames, and one of the same room without anybody."""
    folder = tmp_path_factory.mktemp("recordings")
    recording = build(
        compose_config("task=ar", "recording=synthetic", f"recording.num_frames={NUM}").recording
    )
    write_recording(recording, folder / "person")
    with Recorder(folder / "empty", recording.camera) as recorder:
        for number in range(NUM):
            recorder.write(recording.empty_frame(number)._replace(name=f"{number:06d}"))
    return folder


@pytest.fixture(scope="module")
def pipeline():
    return Pipeline.from_pretrained()


class Folder:
    """A recording to be damaged."""

    def __init__(self, path, good):
        self.path, self.good = path, good
        shutil.copytree(good / "person", path)
        self.masks = np.load(path / "truth.npz")["mask"]

    def change(self, kind, change, numbers=range(NUM)):
        """Replace images by `change(image, number)`."""
        for number in numbers:
            path = self.path / kind / f"{number:06d}.png"
            image = change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), number)
            assert cv2.imwrite(str(path), image)

    def empty(self, numbers):
        """Take the person away."""
        for kind in ("depth", "rgb"):
            for number in numbers:
                name = f"{kind}/{number:06d}.png"
                shutil.copy(self.good / "empty" / name, self.path / name)


def without_last_colours(folder):
    for number in (4, 5):
        (folder.path / "rgb" / f"{number:06d}.png").unlink()


def larger_colours(folder):
    folder.change("rgb", lambda image, _: cv2.resize(image, (640, 480)))


def no_camera(folder):
    (folder.path / "camera.yaml").unlink()


def camera_of_another_size(folder):
    text = (folder.path / "camera.yaml").read_text()
    (folder.path / "camera.yaml").write_text(
        text.replace("width: 512", "width: 640").replace("height: 424", "height: 480")
    )


def red_curtain(folder):
    folder.change(
        "rgb", lambda image, number: np.where(folder.masks[number][..., None], image, image[..., [0, 2, 1]])
    )


def green_clothes(folder):
    def dye(image, number):
        grey = image.mean(-1, keepdims=True)
        return np.where(folder.masks[number][..., None], (grey * [0.5, 1.5, 0.4]).clip(0, 255), image).astype(
            np.uint8
        )

    folder.change("rgb", dye)


def nobody(folder):
    folder.empty(range(NUM))


def nobody_for_a_while(folder):
    folder.empty([2, 3])


def two_persons(folder, numbers=(3,)):
    # Somebody, 1.6 m beside somebody who looks alike.
    for kind in ("depth", "rgb"):

        def doubled(image, number, kind=kind):
            both = cv2.imread(str(folder.good / "empty" / kind / f"{number:06d}.png"), cv2.IMREAD_UNCHANGED)
            for shift in (-150, 150):
                moved = np.roll(folder.masks[number], shift, 1)
                both[moved] = np.roll(image, shift, 1)[moved]
            return both

        folder.change(kind, doubled, numbers)


def cut_short(folder):
    for name in ("depth/000001.png", "rgb/000004.png"):
        content = (folder.path / name).read_bytes()
        (folder.path / name).write_bytes(content[: len(content) // 2])


def times_that_jump(folder):
    times = [0, 0.033, 0.02, 0.1, 5.0, 5.033]
    lines = "".join(f"{number:06d},{time}\n" for number, time in enumerate(times))
    (folder.path / "timestamps.csv").write_text(f"name,timestamp_s\n{lines}")


def fifths_of_millimetres(folder):
    folder.change("depth", lambda image, _: (5 * image.astype(int)).clip(0, 64000).astype(np.uint16))


def centimetres(folder):
    folder.change("depth", lambda image, _: image // 10)


def no_files(folder):
    shutil.rmtree(folder.path)
    folder.path.mkdir()


def no_depth_images(folder):
    shutil.rmtree(folder.path / "depth")
    (folder.path / "depth").mkdir()


def video_that_ends(folder):
    size = 512, 424
    video = cv2.VideoWriter(str(folder.path / "rgb.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 30, size)
    for number in range(NUM - 1):
        video.write(cv2.imread(str(folder.path / "rgb" / f"{number:06d}.png")))
    video.release()
    shutil.rmtree(folder.path / "rgb")


def run(compose_config, tmp_path, folder, *overrides):
    cfg = compose_config(
        "task=ar",
        f"task.input={folder}",
        f"paths.output_dir={tmp_path}",
        "trainer.accelerator=cpu",
        *overrides,
    )
    return ar(cfg)


def left(tmp_path):
    """Directory, summary and page of the only call below a folder."""
    [directory] = (tmp_path / "ar").iterdir()
    return (
        directory,
        json.loads((directory / "summary.json").read_text()),
        (directory / "index.html").read_text(),
    )


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            larger_colours,
            "rgb: images of 640 x 480 .* beside depth of 512 x 424 have to be registered: give their",
        ),
        (no_camera, "no camera file in .*write camera.yaml with fx, fy"),
        (
            camera_of_another_size,
            "expected the camera's 640 x 480 pixels .* got 512 x 424; give the camera of these",
        ),
        (centimetres, "nearer than 0.3.* another unit.*depth_scale in camera.yaml"),
        (no_files, "is no recording: looked for .*depth/"),
        (no_depth_images, "no depth image in .*expected PNG of 16 bits"),
    ],
)
def test_what_is_no_recording_is_refused_before_anything_begins(
    compose_config, good, tmp_path, damage, message
):
    folder = Folder(tmp_path / "damaged", good)
    damage(folder)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        run(compose_config, tmp_path, folder.path, "segmentation=curtain")
    assert not (tmp_path / "ar").exists()


@pytest.mark.parametrize(
    ("damage", "segmentation", "message"),
    [
        (red_curtain, "curtain", "expected a green curtain behind the person, got .*segmentation=depth_only"),
        (green_clothes, "curtain", "the person's clothes are green: .*wear other ones"),
        (nobody, "curtain", "expected a person, found nobody"),
        (nobody, "depth_only", "flatter than a person|no person was found"),
        (nobody, None, "no person was found"),
        (fifths_of_millimetres, "curtain", "several persons. Or is the depth in another unit"),
    ],
)
def test_where_no_frame_can_be_predicted_the_error_and_the_page_say_why(
    compose_config, good, pipeline, monkeypatch, tmp_path, damage, segmentation, message
):
    monkeypatch.setattr("ljn.tasks.ar._pipeline", lambda *_: pipeline)
    folder = Folder(tmp_path / "damaged", good)
    damage(folder)
    with pytest.raises(ValueError, match=f"none of 6 frames could be predicted: .*{message}"):
        run(
            compose_config, tmp_path, folder.path, *([f"segmentation={segmentation}"] if segmentation else [])
        )
    directory, summary, page = left(tmp_path)
    assert (summary["predicted"], sum(summary["errors"].values())) == (0, 6)
    assert not list(directory.glob("motion.*"))
    for error in summary["errors"]:
        assert error.split("'")[0] in page


@pytest.mark.parametrize(
    ("damage", "failed", "message"),
    [
        (without_last_colours, [4, 5], "no colour image of the frame '00000[45]', although others have one"),
        (video_that_ends, [5], "no colour image of the frame '000005'"),
        (nobody_for_a_while, [2, 3], "found nobody"),
        (two_persons, [3], "several persons"),
        (cut_short, [1, 4], "(depth/000001|rgb/000004).png' is damaged, cut off"),
        (times_that_jump, [], None),
    ],
)
def test_frames_that_fail_are_told_and_the_others_are_done(
    compose_config, good, pipeline, monkeypatch, tmp_path, caplog, damage, failed, message
):
    monkeypatch.setattr("ljn.tasks.ar._pipeline", lambda *_: pipeline)
    folder = Folder(tmp_path / "damaged", good)
    damage(folder)
    with caplog.at_level("INFO"):
        metrics = run(compose_config, tmp_path, folder.path, "segmentation=curtain", "task.smooth=true")
    assert (metrics["ar/frames"], metrics["ar/failed"]) == (6, len(failed))
    assert f"{6 - len(failed)} of 6 frames predicted" in caplog.text
    directory, summary, page = left(tmp_path)
    told = {each["number"]: each["error"] for each in summary["per_frame"] if each["error"] is not None}
    assert list(told) == failed
    truth = np.load(good / "person" / "truth.npz")
    for number in range(NUM):
        arrays = np.load(directory / "frames" / f"{number:06d}.npz")
        assert ("joints" in arrays) == (number not in failed)
        if "joints" in arrays:
            error = np.linalg.norm(arrays["joints"] - truth["joints"][number], axis=-1).mean()
            assert error < 0.06, "what is done is as good as ever"
    for error in told.values():
        assert re.search(message, error)
    if failed:
        assert f"{len(failed)} frames failed" in caplog.text
        assert "Frames that failed" in page
    else:
        assert summary["recording"]["jumps_in_time"] == summary["recording"]["times_that_go_back"] == 1
        assert "jumps in time" in page


def test_of_two_persons_in_a_room_it_is_doubted_who_is_meant(
    compose_config, good, pipeline, monkeypatch, tmp_path
):
    monkeypatch.setattr("ljn.tasks.ar._pipeline", lambda *_: pipeline)
    folder = Folder(tmp_path / "damaged", good)
    two_persons(folder, range(NUM))
    metrics = run(compose_config, tmp_path, folder.path, "segmentation=depth_only")
    assert metrics["ar/failed"] == 0
    _, summary, page = left(tmp_path)
    assert "2 things have a person's size and shape" in summary["per_frame"][0]["warnings"][0]
    assert "segmentation.seed" in page
    # Told who is meant, there is no doubt about that.
    run(compose_config, tmp_path, folder.path, "segmentation=depth_only", "segmentation.seed=[0.8,0,2.2]")
    directory, _, page = left(tmp_path)
    assert "things have a person's size and shape" not in page
    truth = np.load(good / "person" / "truth.npz")["joints"]
    found = np.load(directory / "frames" / "000005.npz")["joints"]
    assert found[0, 0] - truth[5, 0, 0] == pytest.approx(0.8, abs=0.2), "the one to the right"


def test_a_sensor_that_stops_leaves_what_it_has_given(compose_config, good, pipeline, monkeypatch, tmp_path):
    monkeypatch.setattr("ljn.tasks.ar._pipeline", lambda *_: pipeline)

    class Slow:
        """Frames of a replay for some of which there was no time, and an end."""

        def __init__(self):
            self.files = open_recording(good / "person")
            self.name, self.camera, self.num_frames, self.fps = "slow", self.files.camera, None, 30.0
            self.facts = {"layout": "live"}

        def frames(self, start=0):
            yield from self.files.chosen_frames([0, 2, 4])
            self.facts["ended"] = "no frame for 5 s: was it unplugged?"

    monkeypatch.setattr("ljn.tasks.ar._recording", lambda cfg: Slow())
    metrics = run(compose_config, tmp_path, "live:replay:slow", "segmentation=curtain")
    assert metrics["ar/frames"] == 3
    directory, summary, page = left(tmp_path)
    assert [each["number"] for each in summary["per_frame"]] == [0, 2, 4]
    assert "was it unplugged?" in page
    assert summary["recording"]["ended"].startswith("no frame")
    # As fast as it was: every second frame of 30 a second.
    motion = np.load(directory / "motion.npz")
    assert (len(motion["poses"]), float(motion["mocap_framerate"])) == (3, pytest.approx(15, abs=0.01))
    assert directory.name.startswith("slow-"), "each has a folder of its own"


def test_a_sensor_without_a_frame_is_an_error(compose_config, good, pipeline, monkeypatch, tmp_path):
    monkeypatch.setattr("ljn.tasks.ar._pipeline", lambda *_: pipeline)
    recording = open_recording(f"live:replay:{good / 'person'}")
    monkeypatch.setattr(type(recording), "frames", lambda self, start=0: iter(()))
    monkeypatch.setattr("ljn.tasks.ar._recording", lambda cfg: recording)
    with pytest.raises(ValueError, match="input: expected frames, got none"):
        run(compose_config, tmp_path, "live:replay:nothing")


@pytest.mark.slow
def test_the_command_s_exit_code_says_whether_anything_could_be_done(run_py, good, tmp_path):
    folder = Folder(tmp_path / "damaged", good)
    cut_short(folder)
    arguments = ["task=ar", f"input={folder.path}", f"paths.output_dir={tmp_path}", "segmentation=curtain"]
    done = run_py(*arguments, "trainer.accelerator=cpu")
    assert "4 of 6 frames predicted" in done.stdout + done.stderr
    nobody(folder)
    done = run_py(*arguments, "trainer.accelerator=cpu", check=False)
    assert done.returncode == 1
    assert (
        "error: input: none of 6 frames could be predicted: 6 x frame.depth: expected a person" in done.stderr
    )
    assert "Traceback" not in done.stderr
