import json
import random

import numpy as np
import pytest

from ljn.body.skeleton import JOINT_INDEX, JOINT_NAMES
from ljn.pipeline.filling import fill_missing
from ljn.pipeline.keypoint_orders import ORDERS, middles_of, orders_of
from ljn.pipeline.keypoints import MIN_KNOWN, body_keypoints, smpl_keypoints
from ljn.pipeline.report import Report


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
    found = smpl_keypoints({"order": name, "keypoints": in_order(truth, name)})
    is_taken = np.array([joint in ORDERS[name].joints for joint in JOINT_NAMES])
    np.testing.assert_allclose(found.positions[is_taken], truth[is_taken], rtol=1e-5)
    np.testing.assert_array_equal(found.confidences, is_taken)
    height = np.ptp(truth[:, 1])
    assert np.linalg.norm(found.positions - truth, axis=-1).max() < 0.12 * height


@pytest.mark.parametrize("name", ORDERS)
def test_orders_are_told_by_their_length_and_their_names(name, truth):
    given = in_order(truth, name)
    expected = smpl_keypoints({"order": name, "keypoints": given}).positions
    forms = [{keypoint: list(row) for keypoint, row in zip(ORDERS[name].names, given)}]
    forms.append({f"K4ABT_JOINT_{keypoint}".lower(): row for keypoint, row in forms[0].items()})
    if orders_of(len(given))[0] == name:
        forms += [given, given.tolist(), given.flatten()]
    for form in forms:
        np.testing.assert_array_equal(smpl_keypoints(form).positions, expected)
    assert len(set(ORDERS[name].names)) == len(ORDERS[name].names)


@pytest.mark.parametrize("name", ORDERS)
def test_every_keypoint_of_an_order_stands_for_joints_of_its_side(name):
    order = ORDERS[name]
    assert set(order.joints) <= set(JOINT_NAMES)
    middles = middles_of(name)
    np.testing.assert_allclose(middles.sum(1), 1)
    for keypoint, weights in zip(order.names, middles):
        sides = {JOINT_NAMES[joint][0] for joint in np.flatnonzero(weights) if JOINT_NAMES[joint][1] == "_"}
        plain = keypoint.lower()
        is_left = "left" in plain or plain.startswith("l_") or keypoint[:2] in {f"L{x}" for x in "SEWHKAB"}
        is_right = "right" in plain or plain.startswith("r_") or keypoint[:2] in {f"R{x}" for x in "SEWHKAB"}
        if sides and len(sides) == 1:
            assert sides == ({"l"} if is_left else {"r"} if is_right else sides)


def test_what_openpose_writes_is_read(truth):
    given = np.concatenate([in_order(truth, "body25"), np.full((25, 1), 0.7)], -1)
    file = {"version": 1.3, "people": [{"person_id": [-1], "pose_keypoints_2d": given.flatten().tolist()}]}
    found = smpl_keypoints(file)
    np.testing.assert_array_equal(found.positions, smpl_keypoints(given).positions)
    assert found.confidences[JOINT_INDEX["l_foot"]] == np.float32(0.7)
    with pytest.raises(ValueError, match="expected one person, got 2; keep the one"):
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


def people(keypoints):
    """What OpenPose writes of one person."""
    return {"people": [{"pose_keypoints_2d": keypoints}]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: {"order": "mpii16", "keypoints": t}, "expected an order of smpl24 .SMPL's 24.*, got 'mpii16'"),
        (lambda t: {"order": "coco17", "keypoints": t}, "got 24 with the order coco17"),
        (lambda t: {"pelvis": t[0], "left hip bone": t[1]}, "to no one order.*not in smpl24: left hip bone. Its"),
        (lambda t: {"order": "coco17", "keypoints": {"pelvis": t[0]}}, "belong to no one order"),
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
        (lambda t: {"people": []}, "expected one person, got 0: the detector found no one"),
        (lambda t: {"people": [{}]}, "under 'pose_keypoints_2d' .*got none; have OpenPose write"),
        (lambda t: people([1.0] * 74), "under 'pose_keypoints_2d' .*got others .*BODY_25"),
        (lambda t: people([{}] * 75), "under 'pose_keypoints_2d' .*got others"),
        (lambda t: people([10**400] * 75), "under 'pose_keypoints_2d' .*got others"),
        (lambda t: t[:3], "expected 24 .smpl24., 17 .coco17.*of them, got 3; give those that are missing as null"),
        (lambda t: t[:16], "of them, got 16 .MPII's.*all by the names"),
        (lambda t: t[:13].flatten(), "got a flat list of 26"),
        (lambda t: [t[0], {"keypoints": t}], "a mixture of both"),
        (lambda t: {"keypoints": t, "keypoint_scores": [1] * 23}, "a score for each of the 24 keypoints, got 23"),
        (lambda t: {"keypoints": t, "keypoint_scores": 1}, "expected a list of scores, got 1"),
        (lambda t: {"keypoints": {"x": [1], "y": [1, 2]}}, "lists of one length under 'x' and 'y'"),
        (lambda t: {"instance_info": [{"instances": []}] * 2}, "expected one frame under 'instance_info'.*got 2"),
        (lambda t: {"annotations": {}}, "expected a list under 'annotations', got {}"),
        (lambda t: [{"image_id": i, "keypoints": t} for i in (1, 2)], "the persons of one image, got 2 of 2 images"),
        (lambda t: [[t]] * 2, "expected one person, got 2"),
        (lambda t: [[u, v, 900.0] for u, v in t], "third numbers, from 0 to 1, in percent.*got 900"),
        (lambda t: t * 0, f"0 joints are known, expected at least {MIN_KNOWN}"),
    ],
)  # fmt: skip
def test_other_input_is_refused(change, message, truth):
    with pytest.raises(ValueError, match=message):
        smpl_keypoints(change(truth))


