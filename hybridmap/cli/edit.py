"""`hybridmap edit`: change a map by hand."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybridmap.cli.options import AsJson
from hybridmap.cli.show import emit
from hybridmap.errors import ConfigError

if TYPE_CHECKING:
    from hybridmap.sessions.editing import Measured

SIGMAS = (0.05, 1.0)
"""Standard deviations of an edge by hand, m and degrees, if none are given."""
_ADD = "SOURCE,TARGET,X,Y,YAW[,SIGMA_M,SIGMA_DEG]"


def edit(
    folder: Annotated[Path, typer.Argument(help="Session folder of the map.")],
    remove_edge: Annotated[
        int | None, typer.Option(metavar="N", help="Take edge N out of the graph; `hybridmap explain` shows edges by number.")
    ] = None,
    remove_session: Annotated[
        int | None, typer.Option(metavar="S", help="Take session S out, with all edges that lead there: undo a joining.")
    ] = None,
    add_edge: Annotated[
        str | None,
        typer.Option(
            metavar=_ADD,
            help="Add an edge: node TARGET as seen from node SOURCE, m and degrees; standard deviations 0.05 m and 1 degree if"
            " not given.",
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Session folder to write. Default: the map itself is replaced.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing session at --out.")] = False,
    as_json: AsJson = False,
) -> None:
    """Change one thing about a map, and solve it again.

    An edge that is taken out stays in the map file as retracted. What it joined alone becomes a piece of its own, which the
    verdict says. If all sessions but one are taken out, that one is again as it was before it was joined, bit for bit.
    """
    from hybridmap.cli.map import judged
    from hybridmap.sessions import editing

    given = [value for value in (remove_edge, remove_session, add_edge) if value is not None]
    if len(given) != 1:
        raise ConfigError(f"edit: found {len(given)} changes, expected one of --remove-edge, --remove-session, --add-edge")
    target, replaced = out or folder, overwrite or out is None
    if remove_edge is not None:
        done = editing.remove_edge(folder, remove_edge, target, overwrite=replaced)
    elif remove_session is not None:
        done = editing.remove_session(folder, remove_session, target, overwrite=replaced)
    else:
        done = editing.add_edge(folder, _measured(add_edge or ""), target, overwrite=replaced)
    as_it_was = remove_session is not None and "sessions" not in done.head  # before it was joined, bit for bit
    head, metrics = judged(done.folder, errors=not as_it_was)
    emit(head, metrics, as_json=as_json, title=str(target))


def _measured(text: str) -> Measured:
    """The edge that `--add-edge` gives."""
    import numpy as np

    from hybridmap.sessions.editing import Measured

    try:
        source, target, *numbers = text.split(",")
        x_m, y_m, yaw_deg, sigma_m, sigma_deg = [*map(float, numbers), *(SIGMAS[len(numbers) - 3 :])]
        delta = np.array([x_m, y_m, np.deg2rad(yaw_deg)])
        if not (np.isfinite(delta).all() and 0.0 < sigma_m < np.inf and 0.0 < sigma_deg < np.inf):
            raise ValueError
        return Measured(int(source), int(target), delta, sigma_m, float(np.deg2rad(sigma_deg)))
    except ValueError:
        raise ConfigError(f"--add-edge: found {text!r}, expected {_ADD} with finite numbers, e.g. 12,40,0.5,-0.1,90") from None
