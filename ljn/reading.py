"""Reading files from outside: bounded in size, depth and time; and the words for why one cannot be read."""

import io
import json
import math
import pickle
import pickletools
import re
import reprlib
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

READ_ERRORS: tuple[type[Exception], ...] = (
    ArithmeticError, AttributeError, EOFError, LookupError, MemoryError, OSError, RuntimeError, SyntaxError, TypeError,
    ValueError, pickle.UnpicklingError, struct.error, tokenize.TokenError, yaml.YAMLError, zipfile.BadZipFile,
    zlib.error,
)  # fmt: skip
"""What the functions here, numpy, zipfile, pickle, Pillow, json and yaml raise at damaged files and at those of another
format: each is to become a `ValueError` that names the file and gives the `reason`."""

_MAX_JSON_BYTES = 2**24
_MAX_YAML_BYTES = 2**16  # some hundred times a camera's, or a run's configuration; yaml takes a second for it
_MAX_UNPACKED_BYTES = 2**28
_MAX_UNPACKED_RATIO = 32
_MAX_DEPTH = 32
_MAX_SIZE = 10**6
_SIZE_OF_VALUE = 50  # a value counts as much as this many characters of text
_MAX_TUPLE = 10_000
_UNSAFE_ADVICE = ("weights_only", "allow_pickle", "pickle.load", "add_safe_globals")


def brief(text: str, limit: int = 200) -> str:
    """A text from outside on one line, printable, and cut to `limit` characters."""
    line = " ".join(text[: 4 * limit].split())
    line = "".join(letter if letter.isprintable() else "?" for letter in line)
    return line if len(line) <= limit else f"{line[: limit - 3]}..."


def shown(value: Any) -> str:
    """A value from outside as Python would write it, in brief."""
    try:
        return brief(_REPR.repr(value))
    except ValueError:  # an integer of too many digits
        return f"a value of type {type(value).__name__}"


def reason(error: BaseException, limit: int = 200) -> str:
    """Why something could not be read: the first words of an error, without advice to run what a file holds."""
    text = str(error)
    if any(word in text for word in _UNSAFE_ADVICE):
        return "it holds Python objects, which are never loaded, or is damaged"
    return brief(text, limit) or type(error).__name__


_REPR = reprlib.Repr()
_REPR.maxlevel, _REPR.maxstring, _REPR.maxother = 2, 100, 100


def read_json(path: Path) -> Any:
    """The content of a JSON file; raises `READ_ERRORS`."""
    return json.loads(_text(path, _MAX_JSON_BYTES))


def read_yaml(path: Path) -> Any:
    """The content of a small YAML file without code and without repeated lists or mappings; raises `READ_ERRORS`."""
    # OpenCV begins its files with "%YAML:1.0", which is no YAML.
    return yaml.load(re.sub(r"^%YAML:[0-9.]+", "", _text(path, _MAX_YAML_BYTES)), _PlainLoader)


class _PlainLoader(yaml.SafeLoader):
    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            name = self.peek_event().anchor
            # Lists of aliases of lists of aliases: a few lines stand for 2^30 values.
            if not isinstance(self.anchors.get(name), yaml.ScalarNode):
                raise ValueError(f"the alias *{name} does not stand for a single value that came before")
        return super().compose_node(parent, index)


_PlainLoader.add_constructor(
    "tag:yaml.org,2002:opencv-matrix", lambda loader, node: loader.construct_mapping(node, deep=True)
)


def _text(path: Path, max_bytes: int) -> str:
    if (size := path.stat().st_size) > max_bytes:
        raise ValueError(f"{size} bytes, expected at most {max_bytes}")
    return path.read_text(
        encoding="utf-8-sig"
    )  # with a byte-order mark, as some editors write it, or without


def read_arrays(path: Path, keys: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of an `.npz` file, or those of `keys` that it has; the one of an `.npy` file under the key "".

    See `read_entries`. Raises `READ_ERRORS`.
    """
    return {key: array_in(content) for key, content in read_entries(path, keys).items()}


def read_entries(path: Path, keys: Collection[str] | None = None) -> dict[str, bytes]:
    """The arrays' contents in an `.npz` file, or those of `keys` that it has; that of an `.npy` file under the key "".

    An archive may unpack to 256 MiB, or to 32 times its size where that is more. Raises `READ_ERRORS`.
    """
    with path.open("rb") as file:
        if file.read(2) != b"PK":
            return {"": path.read_bytes()}
        size = path.stat().st_size
        with zipfile.ZipFile(file) as archive:
            entries = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
            wanted = {key: entry for key, entry in entries.items() if keys is None or key in keys}
            _check_entries(wanted.values(), max(_MAX_UNPACKED_BYTES, _MAX_UNPACKED_RATIO * size))
            # Reading a whole entry compares its checksum.
            return {key: archive.read(entry) for key, entry in wanted.items()}


def _check_entries(entries: Collection[zipfile.ZipInfo], max_bytes: int) -> None:
    if any(entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for entry in entries):
        raise ValueError("an unusual compression")
    if (size := sum(entry.file_size for entry in entries)) > max_bytes:
        raise ValueError(f"it would unpack to {size} bytes, expected at most {max_bytes}")


def pickle_in(content: bytes) -> bytes | None:
    """The pickle in an `.npy` file's content that holds Python objects; None where it holds numbers or text."""
    stream = io.BytesIO(content)
    holds_objects = _header(stream)[2].hasobject
    return content[stream.tell() :] if holds_objects else None


def _header(stream: io.BytesIO) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, order and type of an `.npy` file's array; the stream then stands at its data."""
    form = np.lib.format
    if (version := form.read_magic(stream)) not in ((1, 0), (2, 0)):
        raise ValueError(f"an .npy file of version {version}")
    read = form.read_array_header_1_0 if version == (1, 0) else form.read_array_header_2_0
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", ".*created on Python 2", UserWarning
        )  # it advises to save the file again
        return read(stream)


