"""How diagrams are made and kept: their size, type and grid; matplotlib without a display.

Owns matplotlib's settings. What is drawn is in the files named `plots`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.io.files import replacing
from pipelines.types import Array

WIDTH_IN = 9.0  # a page shows diagrams 900 pixels wide: 100 to the inch, and text is judged so
DPI = 150  # finer than the page, for dense screens and print

SETTINGS = {
    "font.size": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "axes.axisbelow": True,
    "axes.titlesize": 12,
    "legend.framealpha": 0.9,
    "legend.edgecolor": "none",
    "figure.dpi": DPI,
    "savefig.dpi": DPI,
}


@contextmanager
def new_figure(height_in: float = 5.2) -> Iterator[Any]:
    """An empty figure to draw on within the block; no global state of matplotlib is touched."""
    import matplotlib as mpl

    with mpl.rc_context(SETTINGS):
        yield _figure_class()(figsize=(WIDTH_IN, height_in), layout="constrained")


def save_figure(figure: Any, path: Path) -> None:
    """Write a figure as a picture, whole or not at all. Raises DyObError where the disk refuses."""
    with replacing(path) as fresh:
        figure.savefig(fresh, dpi=DPI)


@cache
def _figure_class() -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    class Diagram(Figure):
        """A figure that shows itself in a notebook, with or without pyplot's inline mode."""

        def __init__(self, **settings: Any) -> None:
            super().__init__(**settings)
            FigureCanvasAgg(self)

        def _repr_png_(self) -> bytes:
            from io import BytesIO

            picture = BytesIO()
            self.savefig(picture, format="png", dpi=DPI)
            return picture.getvalue()

    return Diagram


def metric_unit(values_m: Array) -> tuple[float, str]:
    """Factor and name of the unit that suits the largest of some lengths in metres."""
    largest = float(np.nanmax(values_m, initial=0.0))
    if largest < 0.01:
        return 1000.0, "mm"
    return (100.0, "cm") if largest < 1.0 else (1.0, "m")


def digits(value: float) -> str:
    """A positive number with three digits that count, never as a power of ten."""
    power = int(np.floor(np.log10(value))) if value > 0 else 0
    return f"{value:.{int(np.clip(2 - power, 0, 6))}f}"


def two_digits(value: float) -> str:
    """A number beside a bar: two digits that count."""
    return f"{value:.0f}" if value >= 9.95 else f"{value:#.2g}"


def whole_ticks(axis: Any) -> None:
    """Ticks at whole numbers alone, of frames or runs."""
    from matplotlib.ticker import MaxNLocator

    axis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1, steps=[1, 2, 5, 10]))
