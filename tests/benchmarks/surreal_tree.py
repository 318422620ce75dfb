"""The thesis's protocol on a synthetic SURREAL tree of thousands of clips: `python -m tests.benchmarks.surreal_tree`.

A tree of `--clips` training clips (and a quarter as many of test) of random poses, of `--frames` frames at most, some
too short, some damaged, compressed as SURREAL's own, is written into a temporary folder. Printed are the index's time
and size, also cut off half-way and taken up again; the records' counts, time and hash over two runs; whether subjects
are disjoint; and the largest memory of the process.
"""

import argparse
import logging
import resource
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import scipy.io

from datamodules.sources import SPLITS
from datamodules.sources.surreal import SurrealSource
from datamodules.sources.surreal.index import ClipEntry

CLIPS_PER_SEQUENCE = 20
SIZES = {"train": 60_000, "val": 5_000, "test": 15_000}


@contextmanager
def timed(what: str) -> Iterator[None]:
    """Print what took how long, and the largest memory so far."""
    start = time.perf_counter()
    yield
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{what:55s}{time.perf_counter() - start:8.1f} s, at most {memory:.0f} MB")


def write_tree(root: Path, num_clips: int, num_frames: int) -> None:
    """A tree; every 50th clip has five frames, every 97th is cut off."""
    rng = np.random.default_rng(0)
    for split, share, first in (("train", 1, 20), ("test", 4, 220), ("val", 40, 220)):
        for number in range(num_clips // share):
            nth, clip = divmod(number, CLIPS_PER_SEQUENCE)
            sequence = f"{first + nth % 100}_{1 + nth // 100:02d}"
            frames = 5 if number % 50 == 49 else int(rng.integers(6, num_frames + 1))
            fields = {
                "pose": rng.standard_normal((72, frames), np.float32),
                "shape": np.repeat(rng.standard_normal((10, 1), np.float32), frames, 1),
                "gender": np.full((frames, 1), number % 2, np.uint8),
                "joints2D": np.zeros((2, 24, frames), np.float32),
                "joints3D": np.zeros((3, 24, frames), np.float32),
            }
            path = root / "cmu" / split / "run0" / sequence / f"{sequence}_c{clip + 1:04d}_info.mat"
            path.parent.mkdir(parents=True, exist_ok=True)
            scipy.io.savemat(path, fields, do_compression=True)
            if number % 97 == 96:
                path.write_bytes(path.read_bytes()[:1000])


def main() -> None:
    """Write the tree, index it, draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--clips", type=int, default=4_000)
    parser.add_argument("--frames", type=int, default=100)
    arguments = parser.parse_args()
    logging.disable(logging.WARNING)  # names of damaged files
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        with timed(f"writing {arguments.clips} clips of training"):
            write_tree(root, arguments.clips, arguments.frames)
        source = made(root)
        with timed("index"):
            source.check()
        [index] = (root / "cache").glob("*.jsonl")
        content = index.read_bytes()
        print(f"{len(source.entries)} files, index of {len(content) / 2**20:.2f} MiB")
        index.write_bytes(content[: len(content) // 2])
        again = made(root)
        with timed("index, half of it there"):
            again.check()
        assert again.entries == source.entries
        with timed("index, all of it there"):
            made(root).check()
        draw(root, source)


def made(root: Path) -> SurrealSource:
    """A new source of the tree, with its cache."""
    source = SurrealSource(root)
    source.cache_dir = root / "cache"
    return source


def draw(root: Path, source: SurrealSource) -> None:
    """Draw all splits, twice; print counts; raise where a rule is broken."""
    subjects: dict[str, set[str]] = {}
    for split in SPLITS:
        number = min(SIZES[split], source.motion(split)["frames"])
        with timed(f"{number} records of {split}"):
            records = source.records(split, number, 0)
        assert made(root).records(split, number, 0).hash == records.hash
        least = np.unique(records.sequence, return_counts=True)[1].min()
        assert least >= 3
        assert len(set(zip(records.sequence.tolist(), records.frame.tolist()))) == number
        subjects[split] = {ClipEntry(name).subject for name in records.sequence.tolist()}
        print(f"  {source.motion(split)}; at least {least} of a clip; hash {records.hash}, twice")
    assert not subjects["train"] & (subjects["val"] | subjects["test"])
    print(f"subjects of training and test are disjoint: {len(subjects['train'])} and {len(subjects['test'])}")


if __name__ == "__main__":
    main()
