"""The thesis's tables: their rows and columns, and the numbers printed in them.

Distances and errors are in millimetres (of 2D joints in pixels), PCKh in percent.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

Values = Mapping[str, float | None]


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    metric: str  # key in `metrics.json`, without `test/`
    label: str
    unit: str
    # which values are better; None for what describes the input, where none is
    goal: Literal["min", "max"] | None = None

    @property
    def heading(self) -> str:
        """Label and unit, if it has one."""
        return f"{self.label}, {self.unit}" if self.unit else self.label


@dataclass(frozen=True)
class Axis:
    """What a table varies, for its curves."""

    label: str  # with its unit
    key: str  # where a run's configuration has the value, such as `data.observation.num_points`


@dataclass(frozen=True)
class Row:
    """A row of a table."""

    label: str
    experiment: str | None  # whose runs it shows; None for any finished run (what all of them share)
    thesis: Values = field(default_factory=dict)  # by column
    x: float | None = None  # the thesis's place on the table's axis
    # columns where another metric of the run is shown; None: the row has no such value
    metrics: Mapping[str, str | None] = field(default_factory=dict)
    overrides: tuple[str, ...] | None = None  # if given, only runs with exactly these


@dataclass(frozen=True)
class Literature:
    """A row of other people's results."""

    label: str  # the method
    values: Values  # by column
    source: str  # where the numbers come from


@dataclass(frozen=True)
class Table:
    """A table."""

    name: str  # its key, such as `table_3_2`
    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]  # in the thesis's order
    literature: tuple[Literature, ...] = ()
    axis: Axis | None = None  # what is varied, where that is a number
    notes: tuple[str, ...] = ()


_APVE = Column("apve", "APVE", "mm", "min")
_MPJPE = Column("mpjpe", "MPJPE", "mm", "min")
_PCKH = Column("pckh", "PCKh", "%", "max")
_MPJPE_EQ38 = Column("mpjpe_eq38", "MPJPE", "mm", "min")
_MAX_PX = Column("initial_max_distance_px", "max. distance", "px")
_MEAN_PX = Column("initial_mean_distance_px", "mean distance", "px")
_MAX_MM = Column("initial_max_distance_mm", "max. distance", "mm")
_MEAN_MM = Column("initial_mean_distance_mm", "mean distance", "mm")

_EQ38_NOTE = (
    "MPJPE is Eq. 3.8 to the letter, as in the thesis: the sum over all joints but the root, divided by the number of "
    "all joints (test/mpjpe_eq38). The plain mean over all joints is test/mpjpe in metrics.json."
)
_DISTANCE_NOTE = "Distances are those of the initial joints from the true ones."
ROOT_ALIGNED_NOTE = (
    "† Joints that only mean something beside the root, such as the simple baseline's: MPJPE and PCKh after the roots "
    "were moved to the same place (test/mpjpe_root_aligned, test/pckh_root_aligned)."
)
ROOT_ALIGNED = dict.fromkeys(("mpjpe", "mpjpe_eq38"), "mpjpe_root_aligned") | {"pckh": "pckh_root_aligned"}
"""The metrics of rows of detectors whose joints are only defined relative to the root."""
_NO_PCKH = {"mpjpe": "initial_mpjpe", "pckh": None}

_NOISE_2D = Axis("σ of the 2D joints' noise, px", "data.synthesis.keypoint_noise_px")
_NOISE_3D = Axis("σ of the 3D joints' noise, m", "data.synthesis.joint_noise_m")
_POINTS = Axis("sampled points", "data.observation.num_points")

_DETECTOR = (_MPJPE_EQ38, _PCKH)
_MESH = (_APVE, _MPJPE_EQ38)
_KEYPOINTS = (
    Column("crop_error_px", "error", "px", "min"),
    _PCKH,
    Column("oks_ap", "OKS-AP", "%", "max"),
    Column("exchanged", "exchanged", "%", "min"),
)
_DETECTOR_NOISE = (_MAX_PX, _MEAN_PX, *_DETECTOR)
_MESH_NOISE = (_MAX_MM, _MEAN_MM, *_MESH)


def _values(columns: Sequence[Column], *values: float | None) -> dict[str, float | None]:
    assert len(columns) == len(values)
    return {column.metric: value for column, value in zip(columns, values)}


