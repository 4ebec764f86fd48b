"""Small charts as SVG, of figures that have an `at`: medians, with lines from least to most."""

from collections.abc import Sequence
from html import escape
from itertools import pairwise

from benchmarks.rounds import OURS, Figure

WIDTH, HEIGHT, LEFT, BOTTOM, TOP, RIGHT = 720, 320, 56, 40, 36, 170
COLOURS = ("#c2410c", "#1d4ed8", "#0e7490", "#4d7c0f", "#7e22ce", "#a16207", "#6b7280")
"""Ours first."""
STYLE = "font-family:sans-serif;font-size:12px;fill:#444"


def text(x: float, y: float, words: str, anchor: str = "start") -> str:
    """Words at a place."""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(words)}</text>'


def line(x1: float, y1: float, x2: float, y2: float, colour: str, width: float = 1) -> str:
    """A line from one place to another."""
    where = f'x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"'
    return f'<line {where} stroke="{colour}" stroke-width="{width}"/>'


def names_of(figures: Sequence[Figure]) -> list[str]:
    """All contestants, ours first."""
    names = dict.fromkeys(name for figure in figures for name in figure.values)
    return sorted(names, key=lambda name: name != OURS)


def ceiling(figures: Sequence[Figure]) -> float:
    """The end of the axis: 1, 2 or 5 times a power of ten."""
    most = max(max(found) for figure in figures for found in figure.values.values())
    power = 10.0 ** (len(str(int(most))) - 1)
    return next(step * power for step in (1, 2, 3, 5, 7.5, 10) if step * power >= most)


def height_of(value: float, top: float) -> float:
    """Where a value is, from above."""
    return HEIGHT - BOTTOM - value / top * (HEIGHT - BOTTOM - TOP)


def frame(title: str, figures: Sequence[Figure], top: float) -> list[str]:
    """Title, axis and legend."""
    drawn = [text(LEFT, 20, f"{title}, {figures[0].unit}")]
    for step in range(5):
        y = height_of(top * step / 4, top)
        drawn.append(line(LEFT, y, WIDTH - RIGHT, y, "#ddd"))
        drawn.append(text(LEFT - 6, y + 4, f"{top * step / 4:g}", "end"))
    for place, name in enumerate(names_of(figures)):
        x, y = WIDTH - RIGHT + 16, TOP + 8 + 18 * place
        drawn.append(line(x, y - 4, x + 14, y - 4, COLOURS[place], 4))
        drawn.append(text(x + 20, y, name))
    return drawn


def document(drawn: Sequence[str]) -> str:
    """A whole file."""
    size = f'width="{WIDTH}" height="{HEIGHT}" viewBox="0 0 {WIDTH} {HEIGHT}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} style="{STYLE}">'
    background = f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>'
    return "\n".join((head, background, *drawn, "</svg>\n"))


def bar_chart(title: str, figures: Sequence[Figure]) -> str:
    """A group of bars for each figure."""
    names, top = names_of(figures), ceiling(figures)
    drawn = frame(title, figures, top)
    group = (WIDTH - RIGHT - LEFT) / len(figures)
    for number, figure in enumerate(figures):
        drawn.append(text(LEFT + group * (number + 0.5), HEIGHT - 16, f"{figure.at}", "middle"))
        width = group * 0.8 / len(names)
        for place, name in enumerate(name for name in names if name in figure.values):
            x = LEFT + group * (number + 0.1) + width * (place + 0.5)
            colour = COLOURS[names.index(name)]
            middle = height_of(figure.median(name), top)
            drawn.append(line(x, HEIGHT - BOTTOM, x, middle, colour, width * 0.8))
            drawn.append(spread(figure, name, x, top))
    return document(drawn)


def line_chart(title: str, figures: Sequence[Figure]) -> str:
    """A curve for each contestant; the figures are at even distances."""
    names, top = names_of(figures), ceiling(figures)
    drawn = frame(title, figures, top)
    step = (WIDTH - RIGHT - LEFT) / len(figures)
    xs = [LEFT + step * (number + 0.5) for number in range(len(figures))]
    drawn += [text(x, HEIGHT - 16, f"{f.at}", "middle") for x, f in zip(xs, figures, strict=True)]
    for name, colour in zip(names, COLOURS, strict=False):
        points = [(x, f) for x, f in zip(xs, figures, strict=True) if name in f.values]
        ends = [(x, height_of(figure.median(name), top)) for x, figure in points]
        pairs = pairwise(ends)
        drawn += [line(*one, *other, colour, 2) for one, other in pairs]
        drawn += [spread(figure, name, x, top) for x, figure in points]
    return document(drawn)


def spread(figure: Figure, name: str, x: float, top: float) -> str:
    """From the least to the most."""
    found = figure.values[name]
    return line(x, height_of(min(found), top), x, height_of(max(found), top), "#111")
