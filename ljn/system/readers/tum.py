"""TUM's RGB-D data sets: lists of timestamps and images."""

from pathlib import Path

from ljn.reading import brief
from ljn.system.readers.files import CameraLike, Entry, FileRecording, find_cameras
from ljn.system.readers.timestamps import MATCH_S, match, read_lines

LOOKS_FOR = "TUM's associations.txt, or rgb.txt and depth.txt"
DEPTH_SCALE = 5000.0
"""Units of TUM's depth images to a metre."""


def is_tum(path: Path) -> bool:
    """Whether it has this layout."""
    return (path / "associations.txt").is_file() or all(
        (path / name).is_file() for name in ("rgb.txt", "depth.txt")
    )


def open_tum(
    path: Path,
    camera: CameraLike | None = None,
    rgb_camera: CameraLike | None = None,
    depth_scale: float | None = None,
) -> FileRecording:
    """A recording of TUM's; see `ljn.system.readers.open_recording`."""
    cameras = find_cameras(path, camera, rgb_camera, depth_scale, DEPTH_SCALE)
    facts: dict[str, object] = {}
    if (path / "associations.txt").is_file():
        return FileRecording(path, "TUM, associations", _associated(path / "associations.txt"), cameras)
    colours, depths = (_listed(path / name) for name in ("rgb.txt", "depth.txt"))
    partners = match([time for time, _ in depths], [time for time, _ in colours])
    if not any(partner is not None for partner in partners):
        raise ValueError(
            f"input: no image of '{path / 'rgb.txt'}' was taken within {MATCH_S:g} s of one of depth.txt (the first at "
            f"{colours[0][0]:f} and {depths[0][0]:f} s): are both of one clock?"
        )
    if unused := len(colours) - sum(partner is not None for partner in partners):
        facts["colours_without_depth"] = unused
    entries = [
        Entry(depth.stem, depth, None if partner is None else colours[partner][1], time)
        for (time, depth), partner in zip(depths, partners)
    ]
    return FileRecording(path, "TUM, lists", entries, cameras, facts)


def _listed(path: Path) -> list[tuple[float, Path]]:
    """Times, seconds, and images of a list, in the order of time."""
    rows = [_row(line.split(), 2, path) for line in read_lines(path)]
    if not rows:
        raise ValueError(f"input: expected lines TIMESTAMP FILE in '{path}', got none")
    return sorted((_time(time, path), path.parent / name) for time, name in rows)


def _associated(path: Path) -> list[Entry]:
    """The frames of `associations.txt`; colour and depth may come in any order."""
    entries = []
    for line in read_lines(path):
        first, picture, second, depth = _row(line.split(), 4, path)
        if "depth" in picture.lower() and "depth" not in depth.lower():
            first, picture, second, depth = second, depth, first, picture
        _time(first, path)
        file = path.parent / depth
        entries.append(Entry(file.stem, file, path.parent / picture, _time(second, path)))
    return entries


def _row(parts: list[str], size: int, path: Path) -> list[str]:
    if len(parts) != size:
        expected = "TIMESTAMP FILE" if size == 2 else "TIMESTAMP RGB-FILE TIMESTAMP DEPTH-FILE"
        raise ValueError(f"input: expected lines {expected} in '{path}', got '{brief(' '.join(parts))}'")
    return parts


def _time(text: str, path: Path) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"input: expected a timestamp in seconds in '{path}', got '{brief(text)}'") from None
