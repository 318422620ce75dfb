"""`python -m ljn.body.build`: builds the embedded bodies, prints their measurements, draws them."""

import argparse
import time
from pathlib import Path

import ljn.body.files
from ljn.body.build.bodies import build_body, read_source, save_body
from ljn.body.build.measures import report
from ljn.body.build.requirements import find_makehuman
from ljn.body.files import GENDERS, load_body_model


def main() -> None:
    """Runs the command line."""
    shipped = Path(ljn.body.files.__file__).parent / "data"
    parser = argparse.ArgumentParser(prog="python -m ljn.body.build", description=__doc__)
    parser.add_argument("--gender", choices=[*GENDERS, "all"], default="all")
    parser.add_argument(
        "--output", type=Path, default=shipped, metavar="DIR", help="default: the shipped folder"
    )
    parser.add_argument("--pictures", type=Path, metavar="FILE.png", help="also draw a page of the bodies")
    parser.add_argument("--seed", type=int, default=0, help="of the sampled adults and poses")
    parser.add_argument(
        "--measure-only",
        action="store_true",
        help="build nothing: measure and draw what the output folder holds",
    )
    arguments = parser.parse_args()

    genders = list(GENDERS) if arguments.gender == "all" else [arguments.gender]
    paths = {gender: arguments.output / f"{gender}.npz" for gender in genders}
    start = time.perf_counter()
    if not arguments.measure_only:
        source = read_source(find_makehuman())
        print(f"source read and decimated: {time.perf_counter() - start:.0f} s")
        for gender, path in paths.items():
            save_body(build_body(source, gender, arguments.seed), path)
            print(f"{path}: {path.stat().st_size / 1e6:.2f} MB, {time.perf_counter() - start:.0f} s")
    models = [load_body_model(path, gender) for gender, path in paths.items()]
    for model in models:
        print(report(model))
    if arguments.pictures is not None:
        from ljn.body.build.pictures import draw_page

        draw_page(models, arguments.pictures)
        print(f"{arguments.pictures}: {arguments.pictures.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
