"""`hybridmap explain`: the decisions made at one node or one frame, with their reasons."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hybridmap.cli.options import AsJson
from hybridmap.errors import ConfigError, counted
from hybridmap.trajectory import format_motion, format_stamp

if TYPE_CHECKING:
    from hybridmap.evaluate.explain import Decision, FrameStory, NodeStory

MOST_RANKED, MOST_LATER = 8, 12


def explain(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Session folder, as `hybridmap map` writes it.")],
    node: Annotated[
        int | None, typer.Option(metavar="N", help="Explain the decisions at this node; 0 is the first. Not with --frame.")
    ] = None,
    frame: Annotated[
        float | None,
        typer.Option(
            metavar="T",
            help="Explain the decisions at the message (odometry, frame or scan) nearest to this time: seconds from the start"
            " of the recording, or, from 1e6 on, a stamp in seconds. Not with --node.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Explain the decisions at a node or a time: why a node was made or not, and why each loop was closed or not.

    Give exactly one of --node and --frame. At a time without a node it says why none was made. At a node it shows the
    candidates, each check with its value and limit (m, deg), whether the loop was accepted, and what would have changed that.
    Reads the session's map file; writes nothing.
    """
    from hybridmap.evaluate.explain import Explainer
    from hybridmap.metrics import to_json

    if (node is None) == (frame is None):
        raise ConfigError(f"explain: expected either --node N or --frame T, found {'none' if node is None else 'both'}")
    with Explainer(folder) as explainer:
        instant = explainer.frame(frame) if frame is not None else None
        number = node if instant is None else instant.at_node if instant.made else None
        story = None if number is None else explainer.node(number)
        primary = explainer.primary
    if as_json:
        head: dict[str, Any] = {"session": str(folder), "primary_backend": primary}
        if instant is not None:
            head["frame"] = instant.to_json()
        if story is not None:
            head["node"] = story.to_json()
        sys.stdout.write(to_json(head, []) + "\n")
        return
    lines = [*(_frame_lines(instant) if instant else ()), *(_node_lines(story) if story else ())]
    sys.stdout.write("\n".join(lines) + "\n")


def _frame_lines(story: FrameStory) -> Iterator[str]:
    yield f"frame at {story.time_s:.3f} s (stamp {format_stamp(story.stamp_ns)} s)"
    yield f"  robot        {format_motion(*story.moved)} from node {story.at_node}, the last one made"
    if story.next_node is not None:
        yield f"               node {story.next_node} came at {story.next_time_s:.3f} s"
    yield from _pose_lines(story.poses, "believed")
    yield f"  {'node made  ' if story.made else 'no node    '}  {story.reason}"
    if story.made:
        yield ""
    else:
        yield f"  more         --node {story.at_node} explains the node before" + (
            f", --node {story.next_node} the one after" if story.next_node is not None else ""
        )


def _node_lines(story: NodeStory) -> Iterator[str]:
    yield f"node {story.node} at {story.time_s:.3f} s (stamp {format_stamp(story.stamp_ns)} s)"
    yield f"  travel       {story.travel_m:.2f} m so far"
    if story.moved is not None:
        yield f"  made         {format_motion(*story.moved)} from node {story.node - 1}"
    if story.template >= 0:
        yield f"  view         template {story.template}" + (", which it founded" if story.founded else ", seen before")
    yield from _pose_lines(story.poses, "pose")
    yield from _gate_lines(story)
    if story.chain:
        yield ""
        yield "chain"
    yield from _decisions(story.chain, story.node)
    yield ""
    yield f"loops to older nodes: {_counts(story.loops)}" + (f": {story.no_loops}" if story.no_loops else "")
    yield from _decisions(story.loops, story.node)
    if story.later:
        yield ""
        yield f"loops from newer nodes: {_counts(story.later)}"
        yield from _decisions(_accepted_first(story.later)[:MOST_LATER], story.node)
        if len(story.later) > MOST_LATER:
            yield f"  ... and {len(story.later) - MOST_LATER} more, see --json"


def _pose_lines(poses: Any, title: str) -> Iterator[str]:
    for name, (x, y, yaw) in poses.items():
        yield f"  {title:12} x {x:.3f} m, y {y:.3f} m, heading {yaw * 57.29577951308232:.2f} deg by {name}"
        title = ""


def _gate_lines(story: NodeStory) -> Iterator[str]:
    gate = story.gate
    if gate is not None:
        inside = f"{gate.inside} of {counted(gate.older, 'node')} that were old enough"
        yield f"  gate         {gate.radius_m:.2f} m and {gate.heading_deg:.0f} deg: {inside}"
        if gate.whole_map:
            yield "               the robot was lost: the whole map was searched as well"
    if story.nearest is not None:
        node, metres, degrees = story.nearest
        yield f"  nearest      of the older nodes on the final map: {node}, {metres:.2f} m and {degrees:.0f} deg away"
    if len(story.ranked):
        tried = {decision.edge.target for decision in story.loops}
        best = [f"{row[0]:.0f} ({row[1]:.2f}{', tried' if int(row[0]) in tried else ''})" for row in story.ranked[:MOST_RANKED]]
        yield f"  by its view  {', '.join(best)}: the best of the gate, with their G"


def _counts(decisions: list[Decision]) -> str:
    if not decisions:
        return "none was considered"
    statuses = [str(decision.edge.status) for decision in decisions]
    return ", ".join(f"{statuses.count(status)} {status}" for status in dict.fromkeys(statuses))


def _accepted_first(decisions: Iterable[Decision]) -> list[Decision]:
    return sorted(decisions, key=lambda decision: str(decision.edge.status) != "accepted")


def _decisions(decisions: Iterable[Decision], node: int) -> Iterator[str]:
    for decision in decisions:
        edge = decision.edge
        other = edge.source if edge.target == node else edge.target
        yield f"  {edge.kind.name.lower():12} {other:>5}  {str(edge.status).upper():9} {edge.reason}"
        if edge.proposed_by is not None:
            yield _indented("proposed", f"by {edge.proposed_by.words}")
        if edge.checks:
            yield _indented("figures", "; ".join(f"{check} {'yes' if check.passed else 'NO'}" for check in edge.checks))
        if edge.figures:
            yield _indented("also", ", ".join(f"{name} {value:.4g}" for name, value in edge.figures.items()))
        if edge.otherwise:
            yield _indented("otherwise", edge.otherwise)
        if any(weight < 1.0 for weight in decision.weights.values()):
            weights = ", ".join(f"{name} {weight:.2g}" for name, weight in decision.weights.items())
            against = f"; contradicts the other loops by {', '.join(decision.inconsistent)}" if decision.inconsistent else ""
            yield _indented("weight", weights + against)
        if decision.error is not None:
            yield _indented("off by", f"{decision.error[0]:.3f} m, {decision.error[1]:.2f} deg from the truth")


def _indented(title: str, text: str) -> str:
    return f"{'':22}{title:10} {text}"
