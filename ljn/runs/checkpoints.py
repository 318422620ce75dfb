"""Checkpoints: written whole or not at all, with where they came from; read as data, never as code."""

import hashlib
import io
import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import Tensor
from torch.nn.modules.module import register_module_parameter_registration_hook

from ljn.building import build, check_targets, with_moved_targets
from ljn.cloud.observation import ObservationRecipe
from ljn.cloud.rgb import RgbRecipe
from ljn.geometry.camera import Camera
from ljn.modules.base import StageModule
from ljn.reading import READ_ERRORS, brief, check_archive, plain_values, reason, shown
from ljn.runs.keys import CONFIG_GROUPS
from ljn.runs.packages import is_package, read_stage

CHECKPOINT_VERSION = 3
_PROVENANCE_KEY = "ljn"
_CONTENT_ERRORS: tuple[type[Exception], ...] = (ImportError, *READ_ERRORS)
_MAX_TEXT = 1000
_MAX_SHARING = 16
_MIN_FITTING = 0.9  # of the numbers of a network that begins with another's weights
_DTYPES = (
    torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.bool, torch.uint8, torch.int8, torch.int16,
    torch.int32, torch.int64,
)  # fmt: skip


class Provenance(Callback):
    """Adds to every checkpoint what is needed to use it alone; see `Checkpoint`."""

    def __init__(
        self,
        config: dict[str, Any],
        body_hash: str,
        data_licence: str,
        run: str,
        recipe: ObservationRecipe | RgbRecipe | None,
        detector: bytes | None = None,
    ) -> None:
        self.content: dict[str, Any] = {
            "version": CHECKPOINT_VERSION,
            "config": config,
            "body_hash": body_hash,
            "data_licence": data_licence,
            "run": run,
            "observation": None if recipe is None else _plain_recipe(recipe),
        }
        if detector is not None:
            self.content["detector"] = torch.frombuffer(bytearray(detector), dtype=torch.uint8)

    def on_save_checkpoint(self, trainer: Any, pl_module: Any, checkpoint: dict[str, Any]) -> None:
        """Add the content under its key."""
        checkpoint[_PROVENANCE_KEY] = self.content


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes a checkpoint beside its place, then renames it: a killed run leaves the old one or the new one.

    Lightning's own way passes through the system's temporary folder, and from another file system a move is a
    copy, which can be cut off.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        """Write `checkpoint` to `path`."""
        draft = f"{path}.{os.getpid()}.tmp"
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        try:
            torch.save(checkpoint, draft)
            os.replace(draft, path)
        finally:
            Path(draft).unlink(missing_ok=True)


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint of this library, or a stage of a package."""

    path: Path  # the file
    config: dict[str, Any]  # the resolved configuration that the model was trained with
    body_hash: str  # hashes of the bodies that its data showed, joined by "-"
    data_licence: str  # one line on the data's licence
    run: str  # name of the directory of the training run
    epoch: int  # epochs completed when it was written
    # how the observations that it was trained on were made; None where there were none
    recipe: ObservationRecipe | RgbRecipe | None
    state: dict[str, Tensor]  # the module's state dict
    file_hash: str  # first 16 hex digits of the file's SHA-256
    detector: bytes | None = None  # content of the file of the detector whose joints it was trained on

    def unknown_bodies(self, hashes: Iterable[str]) -> list[str]:
        """Those of the bodies' hashes that it was not trained with: a model is only meaningful with its bodies."""
        return sorted(set(hashes) - set(self.body_hash.split("-")))


def read_checkpoint(path: str | Path, name: str = "ckpt_path", stage: str = "detector") -> Checkpoint:
    """Read a checkpoint, or a stage of a package; errors call its argument `name`.

    The configuration of a package's mesh regressor names that package's detector, to be tested on its joints.

    Args:
        path: A checkpoint, or a package (`NAME.safetensors`).
        name: The argument's name.
        stage: Which stage of a package; a checkpoint is of one.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is damaged, not a checkpoint of this library, of a newer version, or has no such stage.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"{name}: no file '{path}'; a run keeps its best checkpoint in RUN_DIRECTORY/checkpoints/best.ckpt"
        )
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{name}: '{path}' cannot be read ({reason(error)})") from error
    content = _content(path, data, name, stage)
    provenance: Any = content.get(_PROVENANCE_KEY) if isinstance(content, dict) else None
    if not _is_ours(content, provenance):
        raise ValueError(
            f"{name}: '{path}' is a file of weights, but no checkpoint that a run of this library wrote: it "
            "carries no whole configuration"
        )
    if provenance["version"] != CHECKPOINT_VERSION:
        age, fix = "an older", "train it again, or evaluate it with the version it is from"
        if provenance["version"] > CHECKPOINT_VERSION:
            age, fix = "a newer", "update the library"
        raise ValueError(
            f"{name}: '{path}' was written by {age} version of this library (checkpoint version "
            f"{provenance['version']}, this one reads {CHECKPOINT_VERSION}); {fix}"
        )
    detector = provenance.get("detector")
    try:
        checkpoint = Checkpoint(
            path=path,
            config=with_moved_targets(provenance["config"]),
            **{key: provenance[key] for key in ("body_hash", "data_licence", "run")},
            epoch=content["epoch"] + 1,
            recipe=_read_recipe(provenance.get("observation")),
            state=dict(content["state_dict"]),
            file_hash=hash_of(data),
            detector=None if detector is None else _bytes_of(detector, len(data)),
        )
        _check_state(checkpoint.state, len(data))
        _check_content(checkpoint)
    except _CONTENT_ERRORS as error:
        raise ValueError(
            f"{name}: '{path}': {reason(error, 1000)}; use another checkpoint of the run"
        ) from error
    return checkpoint


def _plain_recipe(recipe: ObservationRecipe | RgbRecipe) -> dict[str, Any]:
    """A recipe as plain values. One of depth images, the only kind once, does not name its class."""
    named = {} if isinstance(recipe, ObservationRecipe) else {"_target_": _path_of(type(recipe))}
    return {**named, **asdict(recipe)}


def _read_recipe(plain: Any) -> ObservationRecipe | RgbRecipe | None:
    if plain is None:
        return None
    fields = dict(plain)
    target = fields.pop("_target_", _path_of(ObservationRecipe))
    known = {_path_of(kind): kind for kind in (ObservationRecipe, RgbRecipe)}
    if target not in known:
        raise ValueError(f"observation: expected one of {', '.join(known)}, got {shown(target)}")
    return known[target](**fields)


def _path_of(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"


def hash_of(data: bytes) -> str:
    """What a checkpoint's file is known by."""
    return hashlib.sha256(data).hexdigest()[:16]