FORMS = {
    "entries": lambda t: t.tolist(),
    "arrays": lambda t: t,
    "one after another": lambda t: t.flatten().tolist(),
    "coco annotation": lambda t: {
        "keypoints": t.flatten().tolist(),
        "num_keypoints": 17,
        "bbox": [0, 0, 1, 1],
    },
    "coco annotations file": lambda t: {
        "images": [{"id": 7}],
        "annotations": [
            {"image_id": 7, "category_id": 1, "iscrowd": 0, "keypoints": t.flatten().tolist()},
            {"image_id": 7, "category_id": 1, "num_keypoints": 0, "keypoints": [0] * 51},
        ],
    },
    "coco results": lambda t: [
        {"image_id": 1, "category_id": 1, "keypoints": t.flatten().tolist(), "score": 0.9}
    ],
    "mmpose instance": lambda t: {"keypoints": t[:, :2].tolist(), "keypoint_scores": t[:, 2].tolist()},
    "mmpose results": lambda t: {
        "meta_info": {"dataset_name": "coco"},
        "instance_info": [
            {
                "frame_id": 0,
                "instances": [{"keypoints": t[:, :2].tolist(), "keypoint_scores": t[:, 2].tolist()}],
            }
        ],
    },
    "mmpose predictions": lambda t: {
        "predictions": [[{"keypoints": t[None, :, :2], "keypoint_scores": t[None, :, 2]}]]
    },
    "ultralytics' tensor": lambda t: t[None],
    "ultralytics' json": lambda t: [
        {
            "name": "person",
            "confidence": 0.9,
            "keypoints": {"x": t[:, 0].tolist(), "y": t[:, 1].tolist(), "visible": t[:, 2].tolist()},
        }
    ],
    "places by name": lambda t: [{"x": u, "y": v, "confidence": c} for u, v, c in t.tolist()],
}


@pytest.fixture
def coco(truth):
    """COCO's 17 of a sample `(17, 3)`, all sure."""
    return np.concatenate([middles_of("coco17") @ truth, np.full((17, 1), 0.9)], 1)


@pytest.mark.parametrize("name", FORMS)
def test_the_forms_in_which_detectors_give_keypoints_are_the_same(name, coco, body):
    coco[[9, 16]] = [[60, 60, 0.05], [400, 20, 0.1]]
    form = FORMS[name](coco)
    expected = smpl_keypoints(coco)
    assert expected.confidences[JOINT_INDEX["l_wrist"]] == 0
    for found in (smpl_keypoints(form), body_keypoints(form, *body)):
        np.testing.assert_array_equal(found.positions, expected.positions)
        np.testing.assert_array_equal(found.confidences, expected.confidences)


def test_media_pipe_s_shares_of_the_image_are_read(truth, body):
    depth, camera = body
    pixels = middles_of("mediapipe33") @ truth
    shares = pixels / [camera.width, camera.height]
    expected = smpl_keypoints(pixels)
    landmarks = [{"x": x, "y": y, "z": -0.3, "visibility": 0.9} for x, y in shares]
    of_four = np.concatenate([shares, np.full((33, 1), -0.3), np.full((33, 1), 0.9)], 1)
    for form in (shares, of_four, of_four[:, :3], {"pose_landmarks": [landmarks]}, landmarks):
        report = Report()
        found = body_keypoints(form, depth, camera, report=report)
        np.testing.assert_allclose(found.positions, expected.positions, atol=1e-3)
        assert report.facts["keypoint_units"] == "shares of the image's size"
    assert found.confidences.max() == np.float32(0.9)


def test_openpose_s_model_with_18_is_read(truth):
    given = np.concatenate([middles_of("coco18") @ truth, np.ones((18, 1))], 1)
    found = smpl_keypoints(people(given.flatten().tolist()))
    expected = smpl_keypoints({"order": "coco18", "keypoints": given})
    np.testing.assert_array_equal(found.positions, expected.positions)


