"""What every key of the configuration is to a run: the one table from which all else follows.

The run's identity, what a report calls a setting, what an evaluation takes from its checkpoint and what from its call,
what a chain passes on to its detector, and what a checkpoint's configuration has to hold are all read off it. A test
reads every file of `conf/` and fails for a key without a row.

A new knob defaults to null, and null means that all stays as it was: a null is no part of a run's identity, however
deep it stands, so that a new knob leaves finished runs what they are.
"""

from enum import Flag, auto


class Key(Flag):
    """What a key is: one of the first six, and what else is to be known of it."""

    RUN = auto()
    """Its value is part of the run's identity."""
    THROUGH = auto()
    """It reaches the run through other keys, or by the content of the file that it names."""
    CHOICE = auto()
    """It chooses a file that sets other keys."""
    MACHINE = auto()
    """It says where and how fast the run is computed."""
    TASK = auto()
    """It says what a call does."""
    CALL = auto()
    """It says where a call puts things and what it shows; with RUN: part of a training, of no use to its checkpoint."""

    CHANGEABLE = auto()
    """A test of a checkpoint may change its values."""
    ONE_STAGE = auto()
    """It belongs to one stage's model: a chain does not pass it on to its detector."""
    IN_ROW = auto()
    """A report names its rows by it, or takes means over it."""

    @property
    def is_setting(self) -> bool:
        """Whether a report tells runs apart by it."""
        return bool(self & (Key.RUN | Key.THROUGH | Key.CHOICE | Key.TASK)) and Key.IN_ROW not in self

    @property
    def is_from_call(self) -> bool:
        """Whether an evaluation takes it from its call, not from its checkpoint."""
        return bool(self & (Key.MACHINE | Key.TASK | Key.CALL))

    @property
    def is_shared(self) -> bool:
        """Whether a chain's detector is trained with it, too."""
        return not self & (Key.TASK | Key.ONE_STAGE)


def _rows(group: str, kind: Key, names: str) -> dict[str, Key]:
    return {f"{group}.{name}": kind for name in names.split()}


_DATA = Key.RUN | Key.CHANGEABLE
_MODEL = Key.RUN | Key.ONE_STAGE
_WATCH = Key.RUN | Key.CALL | Key.ONE_STAGE

# A row counts for all that is below its key, but for what has a row of its own.
KEYS: dict[str, Key] = {
    "name": Key.THROUGH | Key.IN_ROW,
    "seed": Key.RUN | Key.IN_ROW,
    "experiment": Key.CHOICE | Key.IN_ROW | Key.ONE_STAGE,
    "sweep": Key.CHOICE | Key.IN_ROW,
    "debug": Key.CHOICE,
    "preset": Key.THROUGH,
    "optimized_metric": Key.THROUGH | Key.ONE_STAGE,
    "task": Key.TASK,
    **dict.fromkeys(("ckpt_path", "weights", "refine", "bench", "predictor"), Key.TASK),
    "num_threads": Key.MACHINE,
    **dict.fromkeys(("tags", "group", "tables", "rerun", "logger", "paths", "hydra", "local"), Key.CALL),
    "body": Key.THROUGH | Key.CHANGEABLE,
    "model": _MODEL,
    "module": _MODEL,
    **_rows(
        "module",
        _MODEL,
        "_target_ _convert_ net optimizer scheduler genders predicted loss loss_vertices joint_weight",
    ),
    **_rows("module", _MODEL, "target_sigmas hard_keypoints backbone_weights"),
    **_rows("module", Key.THROUGH | Key.ONE_STAGE, "body_path"),
    "data": _DATA,
    **_rows(
        "data", _DATA, "_target_ _convert_ num_train num_val num_test batch_size seed pool_seed eval_seed"
    ),
    **_rows("data", _DATA, "camera redraw_each_epoch reuse sensor synthesis observation"),
    **_rows("data.synthesis", _DATA, "_target_ _convert_ heading distance_m margin_px depth_noise_m"),
    **_rows(
        "data.synthesis", _DATA, "keypoint_noise_px missing_keypoints focal_factors pixel_factors renderer"
    ),
    **_rows("data", _DATA, "recipe background photo"),
    **_rows("data.synthesis", _DATA, "scale shift rotation_deg mirrored"),
    **_rows("data.synthesis", _DATA | Key.ONE_STAGE, "initial_joints joint_noise_m joint_noise"),
    **_rows("data.observation", _DATA, "_target_ _convert_ num_points normals crop_px"),
    **_rows("data", Key.THROUGH | Key.CHANGEABLE | Key.ONE_STAGE, "detector_ckpt"),
    **_rows("data", Key.THROUGH | Key.CHANGEABLE, "source body_path keypoint_ckpt"),
    **_rows("data", Key.MACHINE | Key.CHANGEABLE, "cache_dir num_workers prefetch_batches"),
    "trainer": _DATA,
    **_rows("trainer", _DATA, "_target_ _convert_ max_epochs precision gradient_clip_val deterministic"),
    **_rows(
        "trainer", _DATA, "num_sanity_val_steps limit_train_batches limit_val_batches limit_test_batches"
    ),
    **_rows("trainer", Key.MACHINE | Key.CHANGEABLE, "accelerator devices strategy"),
    **_rows("trainer", Key.CALL | Key.CHANGEABLE, "log_every_n_steps enable_model_summary profiler"),
    "callbacks": _WATCH,  # they end a training, or choose its best epoch
    **_rows("callbacks", _WATCH, "best last"),
    **_rows("callbacks", Key.CALL, "progress errors pictures"),
}


def kind_of(key: str) -> Key:
    """What a key is, by the longest row that it begins with.

    A key that no file has, such as that of `+trainer.max_time=...`, is what its group is: never left out of an
    identity by mistake.
    """
    row = _row(key)
    return KEYS[row] if row else Key.RUN


def is_listed(key: str) -> bool:
    """Whether a key has a row: its own, or that of a group whose keys are all alike."""
    row = _row(key)
    return row is not None and (row == key or not any(other.startswith(f"{row}.") for other in KEYS))


def _row(key: str) -> str | None:
    while key and key not in KEYS:
        key = key.rpartition(".")[0]
    return key or None


def key_of(override: str) -> str:
    """The key of an override as it was typed, with dots: `data.source` of `data/source=embedded`."""
    return override.partition("=")[0].lstrip("+~").replace("/", ".")


CONFIG_GROUPS = tuple(
    key
    for key, kind in KEYS.items()
    if "." not in key and kind & (Key.RUN | Key.THROUGH) and not kind.is_from_call
)
"""The part of a checkpoint's configuration that decides what it is."""