def _bytes_of(value: Any, limit: int) -> bytes:
    if not (isinstance(value, Tensor) and value.dtype == torch.uint8 and value.numel() <= limit):
        raise ValueError(f"detector: expected the bytes of a file, got {shown(type(value).__name__)}")
    return value.cpu().numpy().tobytes()


def _content(path: Path, data: bytes, name: str, stage: str) -> Any:
    """What a checkpoint's file holds, or a package's for a stage, in a checkpoint's form."""
    if is_package(path):
        about, state = read_stage(data, stage, f"{name}: '{path}'")
        settings = about["config"].get("data") if isinstance(about.get("config"), dict) else None
        if stage != "detector" and isinstance(settings, dict) and "detector_ckpt" in settings:
            settings["detector_ckpt"] = str(path)
        return {_PROVENANCE_KEY: about, "epoch": about.get("epoch"), "state_dict": state}
    try:
        check_archive(data)
        return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except READ_ERRORS as error:
        raise ValueError(
            f"{name}: '{path}' is damaged, truncated or no checkpoint at all ({reason(error)}); copy it again, or "
            "use another one of the run"
        ) from error


def for_package(checkpoint: Checkpoint, config: dict[str, Any], training: dict[str, Any]) -> dict[str, Any]:
    """What a package says of a checkpoint, as `read_checkpoint` reads it, with a configuration fit to leave the machine
    and a record of the training.
    """
    provenance = Provenance(
        config, checkpoint.body_hash, checkpoint.data_licence, checkpoint.run, checkpoint.recipe
    )
    return {**provenance.content, "epoch": checkpoint.epoch - 1, "training": training}


def _is_ours(content: Any, provenance: Any) -> bool:
    types = {"version": int, "config": dict, "body_hash": str, "data_licence": str, "run": str}
    config_types = dict.fromkeys(("preset", "model", "module", "data", "body", "trainer"), dict)
    return (
        isinstance(provenance, dict)
        and all(isinstance(provenance.get(name), kind) for name, kind in types.items())
        and max(len(provenance[name]) for name in ("body_hash", "data_licence", "run")) <= _MAX_TEXT
        and abs(provenance["version"]) < 2**31
        and all(group in provenance["config"] for group in CONFIG_GROUPS)
        and all(isinstance(provenance["config"][name], kind) for name, kind in config_types.items())
        and _is_resolved(provenance["config"])
        and isinstance(content.get("state_dict"), dict)
        and isinstance(content.get("epoch"), int)
        and 0 <= content["epoch"] < 2**31
    )


def _is_resolved(config: Any) -> bool:
    """Whether a configuration is plain values: an interpolation would be resolved here, on this machine's values."""
    try:
        texts = [value for value in plain_values(config) if isinstance(value, str)]
    except ValueError:
        return False
    return not any("${" in text or text == "???" for text in texts)


def _check_state(state: Mapping[Any, Any], file_size: int) -> None:
    """Raise a `ValueError` unless a state dict is finite numbers under names, no larger than its file explains."""
    size = 0
    for name, value in state.items():
        if not isinstance(name, str):
            raise ValueError(f"state_dict: expected names, got {shown(name)}")
        if not (isinstance(value, Tensor) and value.layout == torch.strided and value.dtype in _DTYPES):
            what = f"{value.layout} of {value.dtype}" if isinstance(value, Tensor) else type(value).__name__
            raise ValueError(f"state_dict: {brief(name)}: expected a tensor of plain numbers, got {what}")
        # Tensors may share memory, and a few bytes can stand for any shape.
        size += value.numel() * value.element_size()
        if value.device.type != "cpu" or size > _MAX_SHARING * file_size:
            raise ValueError(f"state_dict: {brief(name)}: expected numbers that are in the file")
        if value.is_floating_point() and not value.float().isfinite().all():
            raise ValueError(
                f"state_dict: {brief(name)}: expected finite numbers; has the training diverged?"
            )