@pytest.mark.parametrize("missing", [[-1, -1, 0.9], [-3, -0.5], [0, 0, 2], [np.nan, np.nan, 1], None])
def test_negative_pairs_are_missing_too(missing, coco):
    given = [*coco.tolist()]
    given[9] = missing
    found = smpl_keypoints(given)
    assert found.confidences[JOINT_INDEX["l_wrist"]] == 0
    assert np.count_nonzero(found.confidences) == 12


@pytest.mark.parametrize(
    ("confidences", "expected", "fact"),
    [
        ([0.95, 0.05], [0.95, 0], None),
        ([95, 5], [0.95, 0], "percent"),
        ([2, 0], [1, 0], "visibility: 0, 1 or 2"),
        ([2, 1], [1, 1], "visibility: 0, 1 or 2"),
        ([1.2, 0.1], [1, 0], "unclear: taken as they are, up to 1"),
    ],
)
def test_confidences_are_told_by_their_values(confidences, expected, fact, coco, body):
    coco[:, 2] = confidences[0]
    coco[9, 2] = confidences[1]
    report = Report(is_strict=True)
    found = body_keypoints(coco, *body, report=report)
    joints = [JOINT_INDEX["r_wrist"], JOINT_INDEX["l_wrist"]]
    np.testing.assert_allclose(found.confidences[joints], expected)
    assert report.facts.get("keypoint_confidences") == fact


def test_confidences_of_no_known_kind_are_doubted(coco, body):
    coco[:, 2] = 7.5
    report = Report()
    assert body_keypoints(coco, *body, report=report).confidences.max() == 1
    (warning,) = report.warnings
    assert "confidences of up to 7.5 are neither from 0 to 1" in warning
    with pytest.raises(ValueError, match=r"up to 7\.5 .*strict"):
        body_keypoints(coco, *body, report=Report(is_strict=True))


@pytest.fixture
def body(samples, kinect):
    """What keypoints are held against: depth and camera."""
    return samples[0][1], kinect


def test_right_keypoints_are_taken_and_reported(coco, body):
    report = Report(is_strict=True)
    body_keypoints(coco, *body, report=report)
    assert report.facts["keypoint_order"] == "coco17"
    assert (report.facts["keypoints_known"], report.facts["keypoints_filled"]) == (13, 11)
    assert report.facts["keypoints_mistrusted"] == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p[:, ::-1], "with u and v swapped they would"),
        (lambda p: p * [1, -1] + [0, 511], "with v counted from below .511 - v. they would"),
        (lambda p: 1.25 * p, "multiplied by 0.8 .* they would"),
        (lambda p: 0.8 * p, "multiplied by 1.25 .* they would"),
        (lambda p: p + np.array([80, 0]), r"shifted by \(-\d+, -?\d+\) pixels .* they would"),
        (lambda p: 0.4 * p, r"multiplied by 2.\d+ and .* they would"),
        (lambda p: 0 * p + p.mean(0), "they all lie at one place; no other reading was found that does"),
        (lambda p: p[::-1], "no other reading was found that does"),
        (lambda p: p / [424, 512], "expected pixels, but all lie between 0 and 2"),
    ],
)  # fmt: skip
def test_keypoints_that_do_not_fit_the_body_are_refused_and_what_would_is_named(change, message, truth, body):
    with pytest.raises(ValueError, match=f"keypoints: .*{message}"):
        body_keypoints(change(truth), *body)


@pytest.mark.parametrize(
    ("right", "wrong"), [("kinect25", "body25"), ("body25", "kinect25"), ("h36m17", "coco17")]
)
def test_the_order_of_a_length_is_the_one_that_fits(right, wrong, truth, body):
    given = middles_of(right) @ truth
    report = Report(is_strict=True)
    found = body_keypoints(given, *body, report=report)
    assert report.facts["keypoint_order"] == right
    np.testing.assert_array_equal(
        found.positions, smpl_keypoints({"order": right, "keypoints": given}).positions
    )
    with pytest.raises(
        ValueError, match=f"in the order {wrong} .* do not fit the body; in the order {right}"
    ):
        body_keypoints({"order": wrong, "keypoints": given}, *body)


def test_orders_that_fit_equally_are_asked_for(truth, body):
    given = np.full((17, 2), np.nan)
    given[14] = truth[JOINT_INDEX["r_elbow"]]
    with pytest.raises(ValueError, match=r"17 of them may be .*; say which: {.order.: "):
        body_keypoints(given, *body, min_known=1)
    assert body_keypoints({"order": "coco17", "keypoints": given}, *body, min_known=1).confidences.sum() == 1


