"""How every picture of the page looks: colours that colour-blind people can tell apart, equal axes, embedded as text."""

from __future__ import annotations

import base64
import io
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
    """Name -> how its line is drawn; `backends` begins with `odometry` and the primary, as a scene's do."""
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
    """A matplotlib figure in the page's style; no window, no global state. Without margins they are worked out, slowly."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_SETTINGS):
        picture = Figure(figsize=(width_in, height_in), layout="constrained" if margins is None else None)
        if margins is not None:
            left, right, bottom, top = margins
            picture.subplots_adjust(left=left, right=right, bottom=bottom, top=top)
        yield picture


def svg_uri(picture: Any) -> str:
    """The figure as a `data:` URI; the same figure gives the same text."""
    text = io.BytesIO()
    picture.savefig(text, format="svg", dpi=160, metadata={"Date": None, "Creator": None})
    return "data:image/svg+xml;base64," + base64.b64encode(text.getvalue()).decode("ascii")


def photo_uri(rgb: NDArray[np.uint8]) -> str:
    """A colour picture (H, W, 3) as a `data:` URI."""
    import cv2

    _, data = cv2.imencode(".jpg", np.ascontiguousarray(rgb[:, :, ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 88])
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")


def thinned(poses: Array) -> Array:
    """At most some thousand of the poses (P, 3), the last one among them: more cannot be seen."""
    step = max(1, len(poses) // _MAX_POINTS)
    return poses if step == 1 else np.concatenate([poses[:-1:step], poses[-1:]])


def draw_building(axes: Any, building: Raster | None, darkness: float = 0.55) -> None:
    """What the robot saw, in grey, under everything else."""
    if building is None:
        return
    seen = np.ma.masked_equal(building.grey, 0.0) * darkness
    looks = {"cmap": "Greys", "vmin": 0.0, "vmax": 1.0, "interpolation": "antialiased", "zorder": 1}
    axes.imshow(seen, origin="lower", extent=building.extent, **looks)


def metric_axes(axes: Any, adjustable: str = "datalim") -> None:
    """Equal axes in metres."""
    axes.set_aspect("equal", adjustable=adjustable)
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.grid(True, linewidth=0.5)
    axes.set_axisbelow(True)


def fitted_size(span_m: Array, panels: int = 1) -> tuple[float, float]:
    """Width and height of a figure, inches, whose side-by-side panels each show `span_m` (2,), m."""
    shape = max(float(span_m[1]), 0.5) / max(float(span_m[0]), 0.5)
    return PAGE_WIDTH_IN, float(np.clip(PAGE_WIDTH_IN / panels * shape + 1.1, 2.6, 8.5))
