"""Make the benchmark's definition, which is a file of the repository, again.

python -m datamodules.bench                 writes datamodules/bench/data/ljn_bench_1.npz
python -m datamodules.bench --output FILE   writes it elsewhere
"""

import argparse
from pathlib import Path

from datamodules.bench.definition import NUM_SAMPLES, PATH, make_definition, write_definition


def main() -> None:
    """Make, write, and print the hash."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, default=PATH)
    path = parser.parse_args().output
    definition = make_definition(NUM_SAMPLES)
    write_definition(definition, path)
    print(f"{path}: {len(definition)} samples, {path.stat().st_size} bytes, hash {definition.hash}")


if __name__ == "__main__":
    main()