def test_a_single_wild_keypoint_is_treated_as_missing(truth, body):
    given = truth.copy()
    given[JOINT_INDEX["r_wrist"]] = [20, 30]
    report = Report()
    found = body_keypoints(given, *body, report=report)
    assert found.confidences[JOINT_INDEX["r_wrist"]] == 0
    assert np.count_nonzero(found.confidences) == 23
    assert np.linalg.norm(found.positions[JOINT_INDEX["r_wrist"]] - truth[JOINT_INDEX["r_wrist"]]) < 60
    assert report.facts["keypoints_mistrusted"] == ["r_wrist"]
    assert "r_wrist lie far from where the others expect them" in report.warnings[0]


def test_of_a_body_that_is_cut_off_keypoints_are_doubted_at_the_most(truth, body):
    depth, camera = body
    v = np.flatnonzero(depth.any(1))
    for share, is_doubted in ((0.3, False), (0.55, True)):
        report, cut = Report(), depth.copy()
        cut[int(v[-1] - share * (v[-1] - v[0])) :] = 0
        found = body_keypoints(truth, cut, camera, report=report)
        assert np.count_nonzero(found.confidences) == 24
        assert bool(report.warnings) == is_doubted


def test_of_several_persons_the_one_who_fits_is_taken(coco, body):
    beside = coco + np.array([150, 0, 0])
    crowd = [{"keypoints": one.tolist()} for one in (beside, coco, beside)]
    report = Report()
    found = body_keypoints(crowd, *body, report=report)
    np.testing.assert_array_equal(found.positions, smpl_keypoints(coco).positions)
    assert (report.facts["keypoint_persons"], report.facts["keypoint_person"]) == (3, 1)
    for wrong, number in ((crowd[::2], 0), ([crowd[1]] * 2, 2)):
        with pytest.raises(
            ValueError, match=f"expected one person, got 2, of whom {number} fit the body.*keep"
        ):
            body_keypoints(wrong, *body)


def test_of_an_unlikely_confidence_column_it_is_said(truth, body):
    given = np.concatenate([truth, np.full((24, 1), 0.9)], 1)
    given[:10] += [150, 0, 0]
    given[10:] = np.concatenate([truth[10:], np.full((14, 1), 0.1)], 1)
    with pytest.raises(ValueError, match=r"keypoints: .*do not fit the body"):
        body_keypoints(given, *body)


def mutated(value, rng):
    """A JSON value with one thing changed somewhere in it."""
    if isinstance(value, dict) and value and rng.random() < 0.85:
        key = rng.choice(list(value))
        changed = dict(value)
        if rng.random() < 0.15:
            changed[rng.choice(["order", "keypoints", "people", "x", "keypoint_scores"])] = changed.pop(key)
        else:
            changed[key] = mutated(value[key], rng)
        return changed
    if isinstance(value, list) and value and rng.random() < 0.85:
        place = rng.randrange(len(value))
        kind = rng.random()
        if kind < 0.1:
            return value[:place]
        if kind < 0.2:
            return value[:place] + value[place : place + 1] * 2 + value[place:]
        return [*value[:place], mutated(value[place], rng), *value[place + 1 :]]
    junk = [
        None,
        "1",
        "",
        True,
        -1,
        0,
        1e308,
        -1e308,
        10**400,
        float("nan"),
        float("inf"),
        [],
        {},
        [[]],
        [value],
        {"x": 1},
    ]
    return rng.choice([*junk, [value, value], {"keypoints": value}, 3, 1.5, 150.0, 2])


def outcome(form, body, rng):
    """`result`, or the message of the error."""
    try:
        found = body_keypoints(form, *body, min_known=rng.choice([1, MIN_KNOWN]), report=Report())
    except ValueError as error:
        return str(error)
    return "result" if np.isfinite(found.positions).all() else "positions that are not finite"


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_damaged_keypoints_give_an_error_that_says_so_or_a_result(truth, coco, body):
    rng = random.Random(0)
    forms = [
        json.loads(json.dumps(form(coco), default=lambda array: array.tolist())) for form in FORMS.values()
    ]
    forms += [middles_of(name).dot(truth).tolist() for name in ORDERS]
    forms += [
        {"order": "h36m17", "keypoints": forms[-1]},
        dict(zip(ORDERS["kinect25"].names, coco.tolist() * 2)),
    ]
    forms += [people(np.ones(75).tolist()), people(np.ones(54).tolist()), {"people": []}]
    outcomes = []
    for _ in range(6000):
        form = rng.choice(forms)
        for _ in range(rng.choice([1, 1, 2, 5, 30])):
            form = mutated(form, rng)
        outcomes.append(outcome(form, body, rng))
    errors = [each for each in outcomes if each != "result"]
    assert 500 < len(errors) < 5500
    assert {each[:10] for each in errors} == {"keypoints:"}
