"""The services of the node, under the names that users of slam_toolbox, RTAB-Map and map_server know."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from hybridmap.errors import HybridMapError, RosError
from hybridmap.export.keyframes import OccupancyGrid, write_picture
from hybridmap.live import LiveMapper
from hybridmap.output import staged
from hybridmap.ros import contents
from hybridmap.ros.contents import Contents
from hybridmap.ros.middleware import Service, ServiceKind

_ANSWER_S = 60.0
_NO_KNOWN_MAP = "no finished map to look for the robot on: start the node with --map DIR, its session folder"


class Services:
    """What the services do."""

    def __init__(
        self,
        mapper: Callable[[], LiveMapper],
        reset: Callable[[], None],
        out: Path,
        map_frame: str,
        resolution_m: float,
        known_map: Path | None = None,
    ) -> None:
        """Remember what they need.

        Args:
            mapper: gives the mapper; raises a RosError before it has begun.
            reset: begins a new map in place of the present one; raises as `mapper`.
            out: the session folder; `save_map` writes beside it.
            map_frame: name of the frame of the map.
            resolution_m: side of a cell of the grid.
            known_map: session folder of a finished map; None: there is none.
        """
        self._mapper, self._begin_anew, self._out = mapper, reset, out
        self._map_frame, self._resolution_m, self._known_map = map_frame, resolution_m, known_map

    @property
    def table(self) -> tuple[Service, ...]:
        """All services."""
        return (
            Service("~save_map", ServiceKind.TRIGGER, _answered(self._save_map)),
            Service("~serialize_map", ServiceKind.TRIGGER, _answered(self._serialize_map)),
            Service("~deserialize_map", ServiceKind.TRIGGER, _answered(lambda _: self._localise(True))),
            Service("~set_localization_mode", ServiceKind.SET_BOOL, _answered(self._localise)),
            Service("~pause", ServiceKind.EMPTY, self._pause),
            Service("~resume", ServiceKind.EMPTY, self._resume),
            Service("~reset", ServiceKind.EMPTY, self._reset),
            Service("dynamic_map", ServiceKind.GET_MAP, self._dynamic_map),
        )

    def _save_map(self, _: bool) -> str:
        grid = self._grid()
        yaml = self._out.with_name(f"{self._out.name}.yaml")
        image = yaml.with_suffix(".pgm")
        with staged(yaml, image, overwrite=True) as work:
            write_picture(grid, work / yaml.name)
        return f"{yaml} and {image.name}, for map_server"

    def _serialize_map(self, _: bool) -> str:
        self._mapper().save(timeout_s=_ANSWER_S)
        return f"everything so far is in the session folder {self._out}"

    def _localise(self, wanted: bool) -> str:
        mapper = self._mapper()
        if wanted and self._known_map is None:
            raise RosError(_NO_KNOWN_MAP)
        mapper.localise(self._known_map if wanted else None)
        return f"looking for the robot on {self._known_map}, and mapping" if wanted else "mapping"

    def _pause(self, _: bool) -> Contents:
        self._mapper().pause()
        return {}

    def _resume(self, _: bool) -> Contents:
        self._mapper().resume()
        return {}

    def _reset(self, _: bool) -> Contents:
        self._begin_anew()
        return {}

    def _dynamic_map(self, _: bool) -> Contents:
        grid = self._grid()
        return {"map": contents.occupancy(self._mapper().snapshot.stamp_ns, self._map_frame, grid)}

    def _grid(self) -> OccupancyGrid:
        """The grid of all that was mapped so far; it is saved before, as the way that was driven is free."""
        mapper = self._mapper()
        mapper.save(timeout_s=_ANSWER_S)
        return mapper.grid(self._resolution_m, timeout_s=_ANSWER_S)


def _answered(do: Callable[[bool], str]) -> Callable[[bool], Contents]:
    """The response of Trigger or SetBool: a failure is an answer, too."""

    def answer(value: bool) -> Contents:
        try:
            return {"success": True, "message": do(value)}
        except HybridMapError as error:
            return {"success": False, "message": str(error)}

    return answer
