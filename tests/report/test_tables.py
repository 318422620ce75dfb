import pytest

from ljn.report.tables import NUM_DATA, TABLES

JOINTS, MESHES = ("mpjpe_eq38", "pckh"), ("apve", "mpjpe_eq38")
NOISE_PX, NOISE_MM = (
    ("initial_max_distance_" + unit, "initial_mean_distance_" + unit) for unit in ("px", "mm")
)


def printed(table, *metrics):
    return [[row.thesis.get(metric) for metric in metrics] for row in TABLES[table].rows]


@pytest.mark.parametrize(
    ("table", "first", "second", "values"),
    [
        ("table_3_2", *JOINTS, [(32.1, 85.6), (25.0, 90.2), (24.2, 90.8), (59.4, 51.9), (81.3, 33.6)]),
        ("table_3_3", *JOINTS, [(14.3, 97.2), (18.6, 94.7), (24.2, 90.8), (31.4, 85.6)]),
        ("table_3_3", *NOISE_PX, [(0, 0), (26.6, 6.3), (53.2, 12.5), (83.7, 19.0)]),
        ("table_3_4", *JOINTS, [(25.8, 90.1), (24.2, 90.8)]),
        ("table_3_5", *MESHES, [(43.1, 42.9), (42.2, 40.6), (35.6, 36.8), (34.5, 33.0)]),
        ("table_3_6", *MESHES, [(31.6, 30.5), (32.9, 31.5), (34.5, 33.0), (37.6, 36.0), (38.8, 36.8)]),
        ("table_3_6", *NOISE_MM, [(0, 0), (52.9, 12.5), (105.6, 25.1), (170.0, 37.6), (None, None)]),
        ("table_3_7", *MESHES, [(36.0, 34.3), (34.5, 33.0)]),
    ],
)
def test_the_thesis_s_numbers_are_those_of_its_tables(table, first, second, values):
    assert printed(table, first, second) == [list(pair) for pair in values]


def test_literature_of_table_3_5():
    rows = [
        (row.label, row.values["apve"], row.values["mpjpe_eq38"]) for row in TABLES["table_3_5"].literature
    ]
    assert rows == [
        ("HMR", 54.3, None),
        ("Wei et al.", 58.6, None),
        ("HMR", 56.8, 87.9),
        ("SPIN", 41.1, None),
        ("HKMR", None, 71.0),
    ]


def test_the_counts_of_the_data_are_those_of_table_3_1():
    assert {split: tuple(counts.values()) for split, counts in NUM_DATA.items()} == {
        "train": (115, 1964, 55001, 5342090, 60000),
        "val": (5000,),
        "test": (30, 703, 12528, 1194662, 15000),
    }


def test_only_the_row_that_a_cross_table_shares_has_the_thesis_s_numbers():
    known = {
        table: [row.experiment for row in TABLES[table].rows if row.thesis]
        for table in ("table_3_3_cross", "table_3_6_cross", "demo")
    }
    assert known == {
        "table_3_3_cross": ["detector/proposed"],
        "table_3_6_cross": ["mesh/proposed", "mesh/chain"],
        "demo": [],
    }


@pytest.mark.parametrize("table", TABLES.values(), ids=lambda table: table.name)
def test_thesis_s_values_are_in_columns_that_exist(table):
    metrics = {column.metric for column in table.columns}
    for values in [row.thesis for row in table.rows] + [entry.values for entry in table.literature]:
        assert set(values) <= metrics
