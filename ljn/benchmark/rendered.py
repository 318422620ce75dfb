"""The benchmark on rendered samples: the base condition, its groups, and one axis after another."""

from collections.abc import Callable, Sequence

import numpy as np

from ljn.benchmark.conditions import AXES, BASE, Condition, sensor_axis, steps_of
from ljn.benchmark.frames import BenchSamples
from ljn.benchmark.measures import Errors, measure
from ljn.benchmark.outcome import Outcome
from ljn.benchmark.predictors import Entrant
from ljn.benchmark.sections import (
    BASE_AXIS,
    BASES,
    FAILED,
    Measured,
    axis_section,
    base_section,
    describe,
    details_section,
    group_rows,
    group_section,
    result_row,
    sample_rows,
)
from ljn.benchmark.store import Store

BATCH = 40
_MEASURES_VERSION = 1
"""Raised with every change of what is measured."""


class RenderedBenchmark:
    """Predictors on fixed samples.

    Args:
        samples: The samples.
        num_samples: The first so many of them; None: all.
        num_axis: How many of them, the first, each condition of an axis is measured on.
        axes: Names of the axes to measure; None: all.

    Raises:
        ValueError: There is no such axis, or `num_axis` is no number of samples.
    """

    def __init__(
        self,
        samples: BenchSamples,
        num_samples: int | None = None,
        num_axis: int = 500,
        axes: Sequence[str] | None = None,
    ) -> None:
        if not isinstance(num_axis, int) or num_axis < 1:
            raise ValueError(f"bench.num_axis: expected a whole number of 1 or more, got {num_axis!r}")
        known = {axis.name: axis for axis in (*AXES, sensor_axis(samples.sensors))}
        if not samples.sensors:
            del known["sensor"]
        if unknown := set(axes or ()) - set(known):
            raise ValueError(
                f"bench.axes: expected some of {', '.join(known)}, got {', '.join(sorted(unknown))}"
            )
        self.samples = samples if num_samples is None else samples.first(num_samples)
        self.num_axis = num_axis
        self.axes = [axis for name, axis in known.items() if axes is None or name in axes]

    def run(self, entrants: Sequence[Entrant], store: Store, tick: Callable[[str], None]) -> Outcome:
        """Measure all, each condition written into `store` as it comes.

        Args:
            entrants: What is measured. One that fails under the base condition is measured no further; all others go
                on.
            store: Where results are kept.
            tick: Called with a few words before each condition.
        """
        num_axis = min(self.num_axis, len(self.samples))
        bases = steps_of(BASE_AXIS)
        steps = [step for axis in self.axes for step in steps_of(axis)]
        measured: list[Measured] = []
        failures: list[str] = []
        for entrant in entrants:
            has_failed = False
            for step in [*bases, *steps]:
                num = len(self.samples) if step.axis is BASE_AXIS else num_axis
                errors, status = None, entrant.skips(step.axis.reads, step.condition.has_keypoints)
                if not status and has_failed:
                    status = "not measured"
                elif not status:
                    tick(f"{entrant.name}: {describe(step)}")
                    try:
                        errors = self._errors(entrant, step.condition, num, store)
                    except ValueError as error:
                        status, has_failed = FAILED, has_failed or step.axis is BASE_AXIS
                        failures.append(f"{describe(step)}: {error}")
                measured.append(Measured(entrant, step, errors, status))
        return self._outcome(entrants, measured, failures, num_axis)

    def _errors(self, entrant: Entrant, condition: Condition, num: int, store: Store) -> Errors:
        """The errors of the first samples, from `store` where they are there."""
        identity = {
            "samples": self.samples.identity(condition),
            "predictor": entrant.fingerprint,
            "measures": _MEASURES_VERSION,
        }
        if (kept := store.get(identity, num)) is not None:
            return kept
        parts: list[dict[str, np.ndarray]] = []
        for start in range(0, num, BATCH):
            numbers = range(start, min(start + BATCH, num))
            found = entrant(self.samples.frames(numbers, condition), numbers)
            try:
                parts.append(measure(found, self.samples.truth(numbers)))
            except ValueError as error:
                raise ValueError(f"predictor '{entrant.name}', sample {numbers[0]}: {error}") from error
        if len({frozenset(part) for part in parts}) > 1:
            raise ValueError(f"predictor '{entrant.name}': gives vertices of some samples and of others none")
        errors = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        store.put(identity, errors)
        return errors

    def _outcome(
        self, entrants: Sequence[Entrant], measured: list[Measured], failures: list[str], num_axis: int
    ) -> Outcome:
        bases = [each for each in measured if each.step.axis is BASE_AXIS]
        groups = group_rows(self.samples, bases)
        rows = [result_row(each) for each in measured] + [row for _, _, rows in groups for row in rows]
        sections = [base_section(bases, len(self.samples))]
        for axis in self.axes:
            of_axis = [each for each in measured if each.step.axis is axis]
            if any(each.errors is not None or each.status == FAILED for each in of_axis):
                sections.append(axis_section(axis, of_axis, num_axis))
            else:
                sections[0].notes.append(f"Axis left out, which no predictor reads: {axis.label}.")
        sections += [group_section(name, label, of_group) for name, label, of_group in groups]
        sections.append(details_section(bases))
        metrics = {
            f"benchmark/{each.entrant.name} ({BASES[each.step.with_keypoints]})": float(
                each.errors["mpjpe"].mean()
            )
            for each in bases
            if each.errors is not None
        }
        identity = {
            "samples": self.samples.identity(BASE),
            "num_axis": num_axis,
            "axes": [axis.name for axis in self.axes],
        }
        return Outcome(
            self.samples.name,
            identity,
            {**self.samples.facts, "samples of an axis": num_axis},
            sections,
            rows,
            sample_rows(measured),
            failures,
            metrics,
        )