def _check_content(checkpoint: Checkpoint) -> None:
    """Raise a `ValueError` unless the weights are those of the network, and the camera is one.

    The network is built without memory for its weights: a configuration can ask for any width.
    """
    module, camera = checkpoint.config["module"], checkpoint.config["data"].get("camera")
    check_targets({name: checkpoint.config[name] for name in CONFIG_GROUPS}, "the checkpoint's config")
    if camera is not None and not isinstance(build(camera), Camera):
        raise ValueError("the checkpoint's config.data.camera: expected a camera")
    num_parameters = 0

    def count(*_: Any) -> None:
        nonlocal num_parameters
        num_parameters += 1
        if num_parameters > len(checkpoint.state):
            raise ValueError("holds the weights of another model, a smaller one than its configuration says")

    counting = register_module_parameter_registration_hook(count)
    try:
        with torch.device("meta"):
            net = build(module.get("net"))
    finally:
        counting.remove()
    if not isinstance(net, torch.nn.Module):
        raise ValueError(
            f"the checkpoint's config.module.net: expected a network, got a {type(net).__name__}"
        )
    expected = {f"net.{name}": value for name, value in net.state_dict().items()}
    _check_shapes(expected, {name: checkpoint.state[name] for name in checkpoint.state if name in expected})


def _check_shapes(expected: Mapping[str, Tensor], got: Mapping[str, Tensor]) -> None:
    shapes, got_shapes = (
        {name: tuple(value.shape) for name, value in state.items()} for state in (expected, got)
    )
    if differing := sorted({name for name, _ in shapes.items() ^ got_shapes.items()}):
        name = differing[0]
        raise ValueError(
            f"holds the weights of another model: {len(differing)} tensors differ, the first is '{brief(name)}', "
            f"expected {shapes.get(name, 'none')}, got {shown(got_shapes.get(name, 'none'))}"
        )


def load_state(module: torch.nn.Module, checkpoint: Checkpoint, argument: str = "ckpt_path") -> None:
    """Load a checkpoint's weights into the module that its configuration describes; errors name `argument`.

    Raises:
        ValueError: The weights belong to another model.
    """
    try:
        _check_shapes(module.state_dict(), checkpoint.state)
    except ValueError as error:
        raise ValueError(f"{argument}: '{checkpoint.path}' {error}") from None
    module.load_state_dict(checkpoint.state)


def begin_with(module: torch.nn.Module, checkpoint: Checkpoint, argument: str) -> list[str]:
    """Load the weights of a checkpoint that a training begins with; errors name `argument`.

    Its network may differ in a few shapes: another number of channels that it sees, of joints that it gives.

    Returns:
        The names of the weights that are of another shape, and left as they are.

    Raises:
        ValueError: The weights have other names, or those that fit are less than nine in ten.
    """
    state = module.state_dict()
    fitting = {
        name: value
        for name, value in checkpoint.state.items()
        if name in state and value.shape == state[name].shape
    }
    size, fitting_size = (sum(value.numel() for value in values.values()) for values in (state, fitting))
    if set(checkpoint.state) != set(state) or fitting_size < _MIN_FITTING * size:
        load_state(module, checkpoint, argument)  # says what differs
    module.load_state_dict(state | fitting)
    return sorted(set(state) - set(fitting))


def load_module(
    path: str | Path,
    kind: type[StageModule],
    name: str = "ckpt_path",
    body_path: str | Path | None = None,
) -> tuple[Any, Checkpoint]:
    """The trained module of a checkpoint or a package, in evaluation mode; and the checkpoint.

    Args:
        path: See `read_checkpoint`.
        kind: The module's class.
        name: What errors call the path's argument.
        body_path: File or folder of the body that the module predicts, to predict alone; None: as in its training.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: See `read_checkpoint` and `load_state`; or the checkpoint is of another kind.
    """
    checkpoint = read_checkpoint(path, name, kind.stage)
    config = checkpoint.config["module"]
    if body_path is not None and "predicted" in config:
        config = config | {"body_path": str(body_path), "genders": [config["predicted"]]}
    try:
        module = build(config)
    except FileNotFoundError as error:
        raise FileNotFoundError(
            f"{name}: '{path}': {error}; its place is body.path=FILE, in Python body_path=FILE"
        ) from error
    except ValueError as error:
        raise ValueError(f"{name}: '{path}': {error}") from error
    if not isinstance(module, kind):
        raise ValueError(
            f"{name}: expected the checkpoint of a {kind.__name__}, but '{path}' is that of a "
            f"{type(module).__name__} ({checkpoint.run}); have two checkpoints changed places?"
        )
    load_state(module, checkpoint, name)
    return module.eval().requires_grad_(False), checkpoint
