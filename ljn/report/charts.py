"""Line charts as inline SVG, coloured by the page's style sheet."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

NUM_COLOURS = 8
_WIDTH, _HEIGHT = 520, 310
_LEFT, _RIGHT, _TOP, _BOTTOM = 54, 14, 14, 46


@dataclass(frozen=True)
class Series:
    """A line of a chart."""

    label: str
    points: tuple[tuple[float, float, float | None], ...]  # x, y, half the length of y's error bar
    colour: int = 0
    is_dashed: bool = False  # then its markers are hollow, too
    has_markers: bool = True

    @property
    def style(self) -> str:
        """Its classes in the style sheet."""
        return f"line c{self.colour % NUM_COLOURS}{' dashed' if self.is_dashed else ''}"


def line_chart(series: Sequence[Series], title: str, x_label: str, y_label: str) -> str:
    """A chart with a legend, as an HTML `figure`; without a finite point, nothing."""
    shown = []
    for line in series:
        finite = (point for point in line.points if math.isfinite(point[0]) and math.isfinite(point[1]))
        if points := sorted(finite, key=lambda point: point[0]):
            shown.append((line, points))
    if not shown:
        return ""
    xs = [float(x) for _, points in shown for x, _, _ in points]
    ys = [y + sign * (error or 0.0) for _, points in shown for _, y, error in points for sign in (-1, 1)]
    y_ticks = _ticks(min(ys), max(ys))
    x_ticks = [
        tick for tick in _ticks(min(xs), max(xs)) if tick.is_integer() or not all(map(float.is_integer, xs))
    ]
    x_low, x_high = min(xs), max(xs)
    if x_low == x_high:
        x_low, x_high = x_low - 0.5, x_high + 0.5
    margin = 0.04 * (x_high - x_low)
    x_low, x_high = x_low - margin, x_high + margin
    y_low, y_high = y_ticks[0], y_ticks[-1]

    def across(x: float) -> float:
        return _LEFT + (x - x_low) / (x_high - x_low) * (_WIDTH - _LEFT - _RIGHT)

    def down(y: float) -> float:
        return _HEIGHT - _BOTTOM - (y - y_low) / (y_high - y_low) * (_HEIGHT - _TOP - _BOTTOM)

    parts = []
    for tick in y_ticks:
        height = down(tick)
        parts.append(f'<path class="grid" d="M{_LEFT} {height:.1f}H{_WIDTH - _RIGHT}"/>')
        parts.append(f'<text x="{_LEFT - 8}" y="{height + 4:.1f}" text-anchor="end">{tick:.6g}</text>')
    for tick in x_ticks:
        if x_low <= tick <= x_high:
            parts.append(
                f'<text x="{across(tick):.1f}" y="{_HEIGHT - _BOTTOM + 18}" text-anchor="middle">{tick:.6g}</text>'
            )
    middle = (_TOP + _HEIGHT - _BOTTOM) / 2
    parts += [
        f'<path class="axis" d="M{_LEFT} {_HEIGHT - _BOTTOM}H{_WIDTH - _RIGHT}"/>',
        f'<text x="{(_LEFT + _WIDTH - _RIGHT) / 2}" y="{_HEIGHT - 6}" text-anchor="middle">{escape(x_label)}</text>',
        f'<text transform="translate(14 {middle}) rotate(-90)" text-anchor="middle">{escape(y_label)}</text>',
    ]
    for line, points in shown:
        parts.append(_draw(line, [(across(x), down(y)) for x, y, _ in points], points, down))
    legend = "".join(f"<li>{_swatch(line)}{escape(line.label)}</li>" for line, _ in shown)
    label = escape(f"{title}: {', '.join(line.label for line, _ in shown)}", quote=True)
    return (
        f'<figure class="chart"><figcaption>{escape(title)}</figcaption>'
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{label}">{"".join(parts)}</svg>'
        f'<ul class="legend">{legend}</ul></figure>'
    )


def _draw(
    line: Series,
    places: Sequence[tuple[float, float]],
    points: Sequence[tuple[float, float, float | None]],
    down: Callable[[float], float],
) -> str:
    parts = []
    if len(places) > 1:
        route = "L".join(f"{x:.1f} {y:.1f}" for x, y in places)
        parts.append(f'<path class="route" d="M{route}"/>')
    for (x, y), (value, height, error) in zip(places, points):
        if error:
            top, bottom = down(height + error), down(height - error)
            bar = f"M{x:.1f} {top:.1f}V{bottom:.1f}M{x - 4:.1f} {top:.1f}h8M{x - 4:.1f} {bottom:.1f}h8"
            parts.append(f'<path class="bar" d="{bar}"/>')
        if line.has_markers or len(places) == 1:
            words = f"{line.label}, {value:.6g}: {height:.1f}" + (f" ± {error:.1f}" if error else "")
            parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4"><title>{escape(words)}</title></circle>')
    return f'<g class="{line.style}">{"".join(parts)}</g>'


def _swatch(line: Series) -> str:
    marker = '<circle cx="13" cy="6" r="3.5"/>' if line.has_markers else ""
    return (
        f'<svg class="swatch" viewBox="0 0 26 12" aria-hidden="true"><g class="{line.style}">'
        f'<path class="route" d="M1 6H25"/>{marker}</g></svg>'
    )


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers, about five, from at or below `low` to at or above `high`."""
    if low == high:
        low, high = low - 0.5, high + 0.5
    rough = (high - low) / 4
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1, 2, 2.5, 5, 10) if factor * power >= rough * 0.999)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(number * step, 10) for number in range(first, last + 1)]
