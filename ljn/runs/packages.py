"""Packages: trained weights as one file to ship: a joint detector's and, if there is one, a mesh regressor's; or a
keypoint detector's.

A package is a safetensors file, which can hold nothing but numbers and text: the tensor `STAGE.NAME` is an entry of
that stage's state, half precision or int8 with a scale for each output row, and one text, JSON, says the rest: the
package's `name` and `licence`, and of each stage what a checkpoint carries beside its weights (see
`ljn.runs.checkpoints`), and of its training. `read_checkpoint` reads one stage of it; those that ship with the library
lie in `SHIPPED` and are loaded by name.
"""

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from ljn import reading
from ljn.optional import import_huggingface_hub
from ljn.reading import READ_ERRORS, brief, plain_values, reason, shown
from ljn.runs.files import write_atomically, write_json

PACKAGE_VERSION = 1
SUFFIX = ".safetensors"
STAGES = ("detector", "mesh", "keypoints")
SHIPPED = Path(__file__).parents[1] / "weights"
"""The folder of the packages that come with the library."""
DEFAULT = "small"
"""Which of them is taken where none is named."""
INDEX = "index.json"
"""Of a folder of packages: each one's size and checksum, by its name."""
_LOAD_ERRORS: tuple[type[Exception], ...] = (SafetensorError, *READ_ERRORS)
NAME = re.compile(r"[A-Za-z0-9][\w.-]{0,99}")
_OF_HUB = re.compile(rf"{NAME.pattern}/{NAME.pattern}")
_HUB_FILE = f"model{SUFFIX}"
_TEXT = "ljn"
_MAX_HEADER_BYTES = 2**22
_SCALE = ":scale"
_MIN_QUANTISED = 4096
"""Entries of the smallest matrix that becomes int8."""


def is_package(path: str | Path) -> bool:
    """Whether a file is to be read as a package: by its name."""
    return Path(path).suffix == SUFFIX


def write_package(
    path: Path,
    name: str,
    licence: str,
    stages: Mapping[str, Mapping[str, Any]],
    states: Mapping[str, Mapping[str, Tensor]],
    precision: str = "int8",
) -> None:
    """Write a package, whole or not at all, and its line in the folder's index.

    Args:
        path: The file to be, `NAME.safetensors`.
        name: The package's name.
        licence: Under which the weights are given.
        stages: By stage, what its checkpoint carries beside its weights; plain values.
        states: By stage, its state.
        precision: A key of `PRECISIONS`.

    Raises:
        ValueError: There is no such precision.
    """
    if precision not in PRECISIONS:
        raise ValueError(f"precision: expected one of {', '.join(PRECISIONS)}, got {precision!r}")
    tensors = {
        f"{stage}.{part}": value
        for stage, state in states.items()
        for entry, tensor in state.items()
        for part, value in PRECISIONS[precision](entry, tensor).items()
    }
    about = {"version": PACKAGE_VERSION, "name": name, "licence": licence, "stages": stages}
    # A single text: of several, the order in the file would be by chance, and with it the checksum.
    data = save(tensors, {_TEXT: json.dumps(about)})
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, data)
    index = path.with_name(INDEX)
    entries = _index(path.parent) if index.is_file() else {}
    write_json(index, dict(sorted({**entries, path.stem: _facts(data)}.items())))


def _half(name: str, value: Tensor) -> dict[str, Tensor]:
    value = value.detach().contiguous()
    if not value.is_floating_point():
        return {name: value}
    half = value.half()
    return {name: half if half.isfinite().all() else value.float()}


def _int8(name: str, value: Tensor) -> dict[str, Tensor]:
    """`(..., out, in)` as int8 and a scale for each output row, `(..., out, 1)`; all but large matrices as `_half`."""
    if not (value.is_floating_point() and value.ndim in (2, 3) and value.numel() >= _MIN_QUANTISED):
        return _half(name, value)
    value = value.detach().float()
    scale = (value.abs().amax(-1, keepdim=True) / 127).half()
    if not scale.isfinite().all():
        return _half(name, value)
    steps = value / torch.where(scale > 0, scale.float(), 1.0)
    return {name: steps.round().clamp(-127, 127).to(torch.int8).contiguous(), f"{name}{_SCALE}": scale}


PRECISIONS: dict[str, Callable[[str, Tensor], dict[str, Tensor]]] = {"int8": _int8, "half": _half}
"""How an entry of a state is stored, by name."""


def read_about(data: bytes, where: str) -> dict[str, Any]:
    """What a package's content says of itself: `version`, `name`, `licence`, and `stages` by their names.

    A stage's own entries are left unchecked. Errors begin with `where`.

    Raises:
        ValueError: The content is damaged, no package, or of another version of the library.
    """
    try:
        size = int.from_bytes(data[:8], "little")
        if not 2 <= size <= min(len(data) - 8, _MAX_HEADER_BYTES):
            raise ValueError(f"its header would be {size} bytes long")
        header = json.loads(data[8 : 8 + size])
        text = header.get("__metadata__", {}).get(_TEXT)
        about = None if text is None else json.loads(text)
        sum(1 for _ in plain_values(about))  # bounded in depth and size
    except READ_ERRORS as error:
        raise _damaged(where, error) from error
    if not isinstance(about, dict) or not isinstance(about.get("version"), int):
        raise ValueError(
            f"{where} is a safetensors file, but no package that task=package of this library wrote: it says nothing "
            "of a configuration"
        )
    if about["version"] != PACKAGE_VERSION:
        raise ValueError(
            f"{where} is a package of another version of this library (package version {shown(about['version'])}, "
            f"this one reads {PACKAGE_VERSION}); update the library, or take the package of this version"
        )
    stages = about.get("stages")
    if not (
        all(isinstance(about.get(key), str) for key in ("name", "licence"))
        and isinstance(stages, dict)
        and stages
        and all(stage in STAGES and isinstance(entry, dict) for stage, entry in stages.items())
    ):
        raise ValueError(
            f"{where}: expected a package's name, licence and stages ({', '.join(STAGES)}), got {shown(about)}; fetch "
            "it again"
        )
    return about