def array_in(content: bytes) -> np.ndarray:
    """The array of an `.npy` file's content, of the size that its header says."""
    stream = io.BytesIO(content)
    shape, is_fortran, dtype = _header(stream)
    if dtype.kind not in "biufcSU" or dtype.itemsize == 0 or min(shape, default=0) < 0:
        raise ValueError(f"it holds {brief(str(dtype))} of shape {shown(shape)}, expected numbers or text")
    start = stream.tell()
    size, expected = len(content) - start, math.prod(shape) * dtype.itemsize
    if size != expected:
        raise ValueError(f"it holds {size} bytes, but {shown(expected)} by its header")
    values = np.frombuffer(bytearray(content[start:]), dtype)
    return values.reshape(shape, order="F" if is_fortran else "C")


def check_archive(content: bytes) -> None:
    """Raise one of `READ_ERRORS` unless the archive of a PyTorch file is whole and can be unpickled in bounded time.

    PyTorch itself passes over the checksums.
    """
    # PyTorch would take any other beginning for a form without checksums.
    if not content.startswith(b"PK\x03\x04"):
        raise ValueError("not the archive that PyTorch writes")
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        entries = archive.infolist()
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise ValueError("a compressed archive, which PyTorch does not write")
        # One bit of them marks an entry as a folder: PyTorch then takes uninitialised memory for its content.
        if any(entry.external_attr for entry in entries):
            raise ValueError("attributes of files, which PyTorch does not write")
        _check_entries(entries, len(content))
        for entry in entries:
            data = archive.read(entry)  # compares the checksum
            if entry.filename.lower().endswith("data.pkl"):
                check_pickle(data)


def check_pickle(content: bytes) -> None:
    """Raise one of `READ_ERRORS` if a pickle nests its tuples so that they stand for more than 10,000 values.

    A tuple that serves as a key is hashed through all its levels: thirty pairs of the pair before take an hour.
    """
    stack: list[int | None] = []  # the number of values that each stands for; None is a mark
    memo: dict[Any, int] = {}
    for opcode, argument, _ in pickletools.genops(content):
        name, before = opcode.name, opcode.stack_before
        taken: list[int] = []
        if pickletools.markobject in before or (name == "POP" and stack and stack[-1] is None):
            while (value := stack.pop()) is not None:
                taken.append(value)
            before = before[: before.index(pickletools.markobject)] if name != "POP" else []
        taken += [stack.pop() or 0 for _ in before]
        if name.endswith("GET"):
            stack.append(memo[argument])
        elif name == "MEMOIZE":
            memo[len(memo)] = taken[0]
            stack += taken
        elif name.endswith("PUT"):
            memo[argument] = stack[-1] or 0
        elif name == "DUP":
            stack += 2 * taken
        elif name == "MARK":
            stack.append(None)
        else:
            size = 1 + sum(taken) if "TUPLE" in name else 1
            if size > _MAX_TUPLE:
                raise ValueError("tuples in tuples that stand for too many values")
            stack += [size] * len(opcode.stack_after)


def plain_values(content: Any) -> Iterator[Any]:
    """The single values of nested mappings and lists.

    A value in several places is yielded, and counted, that often: 30 lists of twice the list before are 2^30 values.

    Raises:
        ValueError: Deeper, larger or of other types than a configuration is.
    """
    size, pending = 0, [(content, 0)]
    while pending:
        value, depth = pending.pop()
        size += _SIZE_OF_VALUE + (len(value) if isinstance(value, str) else 0)
        if isinstance(value, dict | list):
            entries = list(value.values()) if isinstance(value, dict) else value
            if isinstance(value, dict):
                if not all(isinstance(key, str) for key in value):
                    raise ValueError("a key that is no text")
                size += sum(map(len, value))
            # Before they are listed: the list of what is pending stays small, too.
            if depth >= _MAX_DEPTH or size + _SIZE_OF_VALUE * (len(pending) + len(entries)) > _MAX_SIZE:
                raise ValueError("nested too deeply, or of too many values")
            pending += [(entry, depth + 1) for entry in entries]
        elif type(value) in (type(None), str, bool, float) or (type(value) is int and abs(value) < 2**63):
            yield value
        else:
            raise ValueError(f"a value of type {type(value).__name__}, or out of range")
    if size > _MAX_SIZE:
        raise ValueError("of too much text")
