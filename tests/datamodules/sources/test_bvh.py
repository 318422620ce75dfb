import re

import numpy as np
import pytest
import torch

from datamodules.sources.bvh import BvhSource
from datamodules.sources.bvh.file import joint_transforms, read_bvh
from datamodules.sources.bvh.skeleton import NEEDED, SHIPPED, axes_of, fitting, known_skeletons, read_skeleton
from datamodules.sources.reference import REFERENCE_OFFSETS
from ljn.body.skeleton import JOINT_INDEX, JOINT_NAMES
from ljn.geometry.rotations import BODY_TO_OPENGL, rotmat_to_rotvec, rotvec_to_rotmat

OFFSETS = REFERENCE_OFFSETS.numpy()
MIXAMO_DOWN = (
    ("mixamorig:Hips", None, (0, 0, 0), "pelvis"),
    ("mixamorig:Spine", "mixamorig:Hips", (0, 10, 0), "spine1"),
    ("mixamorig:Spine1", "mixamorig:Spine", (0, 12, 0), "spine2"),
    ("mixamorig:Spine2", "mixamorig:Spine1", (0, 10, 0), "spine3"),
    ("mixamorig:Neck", "mixamorig:Spine2", (0, 15, 0), "neck"),
    ("mixamorig:Head", "mixamorig:Neck", (0, 8, 2), "head"),
    *(
        row
        for side, s, sign in (("Left", "l", 1), ("Right", "r", -1))
        for row in (
            (f"mixamorig:{side}Shoulder", "mixamorig:Spine2", (sign * 6, 9, 0), f"{s}_collar"),
            (f"mixamorig:{side}Arm", f"mixamorig:{side}Shoulder", (sign * 11, 0, 0), f"{s}_shoulder"),
            (f"mixamorig:{side}ForeArm", f"mixamorig:{side}Arm", (sign * 18, -19, 0), f"{s}_elbow"),
            (f"mixamorig:{side}Hand", f"mixamorig:{side}ForeArm", (sign * 17, -16, 2), f"{s}_wrist"),
            (f"mixamorig:{side}UpLeg", "mixamorig:Hips", (sign * 9, -5, 0), f"{s}_hip"),
            (f"mixamorig:{side}Leg", f"mixamorig:{side}UpLeg", (0, -42, 1), f"{s}_knee"),
            (f"mixamorig:{side}Foot", f"mixamorig:{side}Leg", (0, -43, -2), f"{s}_ankle"),
            (f"mixamorig:{side}ToeBase", f"mixamorig:{side}Foot", (0, -9, 14), f"{s}_foot"),
        )
    ),
)
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # y up to z up, with the front along -y


NEEDED_JOINTS = "joints: {" + ", ".join(f"{name}: {name}" for name in NEEDED) + "}\n"


def read_poses(path, text=None, **settings):
    """A file's poses, in SMPL's axes, and the notes."""
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    [motion] = BvhSource(**settings).read(path)
    pose = torch.from_numpy(motion.poses)
    root = BODY_TO_OPENGL @ rotvec_to_rotmat(pose[:, :3])
    return torch.cat([rotmat_to_rotvec(root), pose[:, 3:]], 1).numpy(), motion.notes


def without_guesses(poses, path, make_bvh):
    """Poses as the retargeting has them: collars and the first of the spine follow from others."""
    return read_poses(path, make_bvh(poses))[0]


def test_cmus_conversion_gives_the_joints_that_it_was_brought_to(cmu_poses, make_bvh, joints_of, tmp_path):
    with np.load(cmu_poses, allow_pickle=False) as arrays:
        poses = arrays["poses"].astype(np.float64)[::40]
    found, notes = read_poses(tmp_path / "01_01.bvh", make_bvh(poses))
    assert notes == ()
    assert np.abs(joints_of(found) - joints_of(poses)).max() < 0.004  # float16 radians in the file
    again, _ = read_poses(tmp_path / "01_02.bvh", make_bvh(found))
    assert np.abs(joints_of(again) - joints_of(found)).max() < 1e-4


@pytest.mark.parametrize("order", ["ZXY", "XYZ", "YZX"])
@pytest.mark.parametrize("axes", [None, Z_UP], ids=["y up", "z up"])
def test_a_round_trip_keeps_the_joints(order, axes, real_poses, make_bvh, joints_of, tmp_path):
    poses = without_guesses(real_poses, tmp_path / "first.bvh", make_bvh)
    found, _ = read_poses(tmp_path / "a.bvh", make_bvh(poses, order=order, axes=axes))
    np.testing.assert_allclose(joints_of(found), joints_of(poses), atol=1e-4)