def read_stage(data: bytes, stage: str, where: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """What a package's content says of a stage, and the stage's state: floating-point entries as float32.

    Raises:
        ValueError: See `read_about`; or the package has no such stage.
    """
    stages = read_about(data, where)["stages"]
    if stage not in stages:
        raise ValueError(f"{where} holds {' and '.join(stages)} alone, but no {stage}; take another package")
    try:
        return stages[stage], _state(load(data), f"{stage}.")
    except _LOAD_ERRORS as error:
        raise _damaged(where, error) from error


def _state(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The entries of a state under names that begin with `prefix`."""
    state: dict[str, Tensor] = {}
    stored = {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
    for name, value in stored.items():
        if name.endswith(_SCALE):
            if name.removesuffix(_SCALE) not in stored:
                raise ValueError(f"a scale of nothing, {brief(name)}")
            continue
        scale = stored.get(f"{name}{_SCALE}")
        if (scale is None) == (value.dtype == torch.int8):
            raise ValueError(f"{brief(name)}: int8 without a scale, or a scale of something else")
        if scale is not None and scale.shape != (*value.shape[:-1], 1):
            raise ValueError(f"{brief(name)} and its scale do not fit")
        if scale is not None:
            value = value.float() * scale.float()
        state[name] = value.float() if value.is_floating_point() else value
    return state


def _damaged(where: str, error: Exception) -> ValueError:
    return ValueError(f"{where} is damaged, truncated or no package at all ({reason(error)}); fetch it again")


def stages_of(path: Path, name: str = "weights") -> list[str]:
    """The stages that a package's file holds; errors call its argument `name`."""
    return list(read_about(path.read_bytes(), f"{name}: '{path}'")["stages"])


def shipped() -> list[str]:
    """The names of the packages that come with the library."""
    return list(_index(SHIPPED))


def find_package(weights: str | Path, name: str = "weights") -> Path:
    """The file of a package; errors call its argument `name`.

    Args:
        weights: The name of a package that comes with the library, whose checksum is then compared; a package's file;
            or `ORGANISATION/NAME`, a repository of the Hugging Face hub with a file `model.safetensors`, which is
            fetched.
        name: The argument's name.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is none of these, damaged, or cannot be fetched.
        ImportError: It is to be fetched, and `huggingface_hub` is missing.
    """
    text, index = str(weights), _index(SHIPPED)
    if text in index:
        return _checked(SHIPPED / f"{text}{SUFFIX}", index[text], name)
    if is_package(text):
        if not Path(text).is_file():
            raise FileNotFoundError(f"{name}: no file '{text}'; task=package writes one")
        return Path(text)
    if _OF_HUB.fullmatch(text):
        return _fetched(text, name)
    raise ValueError(
        f"{name}: expected the name of weights that come with this version ({', '.join(index) or 'it has none'}), a "
        f"package's file (NAME{SUFFIX}), or ORGANISATION/NAME on the Hugging Face hub, got '{brief(text)}'"
    )


def _fetched(repository: str, name: str) -> Path:
    hub = import_huggingface_hub()
    try:
        return Path(hub.hf_hub_download(repo_id=repository, filename=_HUB_FILE))
    except (OSError, ValueError) as error:
        raise ValueError(
            f"{name}: cannot fetch {_HUB_FILE} of '{repository}' from the Hugging Face hub ({reason(error)}); see "
            "whether there is such a repository and a connection, or give a package's file"
        ) from error


def _index(directory: Path) -> dict[str, dict[str, Any]]:
    path = directory / INDEX
    try:
        index = reading.read_json(path)
        if not all(
            NAME.fullmatch(name) and {"bytes", "sha256"} <= set(facts) for name, facts in index.items()
        ):
            raise ValueError("expected names, each with bytes and sha256")
    except READ_ERRORS as error:
        raise ValueError(f"'{path}' cannot be read ({reason(error)}); install the library again") from error
    return index


def _facts(data: bytes) -> dict[str, Any]:
    return {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def _checked(path: Path, facts: Mapping[str, Any], name: str) -> Path:
    """A shipped file whose content is what the index says."""
    fix = "install the library again, or take the file from its repository again"
    if not path.is_file():
        raise FileNotFoundError(f"{name}: the index names '{path}', but there is no such file; {fix}")
    got = _facts(path.read_bytes())
    if any(got[key] != facts[key] for key in got):
        raise ValueError(
            f"{name}: '{path}' is damaged: expected {shown(facts['bytes'])} bytes of SHA-256 {shown(facts['sha256'])}, "
            f"got {got['bytes']} of {got['sha256']}; {fix}"
        )
    return path
