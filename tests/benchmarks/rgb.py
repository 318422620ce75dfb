"""What colour crops cost, and what they look like: the table and the picture of docs/rgb.md.

    python -m tests.benchmarks.rgb                               # table
    python -m tests.benchmarks.rgb --pictures docs/rgb.png       # the picture

Rates are of one thread's processor time, so that a busy machine changes them little: each row makes four batches of 16
in each round; medians over rounds, and of the ratios within a round.
"""

import argparse
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from PIL import Image, ImageDraw, ImageFont

from datamodules.rendered import RenderedDataModule
from ljn.building import build
from ljn.tasks.schema import register

CONF = Path(__file__).parents[2] / "conf"
BATCH, BATCHES, ROUNDS = 16, 4, 9
COLUMNS, SEED, LABEL, BIG = 8, 3, 18, ("data.recipe.height_px=256", "data.recipe.width_px=192")
DEPTH = "depth crops, 128 x 128"
RATED = {
    DEPTH: ("experiment=detector/cascade",),
    "`black`": ("data=rgb",),
    "`random`": ("data=rgb", "data.background.kind=random"),
    "`green`": ("data=rgb", "data.background.kind=green"),
    "`black`, `data/photo=plain`": ("data=rgb", "data/photo=plain"),
    "`black`, 256 x 192": ("data=rgb", *BIG),
}
PICTURED = {
    "training, background black": (4, "train", ()),
    "test, background black": (1, "test", ()),
    "test, background random": (1, "test", ("data.background.kind=random",)),
    "test, background green": (1, "test", ("data.background.kind=green",)),
    "test, data/photo=plain": (1, "test", ("data/photo=plain",)),
}


def data_module(overrides: tuple[str, ...]) -> RenderedDataModule:
    """A data module of few samples."""
    sizes = [f"data.num_{split}={COLUMNS * 4}" for split in ("train", "val", "test")]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return build(compose("config", [*overrides, *sizes, "data.num_workers=0"]).data)


def print_rates() -> None:
    """Samples a second."""
    makers: dict[str, Any] = {}
    for name, overrides in RATED.items():
        data = data_module(overrides)
        data.takes = ("crop", "crop_camera") if name == DEPTH else ("rgb",)
        makers[name] = data._synthesizer("train")
    found: dict[str, list[float]] = {name: [] for name in makers}
    for epoch in range(-1, ROUNDS):
        for name, maker in makers.items():
            start = time.thread_time()
            for number in range(BATCHES):
                maker.batch([(BATCHES * (epoch + 1) + number, index) for index in range(BATCH)])
            if epoch >= 0:  # the first round compiles
                found[name].append(1000 * (time.thread_time() - start) / (BATCHES * BATCH))
    print("| samples | ms | samples/s | of depth's |\n| --- | ---: | ---: | ---: |")
    for name, own in found.items():
        ms = statistics.median(own)
        ratio = statistics.median(depth / mine for depth, mine in zip(found[DEPTH], own))
        print(f"| {name} | {ms:.1f} | {1000 / ms:.0f} | {100 * ratio:.0f} % |")


def draw() -> Image.Image:
    """A page with a block of rows of crops for each entry of `PICTURED`."""
    blocks = []
    for name, (rows, split, overrides) in PICTURED.items():
        data = data_module(("data=rgb", f"seed={SEED}", f"data.eval_seed={SEED}", *overrides))
        crops = data.examples(split, range(rows * COLUMNS))[1].numpy()
        channels, height, width = crops.shape[1:]
        sheet = crops.reshape(rows, COLUMNS, channels, height, width).transpose(0, 3, 1, 4, 2)
        sheet = sheet.reshape(rows * height, COLUMNS * width, channels)
        label = Image.new("RGB", (sheet.shape[1], LABEL), "white")
        ImageDraw.Draw(label).text((4, 2), name, fill="black", font=ImageFont.load_default(12))
        blocks += [np.asarray(label), sheet]
    return Image.fromarray(
        np.concatenate(blocks)
    )  # in all its colours: fewer would look like faults of the crops


def main() -> None:
    """Print the table, or draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--pictures", type=Path, metavar="FILE.png")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    register()
    if arguments.pictures:
        draw().save(arguments.pictures, optimize=True)
    else:
        print_rates()


if __name__ == "__main__":
    main()