def test_arms_that_rest_hanging_are_laid_on_smpls(real_poses, make_bvh, joints_of, tmp_path):
    text = make_bvh(real_poses, MIXAMO_DOWN)
    found, _ = read_poses(tmp_path / "a.bvh", text)
    # There the T-pose of the first frame counts, too. The writer's hands rest as SMPL's do, which no file's would.
    arms = slice(0, 22)
    np.testing.assert_allclose(joints_of(found)[1:, arms], joints_of(real_poses)[:, arms], atol=1e-4)
    resting = found[0].reshape(24, 3)
    assert np.rad2deg(resting[16, 2]) == pytest.approx(-45, abs=4)
    assert np.abs(resting[20:]).max() < 1e-6, "the hands hang with the arms"


def test_a_frame_can_stand_in_for_the_rest_pose(real_poses, make_bvh, joints_of, tmp_path):
    text = make_bvh(real_poses, MIXAMO_DOWN)
    # All bones along x, as some programs leave them; the first frame then shows a T-pose by its angles.
    bvh = read_bvh(_written(tmp_path / "a.bvh", text))
    skeleton = read_skeleton(known_file("mixamo"))
    broken = re.sub(r"OFFSET (\S+) (\S+) (\S+)", lambda m: f"OFFSET {_length(m)} 0 0", text)
    with pytest.raises(ValueError, match=r"rest pose shows no one standing upright.*rest_frame: 0"):
        read_poses(tmp_path / "b.bvh", broken)
    table = tmp_path / "mine.yaml"
    table.write_text(known_file("mixamo").read_text() + "rest_frame: 0\n")
    assert skeleton.find(bvh.names)
    found, _ = read_poses(tmp_path / "a.bvh", skeleton=table)
    np.testing.assert_allclose(joints_of(found)[1:, :22], joints_of(real_poses)[:, :22], atol=1e-4)


# The left, up and forward axes of some joints in a T-pose, worked out by hand from files of these data sets.
LAFAN1 = {
    "mixamorig:Hips": "z x y", "mixamorig:LeftUpLeg": "-z -x y", "mixamorig:RightLeg": "-z -x y",
    "mixamorig:RightUpLeg": "-z -x y", "mixamorig:LeftFoot": "-z y x", "mixamorig:RightFoot": "-z y x",
    "mixamorig:LeftShoulder": "x z -y", "mixamorig:RightShoulder": "-x -z -y",
}  # fmt: skip
BANDAI = {
    "Hips": "-y x z", "Spine": "z x y", "UpperLeg_L": "y -x z", "UpperLeg_R": "y x -z", "Foot_L": "y z x",
    "Foot_R": "y -z -x", "Shoulder_L": "x y z", "Shoulder_R": "x -y -z",
}  # fmt: skip
_BANDAI_NAMES = {
    "Hips": "Hips", "Spine1": "Spine", "Spine2": "Chest", "Neck": "Neck", "Head": "Head", "Shoulder": "Shoulder",
    "Arm": "UpperArm", "ForeArm": "LowerArm", "Hand": "Hand", "UpLeg": "UpperLeg", "Leg": "LowerLeg", "Foot": "Foot",
    "ToeBase": "Toes",
}  # fmt: skip


def bandai_skeleton():
    """The bones of `MIXAMO_DOWN` under the names of Bandai Namco's data sets."""
    short = {"mixamorig:Spine": "Hips"}
    for name, *_ in MIXAMO_DOWN:
        bare = name.partition(":")[2]
        side = next((side for side in ("Left", "Right") if bare.startswith(side)), "")
        if (known := _BANDAI_NAMES.get(bare.removeprefix(side))) is not None:
            short[name] = known + (f"_{side[0]}" if side else "")
    return [
        (short[name], short.get(parent), offset, joint)
        for name, parent, offset, joint in MIXAMO_DOWN
        if joint != "spine1"
    ]


