"""The benchmark's samples: a fixed table of bodies before cameras, and what each condition makes visible of them."""

from datamodules.bench.samples import BenchSamples

__all__ = ["BenchSamples"]
