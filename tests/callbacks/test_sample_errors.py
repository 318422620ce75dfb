import numpy as np

from callbacks.sample_errors import group_lines


def test_each_kind_has_its_number_and_its_means_the_worst_first():
    values = {
        "sample_id": np.array([0, 1, 2, 4]),
        "mpjpe": np.array([10.0, 20, 60, 30]),
        "pckh": np.array([4.0, 3, 2, 1]),
    }
    groups = {"pose": np.array(["walk", "lie", "lie", "sit", "walk"])}
    assert group_lines(values, groups, ["mpjpe", "pckh"], "mpjpe") == [
        ["by", "kind", "samples", "mpjpe", "pckh"],
        ["pose", "lie", 2, 40.0, 2.5],
        ["pose", "walk", 2, 20.0, 2.5],
    ]
    assert group_lines(values, {}, ["mpjpe"], "mpjpe") == []
