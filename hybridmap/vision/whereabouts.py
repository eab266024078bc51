"""Whether the robot still knows where on its map it is: it does not once it has been carried away."""

from __future__ import annotations

from hybridmap.config.vision import RelocalisingConfig


class Whereabouts:
    """Keeps the evidence.

    The chain is broken at a node whose view fits none of the nodes before it: the robot may have been carried there, or have
    looked at a bare wall. And a robot that is where its map has it recognises what it drives past. In both cases it is lost
    until a closure tells where it is.
    """

    def __init__(self, config: RelocalisingConfig) -> None:
        self._config = config
        self._broken_at: int | None = None
        self._unrecognised = 0

    @property
    def lost(self) -> bool:
        """The map's own pose is not to be trusted."""
        wanted = self._config.unrecognised_nodes
        return self._broken_at is not None or (wanted > 0 and self._unrecognised >= wanted)

    @property
    def broken_at(self) -> int | None:
        """The node before which the chain broke; None where it holds."""
        return self._broken_at

    def tracked(self, node: int, registered: bool) -> None:
        """The view of a new node was compared with those before it."""
        if not registered and self._config.candidates > 0:
            self._broken_at = node

    def recognised(self) -> None:
        """A closure says where the robot is."""
        self._broken_at = None
        self._unrecognised = 0

    def unrecognised(self) -> None:
        """At this node the robot should have seen a place that it knows, and did not recognise it."""
        self._unrecognised += 1
