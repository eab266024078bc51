"""The style of all pictures: colours that colour-blind people can tell apart, equal axes, pictures embedded in the page."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends import base
from hybridmap.geometry import Array
from hybridmap.report.outline import Raster

TRUTH, ODOMETRY, PRIMARY = "#000000", "#d55e00", "#0072b2"
OTHERS = ("#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#7f6000", "#5b3a8e")
ACCEPTED, UNWEIGHTED, PENDING, REJECTED = "#009e73", "#cc79a7", "#e69f00", "#d55e00"
Margins = tuple[float, float, float, float]
"""Left, right, bottom and top of the axes, as shares of the figure."""

PAGE_WIDTH_IN = 9.6
_MAX_POINTS = 2500
_SETTINGS = {
    "font.size": 9.0,
    "font.family": "sans-serif",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#666666",
    "axes.labelcolor": "#222222",
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "grid.color": "#e4e4e4",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "svg.hashsalt": "hybridmap",
    "svg.fonttype": "path",
    "path.simplify": True,
    "path.simplify_threshold": 0.3,
}


def line_styles(backends: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Back-end -> style of its line (arguments of matplotlib). The first one that is not `odometry` looks like the primary."""
    styles: dict[str, dict[str, Any]] = {}
    others = [name for name in backends if name != base.ODOMETRY]
    dashes = ((0, (4, 1.2)), (0, (6, 1.2, 1, 1.2)), (0, (1.2, 1.2)))
    for rank, name in enumerate(others):
        if rank == 0:
            styles[name] = {"color": PRIMARY, "linewidth": 1.8, "zorder": 6}
        else:
            styles[name] = {
                "color": OTHERS[(rank - 1) % len(OTHERS)],
                "linewidth": 1.3,
                "linestyle": dashes[(rank - 1) % len(dashes)],
                "zorder": 5,
            }
    styles[base.ODOMETRY] = {"color": ODOMETRY, "linewidth": 1.2, "linestyle": (0, (1, 1)), "zorder": 4}
    return styles


@contextmanager
def figure(width_in: float, height_in: float, margins: Margins | None = None) -> Iterator[Any]:
    """Create a matplotlib figure in the page's style, without a window and without global state.

    Args:
        width_in, height_in: size, inches.
        margins: where the axes begin and end, as shares of the figure; computed if None, which is slow.

    Yields:
        The `matplotlib.figure.Figure`, without axes.
    """
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_SETTINGS):
        picture = Figure(figsize=(width_in, height_in), layout="constrained" if margins is None else None)
        if margins is not None:
            left, right, bottom, top = margins
            picture.subplots_adjust(left=left, right=right, bottom=bottom, top=top)
        yield picture


def svg_uri(picture: Any) -> str:
    """The figure as SVG in a `data:` URI; the same figure gives the same text."""
    _take_literally(picture)
    text = io.BytesIO()
    picture.savefig(text, format="svg", dpi=160, metadata={"Date": None, "Creator": None})
    return "data:image/svg+xml;base64," + base64.b64encode(text.getvalue()).decode("ascii")


def _take_literally(picture: Any) -> None:
    """Show the dollars of names and titles as they are; matplotlib would read what stands between two of them as a formula."""
    from matplotlib.text import Text

    for text in picture.findobj(Text):
        if "$" in text.get_text() and not _POWER_OF_TEN.fullmatch(text.get_text()):
            text.set_parse_math(False)


_POWER_OF_TEN = re.compile(r"\$\\mathdefault\{[-−]?10\^\{[-−]?\d+\}\}\$")  # matplotlib's own labels of a logarithmic axis


def photo_uri(rgb: NDArray[np.uint8]) -> str:
    """A colour picture (H, W, 3) uint8 RGB as JPEG in a `data:` URI."""
    import cv2

    _, data = cv2.imencode(".jpg", np.ascontiguousarray(rgb[:, :, ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 88])
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")


def thinned(poses: Array) -> Array:
    """Evenly spaced poses of a trajectory (P, 3), the last one included: at most a few thousand, as a picture shows no more."""
    step = max(1, len(poses) // _MAX_POINTS)
    return poses if step == 1 else np.concatenate([poses[:-1:step], poses[-1:]])


def draw_building(axes: Any, building: Raster | None, darkness: float = 0.55) -> None:
    """Draw the picture of the building in grey, below everything; nothing if it is None. `darkness`: 0 is white, 1 black."""
    if building is None:
        return
    seen = np.ma.masked_equal(building.grey, 0.0) * darkness
    looks = {"cmap": "Greys", "vmin": 0.0, "vmax": 1.0, "interpolation": "antialiased", "zorder": 1}
    axes.imshow(seen, origin="lower", extent=building.extent, **looks)


def metric_axes(axes: Any, adjustable: str = "datalim") -> None:
    """Give matplotlib axes equal scales in metres; `adjustable` is what gives way, the limits (`datalim`) or the `box`."""
    axes.set_aspect("equal", adjustable=adjustable)
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.grid(True, linewidth=0.5)
    axes.set_axisbelow(True)


def fitted_size(span_m: Array, panels: int = 1) -> tuple[float, float]:
    """Size of a figure for a map: as wide as the page, and as high as the map needs, within limits.

    Args:
        span_m: (2,) width and height that each panel shows, m.
        panels: number of panels side by side.

    Returns:
        Width and height, inches.
    """
    shape = max(float(span_m[1]), 0.5) / max(float(span_m[0]), 0.5)
    return PAGE_WIDTH_IN, float(np.clip(PAGE_WIDTH_IN / panels * shape + 1.1, 2.6, 8.5))
