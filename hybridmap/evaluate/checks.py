"""The figures of a decision held against the settings that decided it, and what would have had to be different."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from hybridmap.graph.edges import Edge, EdgeKind, Status


@dataclass(frozen=True, slots=True)
class Rule:
    """A figure that must be at least, or at most, what a setting says.

    Attributes:
        figure: its name among the scores of an edge.
        at_least: else at most; signs do not count there.
        setting: dotted name in the configuration.
        held: factor on the setting where the camera's tilt was measured and not taken from the mounting.
    """

    figure: str
    at_least: bool
    setting: str
    held: float = 1.0


@dataclass(frozen=True, slots=True)
class Check:
    """A rule and how a decision fared by it."""

    rule: Rule
    value: float
    limit: float

    @property
    def passed(self) -> bool:
        """Whether the figure keeps to the setting."""
        return self.value >= self.limit if self.rule.at_least else abs(self.value) <= self.limit

    @property
    def slack(self) -> float:
        """How far from the limit, as a share of it; negative where it is missed."""
        away = self.value - self.limit if self.rule.at_least else self.limit - abs(self.value)
        return away / max(abs(self.limit), 1e-12)

    def __str__(self) -> str:
        sign = ">=" if self.rule.at_least else "<="
        return f"{self.rule.figure} {self.value:.4g} ({sign} {self.limit:.4g}, {self.rule.setting})"


_PNP, _LASER, _TRACKING = "vision.rgbd.pnp", "vision.laser.probes", "vision.laser.tracking"
_BY_FEATURES = (
    Rule("matches", True, f"{_PNP}.min_inliers"),
    Rule("inliers", True, f"{_PNP}.min_inliers"),
    Rule("inliers_reverse", True, f"{_PNP}.min_inliers"),
    Rule("height_m", False, f"{_PNP}.max_height_m", held=3.0),
    Rule("tilt_deg", False, f"{_PNP}.max_tilt_deg", held=2.0),
    Rule("reverse_m", False, f"{_PNP}.agree_m"),
    Rule("reverse_deg", False, f"{_PNP}.agree_deg"),
    Rule("depth_inliers", True, "vision.rgbd.registration.min_inliers"),
)
_BY_DEPTH = (
    Rule("depth_inliers", True, f"{_PNP}.map_inliers"),
    Rule("overlap", True, f"{_PNP}.map_overlap"),
    Rule("points", True, f"{_PNP}.map_points"),
    Rule("slack_m", False, f"{_PNP}.map_sigma_m"),
)
_BY_SCANS = (
    Rule("near", True, f"{_LASER}.near_min"),
    Rule("fit", True, f"{_LASER}.fit_min"),
    Rule("loosest_m", False, f"{_LASER}.loosest_max_m"),
    Rule("ambiguity", False, f"{_LASER}.ambiguity_max"),
    Rule("violation", False, f"{_LASER}.violation_max"),
)
_PROFILE = (Rule("profile_G", False, "vision.matching.c_t"),)
_STEP_OF_CAMERA = (Rule("inliers", True, "vision.rgbd.registration.min_inliers"),)
_STEP_OF_LASER = (Rule("inliers", True, f"{_TRACKING}.inliers_weak"),)

_CLOSING, _COMMIT = "vision.rgbd.closing", "vision.laser.commitment"
_LOST = "vision.laser.relocalising"
_OTHERWISE = (
    (
        "no other edge supports it",
        f"a second verified edge beside it: from a node at most {{{_CLOSING}.support_nodes}} away to one at most "
        f"{{{_CLOSING}.support_nodes}} away, agreeing to {{{_CLOSING}.support_m}} m and {{{_CLOSING}.support_deg}} deg",
    ),
    (
        "waits for support",
        f"a second verified edge beside it, within {{{_CLOSING}.support_nodes}} nodes, that agrees",
    ),
    (
        "no cluster",
        f"{{{_COMMIT}.probes}} probes that agree with one another, over {{{_COMMIT}.span_m}} m of travel or more, within "
        f"{{{_COMMIT}.wait_m}} m",
    ),
    ("waits for a cluster", f"{{{_COMMIT}.probes}} probes that agree with one another, and no rival cluster as good"),
    ("contradicts the cluster", "a cluster of its own that is better than the one it contradicts"),
    (
        "other submaps",
        f"submaps of {{{_LOST}.support}} nodes over {{{_LOST}.span_m}} m of travel, or more where they fit badly, that put the "
        "robot at one place, and those at others counting for less than half as much",
    ),
    (
        "lost: waits for others",
        "closures of {vision.relocalising.support} nodes over {vision.relocalising.span_m} m of travel that put the robot "
        "at one place, and fewer than half as many that contradict them",
    ),
    (
        "too few others",
        "closures of {vision.relocalising.support} nodes over {vision.relocalising.span_m} m of travel that agree",
    ),
    ("sigma of it", "views that fit as the map has their nodes, or a map that is less sure of where these lie"),
    (
        "outside the gate",
        f"a less certain map, or a wider gate: {{{_LASER}.gate_sigmas}} sigma + {{{_LASER}.gate_m}} m and "
        f"{{{_LASER}.gate_deg}} deg",
    ),
    ("contradicted by registration", "a registration that agrees with the odometry, or edges.drop_contradicted: false"),
    ("from odometry without being sure", "odometry nearer to the registration, or a registration as sure as it is good"),
    ("too little depth", "more surfaces in common view"),
    ("depth leads away", "depth that agrees with the features' pose to three times vision.rgbd.pnp.agree_m and agree_deg"),
)


def checks_of(edge: Edge, settings: Mapping[str, Any], held: bool = False) -> list[Check]:
    """The rules that an edge was decided by, in the order in which they are asked.

    Args:
        edge: of a map file, with its scores.
        settings: the resolved configuration, nested.
        held: the camera's tilt was measured.
    """
    out = []
    for rule in _rules(edge):
        limit = setting(settings, rule.setting)
        if rule.figure in edge.scores and isinstance(limit, int | float):
            out.append(Check(rule, float(edge.scores[rule.figure]), float(limit) * (rule.held if held else 1.0)))
    return out


def otherwise(edge: Edge, checks: list[Check], settings: Mapping[str, Any]) -> str:
    """What would have had to be different for the other decision; empty where nothing is known."""
    if edge.status is Status.ACCEPTED:
        tightest = min(checks, key=lambda check: check.slack, default=None)
        if tightest is None:
            return ""
        change = "above" if tightest.rule.at_least else "below"
        return f"refused with {tightest.rule.setting} {change} {abs(tightest.value):.4g} (now {tightest.limit:.4g})"
    for words, needed in _OTHERWISE:
        if words in edge.reason:
            return _filled(needed, settings)
    for check in checks:
        if not check.passed:
            sign, change = (">=", "at most") if check.rule.at_least else ("<=", "at least")
            return (
                f"{check.rule.figure} {sign} {check.limit:.4g} instead of {check.value:.4g}, "
                f"or {check.rule.setting} {change} {abs(check.value):.4g}"
            )
    return ""


def setting(settings: Mapping[str, Any], dotted: str) -> Any:
    """A value of a nested configuration; None where there is none."""
    value: Any = settings
    for key in dotted.split("."):
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


def _rules(edge: Edge) -> tuple[Rule, ...]:
    scores = edge.scores
    if edge.kind is EdgeKind.REGISTRATION:
        return _STEP_OF_LASER if "fit" in scores else _STEP_OF_CAMERA
    if "near" in scores:
        return _BY_SCANS
    if "slack_m" in scores:
        return _BY_DEPTH
    return (*_PROFILE, *_BY_FEATURES)


def _filled(text: str, settings: Mapping[str, Any]) -> str:
    parts = text.split("{")
    out = parts[0]
    for part in parts[1:]:
        name, _, rest = part.partition("}")
        value = setting(settings, name)
        out += (f"{value:g}" if isinstance(value, int | float) else name) + rest
    return out
