"""Whether the robot still knows where on its map it is: it does not once it has been carried away."""

from __future__ import annotations

from hybridmap.config.vision import RelocalisingConfig


class Whereabouts:
    """Keeps the evidence.

    The chain is broken at a node whose view fits none of the nodes before it: the robot may have been carried there, or have
    looked at a bare wall. It is doubtful at a node whose view fits, but slides: one wall fits any other. And a robot that is
    where its map has it recognises what it drives past. In all three cases it is lost until a closure tells where it is;
    only a doubt is forgotten in the end, as most bare walls are just that.
    """

    def __init__(self, config: RelocalisingConfig) -> None:
        self._config = config
        self._breaks: dict[int, bool] = {}
        self._unrecognised = 0

    @property
    def lost(self) -> bool:
        """The map's own pose is not to be trusted."""
        wanted = self._config.unrecognised_nodes
        return bool(self._breaks) or (wanted > 0 and self._unrecognised >= wanted)

    @property
    def first_break(self) -> int | None:
        """The first node since the last closure before which the chain broke or may have broken; None where it holds."""
        return min(self._breaks, default=None)

    def break_before(self, node: int) -> int | None:
        """Where the chain broke, if the robot is elsewhere at a node: the last break up to it, else the last doubt."""
        before = [at for at in self._breaks if at <= node]
        certain = [at for at in before if self._breaks[at]]
        return max(certain or before, default=None)

    def tracked(self, node: int, sigma_m: float | None) -> None:
        """The view of a new node was compared with those before it.

        Args:
            node: the new node.
            sigma_m: standard deviation of the best registration in its loosest direction, m; None where nothing fitted.
        """
        forgotten = [at for at, certain in self._breaks.items() if not certain and node - at > self._config.doubt_nodes]
        for at in forgotten:
            del self._breaks[at]
        if self._config.candidates > 0 and (sigma_m is None or sigma_m > self._config.doubtful_m):
            self._breaks[node] = sigma_m is None

    def recognised(self) -> None:
        """A closure says where the robot is."""
        self._breaks.clear()
        self._unrecognised = 0

    def unrecognised(self) -> None:
        """At this node the robot should have seen a place that it knows, and did not recognise it."""
        self._unrecognised += 1
