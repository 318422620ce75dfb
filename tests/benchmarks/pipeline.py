"""How fast samples are made and a detector trains: `make bench`.

One table from one run; ratios of speed are against the first row of each block. Whole samples come from two worker
processes, everything else from one thread; medians.
"""

import statistics
import time
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from datamodules.sources.embedded import EmbeddedSource
from datamodules.synthesis import DepthSynthesizer, SynthesisSettings
from datamodules.synthetic import SynthesizedSamples
from ljn.body import SMPL, SMPLOutput, load_body_models
from ljn.cloud.normals import get_normal_estimator
from ljn.cloud.sampling import add_depth_noise, sample_cloud
from ljn.geometry.camera import Camera
from ljn.geometry.rotations import CAMERA_FROM_BODY
from ljn.nets.joint_network import LocalJointNetwork
from ljn.nets.layers import StackedLinear, StackedPReLU
from ljn.render import get_renderer

CAMERA = Camera(fx=366.458, fy=366.736, cx=206.470, cy=253.026, width=424, height=512)
BATCH, NUM_POINTS, REPEATS = 16, 4096, 15
ROUNDS, BATCHES, WARM_UP = 3, 16, 6
"""Of the whole samples: each row is timed in turn, over so many batches, after the workers' first ones."""


def median_ms(call: Callable[[], object], per: int = BATCH) -> float:
    """Median milliseconds of a call, divided by the samples that it handles; after one that does not count."""
    call()
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return 1000 * statistics.median(times) / per


def print_rows(title: str, ms_per_sample: dict[str, float]) -> None:
    """A block of the table: each row beside how many times faster than it the first row is."""
    print(f"\n{title:48s}{'ms/sample':>10s}{'samples/s':>11s}{'first is':>10s}", flush=True)
    first = next(iter(ms_per_sample.values()))
    for name, value in ms_per_sample.items():
        print(f"  {name:46s}{value:10.2f}{1000 / value:11.0f}{value / first:9.2f}x", flush=True)


def time_rows(title: str, rows: dict[str, Callable[[], object]]) -> None:
    """Time each row and print them."""
    print_rows(title, {name: median_ms(call) for name, call in rows.items()})


class OfPosedBodies(DepthSynthesizer):
    """A synthesizer whose bodies were posed before the clock runs: the same few for every batch."""

    @cached_property
    def _smpl(self) -> Any:
        return PosedBodies(SMPL(self.bodies), self.records)


class PosedBodies:
    """Answers like the SMPL layer, with the first bodies of a table of records."""

    def __init__(self, layer: SMPL, records: Any) -> None:
        columns = (records.pose[:BATCH], records.betas[:BATCH], records.gender[:BATCH])
        self.faces = layer.faces
        self.posed = layer(*map(torch.from_numpy, columns))

    def __call__(self, pose: Tensor, betas: Tensor, gender: Tensor) -> SMPLOutput:
        return self.posed


def time_loaders(title: str, synthesizers: dict[str, DepthSynthesizer]) -> None:
    """Time whole samples as they come from two workers, the rows in turn, and print them."""
    batches = [list(range(BATCH))] * (WARM_UP + BATCHES)
    keys = [[(0, index) for index in batch] for batch in batches]
    found: dict[str, list[float]] = {name: [] for name in synthesizers}
    for _ in range(ROUNDS):
        for name, synthesizer in synthesizers.items():
            uses_gl = synthesizer.settings.renderer == "pyrender"
            loader = DataLoader(
                SynthesizedSamples(synthesizer),
                batch_sampler=keys,
                collate_fn=_as_is,
                num_workers=2,
                prefetch_factor=1,  # nothing is ready in advance when the clock starts
                multiprocessing_context="spawn" if uses_gl else "fork",
            )
            arriving: Iterator[object] = iter(loader)
            for _ in range(WARM_UP):
                next(arriving)
            start = time.perf_counter()
            for _ in range(BATCHES):
                next(arriving)
            found[name].append(1000 * (time.perf_counter() - start) / (BATCHES * BATCH))
            del arriving
    print_rows(title, {name: statistics.median(values) for name, values in found.items()})


def _as_is(batch: Any) -> Any:
    return batch