def _simple_baseline(label: str, experiment: str, mpjpe: float, pckh: float) -> Row:
    return Row(label, experiment, _values(_DETECTOR, mpjpe, pckh), metrics=ROOT_ALIGNED)


_DETECTOR_PROPOSED = _values(_DETECTOR_NOISE, 53.2, 12.5, 24.2, 90.8)
_MESH_PROPOSED = _values(_MESH_NOISE, 105.6, 25.1, 34.5, 33.0)
_MESH_CHAIN = _values(_MESH_NOISE, None, None, 38.8, 36.8)
_WANG = "as reported by Wang et al."
_HUMAN36M = "RGB images of Human3.6M"

_ALL = (
    Table(
        "table_3_2",
        "Table 3.2: designs of the joint detector",
        _DETECTOR,
        (
            Row("basic", "detector/basic", _values(_DETECTOR, 32.1, 85.6)),
            Row("proposed without EDM", "detector/no_edm", _values(_DETECTOR, 25.0, 90.2)),
            Row("proposed", "detector/proposed", _values(_DETECTOR, 24.2, 90.8)),
            _simple_baseline("simple baseline, σ = 0", "detector/simple_baseline_0px", 59.4, 51.9),
            _simple_baseline("simple baseline, σ = 10 px", "detector/simple_baseline", 81.3, 33.6),
        ),
        notes=(
            "All but the fourth row have 2D joints with noise of σ = 10 px.",
            _EQ38_NOTE,
            ROOT_ALIGNED_NOTE,
        ),
    ),
    Table(
        "table_3_3",
        "Table 3.3: the joint detector, trained at each noise of the 2D joints",
        _DETECTOR_NOISE,
        (
            Row("σ = 0", "detector/sigma_0px", _values(_DETECTOR_NOISE, 0, 0, 14.3, 97.2), 0),
            Row("σ = 5 px", "detector/sigma_5px", _values(_DETECTOR_NOISE, 26.6, 6.3, 18.6, 94.7), 5),
            Row("σ = 10 px", "detector/proposed", _DETECTOR_PROPOSED, 10),
            Row("σ = 15 px", "detector/sigma_15px", _values(_DETECTOR_NOISE, 83.7, 19.0, 31.4, 85.6), 15),
        ),
        axis=_NOISE_2D,
        notes=(_DISTANCE_NOTE, _EQ38_NOTE),
    ),
    Table(
        "table_3_3_cross",
        "Beside Table 3.3: the joint detector trained at 10 px, evaluated at each noise",
        _DETECTOR_NOISE,
        (
            Row("σ = 0", "detector/cross_0px", x=0),
            Row("σ = 5 px", "detector/cross_5px", x=5),
            Row("σ = 10 px", "detector/proposed", _DETECTOR_PROPOSED, 10),
            Row("σ = 15 px", "detector/cross_15px", x=15),
        ),
        axis=_NOISE_2D,
        notes=(_DISTANCE_NOTE, _EQ38_NOTE),
    ),
    Table(
        "table_3_4",
        "Table 3.4: the joint detector, by the number of sampled points (thesis: 2,048 and 4,096)",
        _DETECTOR,
        (
            Row("half the points", "detector/half_points", _values(_DETECTOR, 25.8, 90.1), 2048),
            Row("all points", "detector/proposed", _values(_DETECTOR, 24.2, 90.8), 4096),
        ),
        axis=_POINTS,
        notes=(_EQ38_NOTE,),
    ),
    Table(
        "table_3_5",
        "Table 3.5: designs of the mesh regressor",
        _MESH,
        (
            Row("basic", "mesh/basic", _values(_MESH, 43.1, 42.9)),
            Row("proposed, single", "mesh/single", _values(_MESH, 42.2, 40.6)),
            Row("proposed, pointnet", "mesh/pointnet", _values(_MESH, 35.6, 36.8)),
            Row("proposed", "mesh/proposed", _values(_MESH, 34.5, 33.0)),
        ),
        literature=(
            Literature("HMR", _values(_MESH, 54.3, None), _WANG),
            Literature("Wei et al.", _values(_MESH, 58.6, None), _WANG),
            Literature("HMR", _values(_MESH, 56.8, 87.9), _HUMAN36M),
            Literature("SPIN", _values(_MESH, 41.1, None), _HUMAN36M),
            Literature("HKMR", _values(_MESH, None, 71.0), _HUMAN36M),
        ),
        notes=(
            _EQ38_NOTE,
            "The literature's rows are of other data; those of Human3.6M are from the methods' own papers, MPJPE by "
            "its protocol 2.",
        ),
    ),
    Table(
        "table_3_6",
        "Table 3.6: the mesh regressor, trained at each noise of the 3D joints",
        _MESH_NOISE,
        (
            Row("σ = 0", "mesh/sigma_0mm", _values(_MESH_NOISE, 0, 0, 31.6, 30.5), 0),
            Row("σ = 0.01 m", "mesh/sigma_10mm", _values(_MESH_NOISE, 52.9, 12.5, 32.9, 31.5), 0.01),
            Row("σ = 0.02 m", "mesh/proposed", _MESH_PROPOSED, 0.02),
            Row("σ = 0.03 m", "mesh/sigma_30mm", _values(_MESH_NOISE, 170.0, 37.6, 37.6, 36.0), 0.03),
            Row("end-to-end", "mesh/chain", _MESH_CHAIN),
        ),
        axis=_NOISE_3D,
        notes=(_DISTANCE_NOTE, _EQ38_NOTE),
    ),
    Table(
        "table_3_6_cross",
        "Beside Table 3.6: the mesh regressor trained at 0.02 m, evaluated at each noise",
        _MESH_NOISE,
        (
            Row("σ = 0", "mesh/cross_0mm", x=0),
            Row("σ = 0.01 m", "mesh/cross_10mm", x=0.01),
            Row("σ = 0.02 m", "mesh/proposed", _MESH_PROPOSED, 0.02),
            Row("σ = 0.03 m", "mesh/cross_30mm", x=0.03),
            Row("end-to-end", "mesh/chain", _MESH_CHAIN),
        ),
        axis=_NOISE_3D,
        notes=(_DISTANCE_NOTE, _EQ38_NOTE),
    ),
    Table(
        "table_3_7",
        "Table 3.7: the mesh regressor, by the number of sampled points (thesis: 2,048 and 4,096)",
        _MESH,
        (
            Row("half the points", "mesh/half_points", _values(_MESH, 36.0, 34.3), 2048),
            Row("all points", "mesh/proposed", _values(_MESH, 34.5, 33.0), 4096),
        ),
        axis=_POINTS,
        notes=(_EQ38_NOTE,),
    ),
    Table(
        "backgrounds",
        "Section 4.3.1: 2D joints from colours, by what is behind the person (in the thesis, in words alone)",
        _KEYPOINTS,
        (
            Row("trained on black, tested on black", "keypoints/cpn"),
            Row("trained on random, tested on black", "keypoints/cpn_random_on_black"),
            Row("trained on black, tested on random", "keypoints/cpn_on_random"),
            Row("trained on random, tested on random", "keypoints/cpn_random"),
        ),
        notes=(
            "Errors are pixels of the crop; exchanged: samples that fit better with left and right exchanged.",
        ),
    ),
    Table(
        "demo",
        "Yardsticks and detectors",
        (_MPJPE, _PCKH),
        (
            Row("initial joints", None, metrics=_NO_PCKH),
            Row("mean offset", "detector/mean_offset"),
            Row("ridge", "detector/ridge"),
            Row("basic", "detector/basic"),
            Row("proposed", "detector/proposed"),
        ),
        notes=(
            "Initial joints: the noisy 2D joints, lifted with the depth image, which every detector gets.",
            "MPJPE is the plain mean over all joints.",
        ),
    ),
)

TABLES: dict[str, Table] = {table.name: table for table in _ALL}
"""The tables by name: the thesis's, their cross evaluations and the demonstration's."""

NUM_DATA: Mapping[str, Mapping[str, int]] = {
    "train": {"subjects": 115, "sequences": 1_964, "clips": 55_001, "frames": 5_342_090, "samples": 60_000},
    "val": {"samples": 5_000},
    "test": {"subjects": 30, "sequences": 703, "clips": 12_528, "frames": 1_194_662, "samples": 15_000},
}
"""Table 3.1: how much there is of SURREAL, and of the thesis's samples of it, by split."""