@pytest.mark.parametrize("kind", ["lafan1", "bandai_namco"])
def test_skeletons_whose_bones_all_rest_along_one_axis_are_read(
    kind, real_poses, make_bvh, joints_of, tmp_path
):
    rows, texts = (MIXAMO_DOWN, LAFAN1) if kind == "lafan1" else (bandai_skeleton(), BANDAI)
    toes = {f"{side}_foot": 100 * OFFSETS[JOINT_INDEX[f"{side}_foot"]] for side in "lr"}
    rows = [(name, parent, toes.get(joint, offset), joint) for name, parent, offset, joint in rows]
    text = make_bvh(real_poses, rows, rest={name: axes_of(text) for name, text in texts.items()})
    found, notes = read_poses(tmp_path / "a.bvh", text)
    assert notes == ()
    if kind == "lafan1":
        with pytest.raises(ValueError, match="rest pose shows no one"):
            read_poses(tmp_path / "a.bvh", skeleton="mixamo")
    limbs = [index for index, name in enumerate(JOINT_NAMES) if name[2:] in ("knee", "ankle", "foot")]
    expected = joints_of(real_poses)
    np.testing.assert_allclose(joints_of(found)[:, limbs], expected[:, limbs], atol=1e-4)
    if kind == "lafan1":  # whose spine has all three parts
        np.testing.assert_allclose(joints_of(found)[:, :22], expected[:, :22], atol=1e-4)


def known_file(name):
    from datamodules.sources.bvh import skeleton

    return skeleton._DIRECTORY / f"{name}.yaml"


def _written(path, text):
    path.write_text(text)
    return path


def _length(match):
    return f"{np.linalg.norm([float(value) for value in match.groups()]):.4f}"


@pytest.mark.parametrize(
    ("change", "notes"),
    [
        (lambda text: text.replace("\n", "\r\n"), ()),
        (lambda text: text.replace("\n", "\r"), ()),
        (lambda text: text.replace("  ", "\t").replace(" ", "\t").replace("Frame\tTime", "Frame Time"), ()),
        (lambda text: text.replace(".", ","), ()),
        (lambda text: text.replace("{", "{\n").replace("MOTION\n", "MOTION  \n\n"), ()),
        (lambda text: "\ufeff" + text, ()),
        (lambda text: text.encode("utf-16"), ()),
        (lambda text: "# made by hand\n" + text.replace("{", "{\n// a joint"), ()),
        (
            lambda text: text.replace("Frame Time: 0.0333333", "Frame Time: 33.33"),
            ("Frame Time: expected seconds, got '33.33', so all frames count",),
        ),
        (lambda text: text.replace("End Site", "EndSite"), ()),
        (lambda text: text.replace("Frames:", "Frames :").replace("Frame Time:", "FrameTime :"), ()),
        (lambda text: text.replace("End Site\n", "End Site\n\n").lower(), ()),
        (lambda text: re.sub(r"((?:-?\d+\.\d+ ){20})", r"\1\n", text), ()),  # lines that end within a frame
        (lambda text: text.replace("Frames: 16", "Frames: 99"), ("Frames: '99' by the file, 16 lines are there",)),
        (lambda text: text.replace("Frames: 16", "Frames: 2"), ("Frames: '2' by the file, 16 lines are there",)),
        (
            lambda text: text.replace("Frame Time: 0.0333333", "Frame Time: 0"),
            ("Frame Time: expected seconds, got '0', so all frames count",),
        ),
    ],
)  # fmt: skip
def test_what_other_writers_do_is_read_alike(change, notes, real_poses, make_bvh, tmp_path):
    text = make_bvh(real_poses[:15])
    expected, _ = read_poses(tmp_path / "a.bvh", text)
    found, said = read_poses(tmp_path / "b.bvh", change(text))
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert said == notes