def as_loop(net: LocalJointNetwork) -> LocalJointNetwork:
    """The same network, its stacked layers run as a loop over the joints: the reference."""

    def linear(layer: StackedLinear) -> Callable[[Tensor], Tensor]:
        return lambda x: torch.stack(
            [torch.nn.functional.linear(*slices) for slices in zip(x, layer.weight, layer.bias)]
        )

    def prelu(layer: StackedPReLU) -> Callable[[Tensor], Tensor]:
        return lambda x: torch.stack(
            [torch.nn.functional.prelu(part, slope[None]) for part, slope in zip(x, layer.weight)]
        )

    for layer in net.modules():
        if isinstance(layer, StackedLinear):
            layer.forward = linear(layer)  # type: ignore[method-assign]
        elif isinstance(layer, StackedPReLU):
            layer.forward = prelu(layer)  # type: ignore[method-assign]
    return net


def available(names: tuple[str, ...], make: Callable[[str], object]) -> list[str]:
    """Those of the names whose packages are installed."""
    kept = []
    for name in names:
        try:
            make(name)
            kept.append(name)
        except ImportError as error:
            print(f"without {name}: {error}")
    return kept


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    renderers = available(("zbuffer", "torch", "pyrender", "open3d"), get_renderer)
    estimators = available(("window", "knn", "open3d"), get_normal_estimator)

    source = EmbeddedSource()
    bodies = load_body_models(None, source.genders)
    records = source.records("train", 256, seed=0)
    columns = [torch.from_numpy(c[:BATCH]) for c in (records.pose, records.betas, records.gender)]

    # First, while this process has neither a GL context nor Open3D's threads: the workers are forked from it.
    combinations = [
        (renderer, normals)
        for renderer, normals in (
            ("zbuffer", "window"),
            ("zbuffer", "knn"),
            ("zbuffer", "open3d"),
            ("pyrender", "open3d"),
        )
        if renderer in renderers and normals in estimators
    ]
    for title, kind in (("with the body", DepthSynthesizer), ("without the body", OfPosedBodies)):
        time_loaders(
            f"whole samples {title}, {NUM_POINTS} points, 2 workers",
            {
                f"{renderer} + {normals} normals": kind(
                    records,
                    bodies,
                    SynthesisSettings(CAMERA, NUM_POINTS, renderer=renderer, normals=normals),
                    (0, 0),
                )
                for renderer, normals in combinations
            },
        )

    smpl = SMPL(bodies)
    with torch.no_grad():
        vertices = smpl(*columns).vertices @ CAMERA_FROM_BODY.float().T
    vertices = vertices - vertices.mean(1, keepdim=True) + torch.tensor([0.0, 0, 2.2])
    render = {name: get_renderer(name) for name in renderers}
    time_rows(
        "depth of posed bodies, 424 x 512",
        {name: lambda r=r: r(vertices, smpl.faces, CAMERA) for name, r in render.items()},  # type: ignore[misc]
    )

    depth = [
        add_depth_noise(image, 0.001, np.random.default_rng(0))
        for image in render["zbuffer"](vertices, smpl.faces, CAMERA).numpy()
    ]
    clouds = [sample_cloud(image, CAMERA, NUM_POINTS, np.random.default_rng(0)) for image in depth]
    estimate = {name: get_normal_estimator(name) for name in estimators}
    time_rows(
        f"normals of {NUM_POINTS} points",
        {
            name: lambda e=e: [e(cloud, image, CAMERA) for cloud, image in zip(clouds, depth)]  # type: ignore[misc]
            for name, e in estimate.items()
        },
    )
    with torch.no_grad():
        time_rows("the body alone", {f"SMPL layer, two genders, batch {BATCH}": lambda: smpl(*columns)})

    points, joints = torch.randn(BATCH, 1024, 6) * 0.3, torch.randn(BATCH, 24, 3) * 0.3
    sizes = {
        "group_size": 64,
        "local_channels": (32, 32),
        "global_channels": (32, 64, 128),
        "group_channels": (32, 64, 128),
        "head_channels": (128, 64),
    }
    networks = {
        "stacked over the joints": LocalJointNetwork([0.25] * 24, **sizes),  # type: ignore[arg-type]
        "a loop over the joints": as_loop(LocalJointNetwork([0.25] * 24, **sizes)),  # type: ignore[arg-type]
    }

    def step(net: LocalJointNetwork) -> None:
        net.zero_grad()
        net(points, joints).square().sum().backward()

    time_rows(
        "a training step of LJN_jd, preset=small",
        {name: lambda n=net: step(n) for name, net in networks.items()},  # type: ignore[misc]
    )


if __name__ == "__main__":
    main()
