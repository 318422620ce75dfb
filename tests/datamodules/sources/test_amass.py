import zipfile

import numpy as np
import pytest
import torch

from datamodules.sources.amass import AmassSource
from ljn.body import GENDERS
from ljn.geometry.rotations import smpl_pose_to_body_world

RELEASES = {
    "SMPL-H": {"width": 156, "gender": np.array(b"female"), "mocap_framerate": np.array(120.0), "betas": 16},
    "SMPL+H G": {"width": 156, "gender": np.array("male"), "mocap_framerate": np.array(100), "betas": 10},
    "SMPL-X": {"width": 165, "gender": np.array("neutral"), "mocap_frame_rate": np.array(60.0), "betas": 16},
    "SMPL": {"width": 72, "gender": np.array(["female"]), "mocap_framerate": np.array([50.0]), "betas": 10},
}


def fields_of(release, motion, **changes):
    """A file's fields as a release has them, of a motion's poses `(T, 72)` in a world that is z up."""
    about = dict(RELEASES[release])
    number, width = len(motion), about.pop("width")
    whole = np.random.default_rng(1).standard_normal((number, width))
    whole[:, :66] = motion[:, :66]
    if width == 72:
        whole = motion
    fields = {
        **about,
        "poses": whole,
        "trans": np.zeros((number, 3)),
        "betas": np.linspace(-1, 1, about["betas"]),
        **changes,
    }
    if release == "SMPL-X":
        fields |= {"surface_model_type": np.array("smplx"), "pose_jaw": np.zeros((number, 3))}
        fields |= {"markers_latent_vids": np.array({"a": 1}, object)}
    return {name: value for name, value in fields.items() if value is not None}


@pytest.fixture
def write_amass(tmp_path, some_poses):
    """Writes a file and returns its folder and its poses, in body world."""

    def write(release="SMPL-H", place="CMU/01/01_01_poses.npz", number=24, **changes):
        poses = smpl_pose_to_body_world(torch.from_numpy(some_poses(number))).numpy()
        path = tmp_path / "amass" / place
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, **fields_of(release, poses, **changes))
        return path, poses

    return write


@pytest.mark.parametrize("release", RELEASES)
def test_every_release_gives_the_joints_and_shapes_of_its_files(release, write_amass, joints_of):
    path, poses = write_amass(release)
    source = AmassSource(path, rate_hz=None, genders=("female", "male", "neutral"))
    recordings = source.recordings
    assert (recordings.subjects, recordings.clips, recordings.notes) == (("01",), ("01_01_poses",), {})
    np.testing.assert_allclose(joints_of(recordings.pose), joints_of(poses), atol=1e-4)
    np.testing.assert_allclose(recordings.pose[:, :66], poses[:, :66], atol=1e-5)
    if release != "SMPL":
        assert not recordings.pose[:, 66:].any(), "hands at rest"
    betas = np.linspace(-1, 1, RELEASES[release]["betas"])[:10]
    np.testing.assert_allclose(recordings.betas, np.tile(betas, (24, 1)), atol=1e-6)
    text = RELEASES[release]["gender"].reshape(-1)[0]
    assert set(recordings.gender) == {GENDERS[text.decode() if isinstance(text, bytes) else str(text)]}


def test_frames_come_at_the_rate_that_is_asked_for(write_amass):
    path, poses = write_amass(number=60)  # at 120 Hz
    source = AmassSource(path, rate_hz=10)
    np.testing.assert_array_equal(source.recordings.frame, np.arange(0, 60, 12))
    np.testing.assert_allclose(source.recordings.pose[1, :66], poses[12, :66], atol=1e-5)
    assert len(AmassSource(path, rate_hz=10, stride=2).recordings.frame) == 3
    assert len(AmassSource(path, rate_hz=500).recordings.frame) == 60


@pytest.mark.parametrize(
    ("changes", "note"),
    [
        ({"gender": None}, "gender: missing, or a Python object; it is drawn"),
        ({"gender": np.array("female", object)}, "gender: missing, or a Python object; it is drawn"),
        ({"gender": np.array("unknown")}, "gender: expected one of female, male, neutral, got 'unknown'; it is drawn"),
        ({"betas": None}, "betas: missing; they are drawn"),
        ({"mocap_framerate": None}, "mocap_framerate: missing, so all frames count"),
        ({"mocap_framerate": np.array(np.nan)}, "mocap_framerate: missing, so all frames count"),
    ],
)  # fmt: skip
def test_what_can_be_passed_over_is_noted(changes, note, write_amass, caplog):
    path, _ = write_amass(**changes)
    source = AmassSource(path.parents[2])
    assert source.recordings.notes == {"CMU/01/01_01_poses.npz": [note]}
    assert note in caplog.text
    assert set(source.recordings.gender) == {-1 if "gender" in changes else GENDERS["female"]}