def test_frames_that_are_not_whole_are_left_out(real_poses, make_bvh, tmp_path):
    lines = make_bvh(real_poses[:15]).splitlines()
    lines[-3] = lines[-3].replace(lines[-3].split()[7], "nan", 1)
    lines[-1] = lines[-1][:60]
    found, notes = read_poses(tmp_path / "a.bvh", "\n".join(lines))
    expected, _ = read_poses(tmp_path / "b.bvh", make_bvh(real_poses[[*range(12), 13]]))
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert notes == ("MOTION: 2 of 16 frames are not 66 numbers, left out",)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: "", "MOTION: expected this line of a BVH file once, got it 0 times"),
        (lambda text: text[: text.index("MOTION") + 30], "MOTION: expected 'Frames: N' and 'Frame Time"),
        (lambda text: text.replace("\nMOTION", "}\nMOTION"), "a } too many"),
        (lambda text: text.replace("JOINT lShin", "JOINT"), "expected a name after JOINT"),
        (lambda text: text.replace("CHANNELS 3", "CHANNELS 4"), "CHANNELS: expected their number and as many"),
        (lambda text: text.replace("Zrotation", "Wrotation"), "CHANNELS: expected their number and as many of Xpos"),
        (lambda text: text.replace("OFFSET 0.000000 7.5", "OFFSET a 7.5"), "OFFSET: expected three numbers"),
        (lambda text: text.replace("OFFSET 0.000000 7.500000 0.300000", ""), "joint 'abdomen' has no OFFSET"),
        (
            lambda text: text.replace("JOINT lShin", "JOINT knee_left"),
            r"no known skeleton; the nearest is cmu_daz, without 'lShin or LeftShin' \(l_knee\).*source\.skeleton=FILE",
        ),
        (
            lambda text: text.replace("JOINT neck", "JOINT chest").replace("JOINT lCollar", "JOINT neck"),
            r"joint 'chest' \(spine3\) is there 2 times",
        ),
        (
            lambda text: re.sub(r"OFFSET.*", "OFFSET 0 0 0", text),
            "rest pose shows no one standing.*its spine has no length",
        ),
        (
            lambda text: re.sub(r"(?<=\n)[-\d. ]+(?=\n)", "nan " * 66, text),
            "MOTION: NaN, or what is no number, in all 1",
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_file_is_named(change, message, real_poses, make_bvh, tmp_path):
    with pytest.raises(ValueError, match=message):
        read_poses(tmp_path / "a.bvh", change(make_bvh(real_poses[:15])))


def test_positions_follow_the_hierarchy(real_poses, make_bvh, tmp_path):
    bvh = read_bvh(_written(tmp_path / "a.bvh", make_bvh(real_poses[:3])))
    rotations, positions = joint_transforms(bvh, np.arange(4))
    np.testing.assert_allclose(positions[1:, 0], [[0, 90, 0]] * 3)
    knee, foot = bvh.names.index("lShin"), bvh.names.index("lFoot")
    expected = positions[:, knee] + rotations[:, knee] @ torch.from_numpy(bvh.offsets[foot])
    np.testing.assert_allclose(positions[:, foot], expected)


# The tables of joints


@pytest.mark.parametrize("name", SHIPPED)
def test_the_skeletons_that_ship_are_read(name):
    [skeleton] = known_skeletons(name)
    assert skeleton.name == name


@pytest.mark.parametrize("prefix", ["mixamorig1:", "Character1_", "Armature|Bip_"])
def test_what_stands_before_all_names_does_not_count(prefix, real_poses, make_bvh, tmp_path):
    text = make_bvh(real_poses[:9], MIXAMO_DOWN)
    expected, _ = read_poses(tmp_path / "a.bvh", text)
    found, notes = read_poses(tmp_path / "b.bvh", text.replace("mixamorig:", prefix))
    assert notes == ()
    np.testing.assert_array_equal(found, expected)
    table = tmp_path / "mine.yaml"
    table.write_text(known_file("mixamo").read_text().replace(": Hips", f': "{prefix}Hips"'))
    again, _ = read_poses(tmp_path / "b.bvh", skeleton=table)
    np.testing.assert_array_equal(again, expected)


def test_joints_that_can_be_guessed_may_be_missing_and_a_spine_may_have_any_number(
    real_poses, make_bvh, joints_of, tmp_path
):
    rows = [row for row in MIXAMO_DOWN if row[3] not in ("l_foot", "r_foot", "spine3")]
    above = {"mixamorig:Spine2": "mixamorig:Spine1"}
    rows = [(name, above.get(parent, parent), *rest) for name, parent, *rest in rows]
    text = make_bvh(real_poses, rows)
    found, notes = read_poses(tmp_path / "a.bvh", text)
    assert notes == ("joints: no l_foot, r_foot of mixamo; these follow the others",)
    [skeleton] = known_skeletons("mixamo")
    names = [name for name, *_ in rows]
    places = {joint: names[place] for joint, place in skeleton.find(names).items()}
    assert places["spine3"] == "mixamorig:Spine1"
    assert places["spine2"] == "mixamorig:Spine"
    assert "spine1" not in places
    legs = [JOINT_INDEX[name] for name in ("l_knee", "r_ankle")]
    np.testing.assert_allclose(joints_of(found)[1:, legs], joints_of(real_poses)[:, legs], atol=1e-4)
    xsens = ["Hips", "Chest", "Chest2", "Chest3", "Chest4", "Neck", "Head"]
    xsens += [f"{side}{name}" for side in ("Left", "Right") for name in XSENS_LIMBS]
    found = known_skeletons("truebones")[0].find(xsens)
    assert [xsens[found[f"spine{number}"]] for number in (1, 2, 3)] == ["Chest", "Chest3", "Chest4"]


UNITY_LIMBS = ("Shoulder", "UpperArm", "LowerArm", "Hand", "UpperLeg", "LowerLeg", "Foot", "Toes")
UNITY = ["Hips", "Spine", "Chest", "UpperChest", "Neck", "Head"]
UNITY += [f"{side}{name}" for side in ("Left", "Right") for name in UNITY_LIMBS]


def test_one_table_serves_several_programs_names():
    [(skeleton, places), *_] = fitting(known_skeletons("auto"), UNITY)
    assert skeleton.name == "mixamo"
    assert skeleton.missing(UNITY) == []
    assert {joint: UNITY[place] for joint, place in places.items() if "spine" in joint} == {
        "spine1": "Spine", "spine2": "Chest", "spine3": "UpperChest",
    }  # fmt: skip
    assert [UNITY[places[f"l_{name}"]] for name in ("collar", "shoulder", "hip", "knee")] == [
        "LeftShoulder", "LeftUpperArm", "LeftUpperLeg", "LeftLowerLeg",
    ]  # fmt: skip


XSENS_LIMBS = ("Collar", "Shoulder", "Elbow", "Wrist", "Hip", "Knee", "Ankle", "Toe")


def test_a_frame_that_stands_in_for_the_rest_pose_may_face_anywhere(
    real_poses, make_bvh, joints_of, tmp_path
):
    turn = np.array([[np.cos(0.6), 0, np.sin(0.6)], [0, 1, 0], [-np.sin(0.6), 0, np.cos(0.6)]])
    poses = np.concatenate([np.zeros((1, 72)), real_poses])
    poses[:, :3] = rotmat_to_rotvec(torch.from_numpy(turn) @ rotvec_to_rotmat(torch.from_numpy(poses[:, :3])))
    text = make_bvh(poses, MIXAMO_DOWN)
    table = tmp_path / "mine.yaml"
    table.write_text(known_file("mixamo").read_text() + "rest_frame: 1\n")
    found, _ = read_poses(tmp_path / "a.bvh", text, skeleton=table)
    np.testing.assert_allclose(joints_of(found)[2:, :22], joints_of(poses)[1:, :22], atol=1e-4)


def test_any_skeleton_is_read_by_a_small_file(real_poses, make_bvh, joints_of, tmp_path):
    table = tmp_path / "mine.yaml"
    table.write_text(known_file("cmu_daz").read_text().replace("lShin, LeftShin", "Left Knee"))
    text = make_bvh(real_poses).replace("JOINT lShin", "JOINT Left Knee")
    found, _ = read_poses(tmp_path / "a.bvh", text, skeleton=table)
    expected, _ = read_poses(tmp_path / "b.bvh", make_bvh(real_poses))
    np.testing.assert_allclose(found, expected)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            "",
            "expected joints, and maybe others of joints, rest_axes, rest_frame, same_rest, skip_frames, got None",
        ),
        ("joints: {", "is no YAML file"),
        ("joints: {pelvis: Hips}", "joints: spine3 is missing; needed are pelvis"),
        ("joints: {tail: Hips}", "expected names for SMPL's joints, got 'tail'"),
        ("joints: {pelvis: 3}", "expected names for SMPL's joints, got 'pelvis': 3"),
        ("joint: {}", "expected joints, and maybe others of"),
        (NEEDED_JOINTS + "rest_axes: {pelvis: z y x}", r"rest_axes: expected .* got {'pelvis': 'z y x'}"),
    ],
)
def test_a_bad_table_of_joints_is_named(content, message, tmp_path):
    (tmp_path / "mine.yaml").write_text(content)
    with pytest.raises(ValueError, match=rf"data\.source\.skeleton: .*mine\.yaml.*{message}"):
        read_skeleton(tmp_path / "mine.yaml")
    with pytest.raises(FileNotFoundError, match=r"skeleton: expected auto, smpl, cmu_daz.*got 'none'"):
        known_skeletons("none")
