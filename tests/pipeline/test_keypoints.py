import numpy as np
import pytest

from ljn.body.skeleton import JOINT_INDEX, JOINT_NAMES
from ljn.pipeline.keypoints import MIN_KNOWN, ORDERS, fill_missing, smpl_keypoints


@pytest.fixture
def truth(samples):
    """The 24 joints of a sample, projected `(24, 2)`, pixels."""
    return samples[0][0]["true_keypoints"][0].numpy().astype(np.float64)


def in_order(truth, name):
    """What a perfect detector of an order would give, `(K, 2)`; (0, 0) for what no SMPL joint is taken from."""
    order = ORDERS[name]
    given = np.zeros((len(order.names), 2))
    for joint, keypoints in order.joints.items():
        for keypoint in keypoints:
            given[order.names.index(keypoint)] = truth[JOINT_INDEX[joint]]
    return given


@pytest.mark.parametrize("name", ORDERS)
def test_every_order_gives_its_joints_exactly_and_the_others_nearly(name, truth):
    found = smpl_keypoints(in_order(truth, name))
    is_taken = np.array([joint in ORDERS[name].joints for joint in JOINT_NAMES])
    np.testing.assert_allclose(found.positions[is_taken], truth[is_taken], rtol=1e-5)
    np.testing.assert_array_equal(found.confidences, is_taken)
    height = np.ptp(truth[:, 1])
    assert np.linalg.norm(found.positions - truth, axis=-1).max() < 0.12 * height


@pytest.mark.parametrize("name", ORDERS)
def test_orders_are_told_apart_and_whole(name, truth):
    given = in_order(truth, name)
    expected = smpl_keypoints(given).positions
    as_names = {keypoint: list(row) for keypoint, row in zip(ORDERS[name].names, given)}
    for form in (given.tolist(), {"order": name, "keypoints": given}, as_names):
        np.testing.assert_array_equal(smpl_keypoints(form).positions, expected)
    assert len(set(ORDERS[name].names)) == len(ORDERS[name].names)
    for joint, keypoints in ORDERS[name].joints.items():
        assert joint in JOINT_NAMES
        assert set(keypoints) <= set(ORDERS[name].names)
        sides = {keypoint[0].lower() for keypoint in keypoints}
        assert joint == "head" or joint[0] in sides or not joint.startswith(("l_", "r_"))


def test_what_openpose_writes_is_read(truth):
    given = np.concatenate([in_order(truth, "body25"), np.full((25, 1), 0.7)], -1)
    file = {"version": 1.3, "people": [{"person_id": [-1], "pose_keypoints_2d": given.flatten().tolist()}]}
    found = smpl_keypoints(file)
    np.testing.assert_array_equal(found.positions, smpl_keypoints(given).positions)
    assert found.confidences[JOINT_INDEX["l_foot"]] == np.float32(0.7)
    with pytest.raises(ValueError, match="expected one person in OpenPose's file, got 2"):
        smpl_keypoints({"people": file["people"] * 2})


def test_null_nan_zero_and_doubtful_keypoints_count_as_missing(truth):
    expected = truth.copy()
    expected[4] = np.nan
    expected = fill_missing(expected).astype(np.float32)
    with_confidence = np.concatenate([truth, np.ones((24, 1))], -1)
    for missing in (None, [None, None], [np.nan, 3.0], [0, 0], [*truth[4], 0.1], [*truth[4], np.nan]):
        given = with_confidence.tolist()
        given[4] = missing
        found = smpl_keypoints(given)
        np.testing.assert_array_equal(found.positions, expected)
        assert found.confidences[4] == 0


def test_filling_moves_turns_and_scales_with_the_body(truth):
    is_missing = np.isin(JOINT_NAMES, ["l_hand", "spine2", "r_knee", "head"])
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    given = np.where(is_missing[:, None], np.nan, truth)
    filled = fill_missing(given)
    np.testing.assert_array_equal(filled[~is_missing], truth[~is_missing])
    np.testing.assert_allclose(fill_missing(3 * given @ turn.T + [5, -7]), 3 * filled @ turn.T + [5, -7])


@pytest.mark.parametrize("joint", ["pelvis", "spine2", "l_collar", "l_wrist", "r_foot", "head"])
def test_a_single_missing_joint_is_filled_in_nearby(joint, truth):
    given = truth.copy()
    given[JOINT_INDEX[joint]] = np.nan
    error = np.linalg.norm(fill_missing(given)[JOINT_INDEX[joint]] - truth[JOINT_INDEX[joint]])
    assert error < 0.1 * np.ptp(truth[:, 1])


def people(keypoints):
    """What OpenPose writes of one person."""
    return {"people": [{"pose_keypoints_2d": keypoints}]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: {"order": "coco18", "keypoints": t}, "expected an order of smpl24, coco17, body25, got 'coco18'"),
        (lambda t: {"order": "coco17", "keypoints": t}, "got 24 with the order coco17"),
        (lambda t: {"pelvis": t[0], "hip_left": t[1]}, "belong to no one order.*not in smpl24: hip_left. Its names"),
        (lambda t: {}, "belong to no one order"),
        (lambda t: [[1, 2, 3, 4]] * 24, r"expected \[u, v\] or \[u, v, confidence\].*got 4 numbers"),
        (lambda t: ["here"] * 24, r"expected \[u, v\] or \[u, v, confidence\]"),
        (lambda t: ["12"] * 24, r"expected \[u, v\] or \[u, v, confidence\].*got the text '12'"),
        (lambda t: [[10**400, 1]] * 24, r"expected \[u, v\] or \[u, v, confidence\]"),
        (lambda t: {"order": ["smpl24"], "keypoints": t}, r"expected an order of .*got \['smpl24'\]"),
        (lambda t: {"order": {}, "keypoints": t}, "expected an order of .*got {}"),
        (lambda t: {"keypoints": None}, r"expected \[u, v\] or \[u, v, confidence\]"),
        (lambda t: {"people": None}, "expected one person in OpenPose's file, got None; keep the one"),
        (lambda t: {"people": 3}, "expected one person in OpenPose's file, got 3"),
        (lambda t: {"people": []}, "expected one person in OpenPose's file, got 0"),
        (lambda t: {"people": [{}]}, "under 'pose_keypoints_2d' .*got none; have OpenPose write"),
        (lambda t: people([1.0] * 74), "under 'pose_keypoints_2d' .*got others .*BODY_25"),
        (lambda t: people([{}] * 75), "under 'pose_keypoints_2d' .*got others"),
        (lambda t: people([10**400] * 75), "under 'pose_keypoints_2d' .*got others"),
        (lambda t: t[:3], "of them, got 3; give those that are missing as null"),
        (lambda t: t * 0, f"0 joints are known, expected at least {MIN_KNOWN}"),
    ],
)  # fmt: skip
def test_other_input_is_refused(change, message, truth):
    with pytest.raises(ValueError, match=message):
        smpl_keypoints(change(truth))