@pytest.mark.parametrize("gender", [b"male", "male", "b'male'", "M", " Male"])
def test_genders_are_read_however_they_were_written(gender, write_amass):
    path, _ = write_amass(gender=np.array(gender))
    assert set(AmassSource(path).recordings.gender) == {GENDERS["male"]}


def test_bad_files_are_named_and_counted_and_cost_the_others_nothing(write_amass, caplog):
    path, _ = write_amass()
    root = path.parents[2]
    whole = path.read_bytes()
    bad = {
        "CMU/02/truncated.npz": (whole[: len(whole) // 2], "it cannot be read"),
        "CMU/02/empty.npz": (b"", "it cannot be read"),
        "CMU/02/text.npz": (b"<html>404</html>", "it cannot be read"),
    }
    for place, (content, _) in bad.items():
        (root / place).parent.mkdir(exist_ok=True)
        (root / place).write_bytes(content)
    write_amass(place="CMU/03/no_poses.npz", poses=None)
    write_amass(place="CMU/03/odd.npz", poses=np.zeros((5, 63)))
    write_amass(place="CMU/03/nan.npz", poses=np.full((5, 156), np.nan))
    poses = np.zeros((30, 156))
    poses[4:9, 7] = np.inf
    write_amass(place="CMU/04/some_nan.npz", poses=poses, mocap_framerate=np.array(10))
    write_amass(place="CMU/04/shape.npz", poses=None)
    write_amass(place="CMU/04/neutral_stagei.npz", poses=None)
    recordings = AmassSource(root).recordings
    expected = {place: why for place, (_, why) in bad.items()} | {
        "CMU/03/no_poses.npz": "poses: no such field",
        "CMU/03/odd.npz": r"poses: expected axis-angle values (T, N) with N one of 66, 72, 156, 165, got (5, 63)",
        "CMU/03/nan.npz": "poses: NaN, or rotations that no joint has, in all 5 frames",
    }
    assert recordings.skipped.keys() == expected.keys()
    for place, why in expected.items():
        assert why in recordings.skipped[place]
        assert f"{place} left out: " in caplog.text
    assert "6 of 8 files left out; the first is CMU/02/empty.npz" in caplog.text
    assert recordings.subjects == ("CMU/01", "CMU/04")
    assert recordings.notes == {
        "CMU/04/some_nan.npz": ["poses: NaN, or rotations that no joint has, in 5 of 30 frames, left out"]
    }
    assert recordings.frame[recordings.clip == 1].tolist() == [*range(4), *range(9, 30)]


def test_a_field_that_is_a_python_object_is_named_and_labels_that_are_cost_nothing(write_amass, joints_of):
    path, _ = write_amass(poses=np.array([{"a": 1}], object))
    with pytest.raises(
        ValueError, match=r"^poses: it holds object of shape \(1,\), expected numbers or text"
    ):
        AmassSource().read(path)
    labels = np.array([["C7"], ["LFHD", "RFHD"]], object)
    path, poses = write_amass("SMPL-X", latent_labels=labels, labels_obs=labels)
    np.testing.assert_allclose(AmassSource(rate_hz=None).read(path)[0].poses[:, :66], poses[:, :66])


def test_arrays_may_be_of_any_order_and_packing(write_amass, tmp_path):
    path, poses = write_amass()
    with np.load(path) as arrays:
        fields = dict(arrays)
    fields["poses"] = np.asfortranarray(fields["poses"].astype(">f4"))
    np.savez_compressed(path, **fields)
    np.testing.assert_allclose(
        AmassSource(rate_hz=None).read(path)[0].poses[:, :66], poses[:, :66], atol=1e-6
    )
    with zipfile.ZipFile(path, "w", allowZip64=True) as archive:
        for name, value in fields.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, value, allow_pickle=False)
    np.testing.assert_allclose(
        AmassSource(rate_hz=None).read(path)[0].poses[:, :66], poses[:, :66], atol=1e-6
    )


@pytest.mark.parametrize("value", [np.nan, 21.0, -1e9])
def test_shapes_that_no_one_has_are_refused(value, write_amass):
    path, _ = write_amass(betas=np.array([0, value, *np.zeros(14)]))
    write_amass(place="CMU/02/a_poses.npz", betas=np.array([*np.zeros(10), value]))  # the first ten count
    recordings = AmassSource(path.parents[2]).recordings
    assert recordings.subjects == ("CMU/02",)
    assert "betas: NaN, or beyond 20 standard deviations" in recordings.skipped["CMU/01/01_01_poses.npz"]


def test_files_that_python_2_wrote_are_read_in_silence(write_amass, recwarn):
    path, poses = write_amass()
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    old = members["poses.npy"]
    members["poses.npy"] = old[:128].replace(b"(24, 156), }  ", b"(24L, 156L), }") + old[128:]
    assert members["poses.npy"] != old
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    np.testing.assert_allclose(AmassSource(rate_hz=None).read(path)[0].poses[:, :66], poses[:, :66])
    assert not recwarn.list


def test_poses_may_come_in_two_parts(write_amass):
    path, poses = write_amass("SMPL-X", poses=None)
    parts = {"root_orient": poses[:, :3], "pose_body": poses[:, 3:66]}
    path, poses = write_amass("SMPL-X", poses=None, **parts)
    np.testing.assert_allclose(AmassSource(rate_hz=None).read(path)[0].poses[:, :66], poses[:, :66])
    path, _ = write_amass("SMPL-X", poses=None, **parts | {"pose_body": poses[:, 3:65]})
    with pytest.raises(
        ValueError, match=r"^root_orient, pose_body: expected shapes \(T, 3\) and \(T, 63\), got"
    ):
        AmassSource().read(path)


PLACES = {
    "CMU/01/01_01_poses.npz": "CMU/01",
    "CMU/02 b/02 ü_poses.npz": "CMU/02 b",
    "ACCAD/Female1General_c3d/A1 - Stand_poses.npz": "ACCAD/Female1",
    "ACCAD/Female1Walking_c3d/B1_poses.npz": "ACCAD/Female1",
    "ACCAD/MartialArtsWalksTurns_c3d/E1_poses.npz": "ACCAD/Male2",
    "ACCAD/s007/QkWalk1_poses.npz": "ACCAD/s007",
    "DanceDB/20120805_VasoAristeidou/V1_poses.npz": "DanceDB/VasoAristeidou",
    "DanceDB/20120807_VasoAristeidou/V2_poses.npz": "DanceDB/VasoAristeidou",
}


def test_a_person_has_one_name_at_whatever_level_a_folder_is_given(write_amass):
    for place in PLACES:
        path, _ = write_amass(place=f"SMPL_H_G/{place}")
    write_amass(place="SMPLX_N/CMU/01/01_01_stageii.npz", release="SMPL-X")
    release = path.parents[2]
    for root, start in (
        (release.parent, ""),
        (release, ""),
        (release / "CMU", "CMU/"),
        (release / "ACCAD", "ACCAD/"),
    ):
        recordings = AmassSource(root).recordings
        expected = {subject for subject in PLACES.values() if subject.startswith(start)}
        assert set(recordings.subjects) == expected, root
        assert recordings.skipped == {}
    assert len(AmassSource(release.parent).recordings.clips) == len(PLACES) + 1


def test_links_are_followed_once_and_leavings_passed_over(write_amass, tmp_path):
    path, _ = write_amass()
    root = tmp_path / "all"
    root.mkdir()
    (root / "CMU.tar.bz2").write_bytes(b"BZh9")
    with pytest.raises(
        FileNotFoundError, match=r"no \.npz file in .*all' or below; unpack the 1 archives there"
    ):
        AmassSource(root).check()
    (root / "CMU").symlink_to(path.parents[1])
    (path.parent / "again").symlink_to(root)
    (path.parent / "._01_01_poses.npz").write_bytes(b"Mac OS X")
    recordings = AmassSource(root).recordings
    assert (recordings.subjects, recordings.skipped) == (("CMU/01",), {})


def test_what_is_wrong_with_many_files_is_said_of_a_few_and_counted(write_amass, caplog, tmp_path):
    for number in range(9):
        path, _ = write_amass(place=f"CMU/{number}/a_poses.npz", gender=None, betas=None)

    def source():
        made = AmassSource(path.parents[2])
        made.cache_dir = tmp_path / "cache"
        return made

    recordings = source().recordings
    assert len(recordings.notes) == 9
    note = "gender: missing, or a Python object; it is drawn"
    assert caplog.text.count(f"a_poses.npz: {note}") == 3
    assert f"9 of 9 files: {note}" in caplog.text
    caplog.clear()
    assert source().recordings.notes == recordings.notes
    assert f"9 of 9 files: {note}" in caplog.text, "from the table that is kept, too"


def test_a_folder_without_a_file_that_can_be_read_is_an_error(write_amass, tmp_path):
    path, _ = write_amass(poses=None)
    with pytest.raises(
        ValueError, match=r"none of 1 files can be read; the first is .*01_01_poses.npz: poses: no"
    ):
        AmassSource(path.parents[2]).check()
    with pytest.raises(FileNotFoundError, match=r"data\.source\.path: no file or folder .*nowhere"):
        AmassSource(tmp_path / "nowhere").check()
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match=r"data\.source\.path: no \.npz file in .*empty"):
        AmassSource(tmp_path / "empty").check()
    with pytest.raises(
        ValueError, match=r"data\.source\.path: expected a folder of \.npz files, or one, got null"
    ):
        AmassSource().check()
