"""What the figures that a loop was decided by are called among people, with their units."""

from __future__ import annotations

from collections.abc import Mapping

_WORDS: dict[str, tuple[str, str]] = {
    "profile_G": ("difference of the scanlines (G)", ""),
    "shift": ("scanlines shifted by", "columns"),
    "map_distance_m": ("apart on the map at the time", "m"),
    "matches": ("features matched", ""),
    "inliers": ("features that agree on the pose", ""),
    "inliers_reverse": ("that agree the other way round", ""),
    "height_m": ("measured off the floor by", "m"),
    "tilt_deg": ("measured tilt", "deg"),
    "reverse_m": ("the two ways round differ by", "m"),
    "reverse_deg": ("and in heading by", "deg"),
    "depth_inliers": ("share of the common depth that fits", ""),
    "depth_residual_m": ("distance of the surfaces there (RMS)", "m"),
    "overlap": ("share of the depth in common view", ""),
    "points": ("points of depth in common view", ""),
    "slack_m": ("standard deviation in the loosest direction", "m"),
    "start": ("score of the coarse search (1 is best)", ""),
    "near": ("near: share of points with a partner", ""),
    "fit": ("fit: share of these that lie close", ""),
    "rms_m": ("distance of those that lie close (RMS)", "m"),
    "gate_sigma_m": ("standard deviation of the expected position", "m"),
    "off_m": ("off the expected position by", "m"),
    "off_deg": ("off the expected heading by", "deg"),
    "loosest_m": ("standard deviation in the loosest direction", "m"),
    "ambiguity": ("ambiguity: likelihood left when slid that way", ""),
    "second_mode": ("likelihood left when slid along its loosest direction, in which it is held the looser", ""),
    "violation": ("share of points seen through", ""),
    "whole_map": ("sought in the whole map", ""),
    "mismatch": ("mismatch (0 fits perfectly)", ""),
}
_OF_SCANS = {"inliers": ("share of all points that lie close", "")}
_FLAGS = ("whole_map",)


def in_words(scores: Mapping[str, float]) -> list[tuple[str, str]]:
    """(words, value with unit) of each figure of a loop, in their order; one that has no words goes by its own name."""
    words = _WORDS | (_OF_SCANS if "near" in scores else {})
    rows = []
    for name, value in scores.items():
        said, unit = words.get(name, (name.replace("_", " "), ""))
        text = ("yes" if value else "no") if name in _FLAGS else f"{value:.4g} {unit}".rstrip()
        rows.append((said, text))
    return rows
