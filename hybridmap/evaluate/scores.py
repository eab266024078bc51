"""What the figures that a loop was decided by are called among people, with their units."""

from __future__ import annotations

from hybridmap.graph.edges import Edge

_WORDS: dict[str, tuple[str, str]] = {
    "profile_G": ("difference of the scanlines (G)", ""),
    "shift": ("scanlines shifted by", "columns"),
    "map_distance_m": ("apart on the map at the time", "m"),
    "matches": ("features matched", ""),
    "feature_inliers": ("features that agree on the pose", ""),
    "feature_inliers_reverse": ("that agree the other way round", ""),
    "feature_inliers_both": ("that agree both ways round", ""),
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
    "violation": ("share of points seen through", ""),
    "inliers": ("share of all points that lie close", ""),
    "off_features_m": ("depth is off the features' pose by", "m"),
    "off_features_deg": ("and in heading by", "deg"),
    "map_sigma": ("off the map, in standard deviations of it", ""),
    "supporting": ("other edges that agree", ""),
    "agreeing": ("loops that put the robot there", ""),
    "probes": ("probes that agree", ""),
    "span_m": ("travel that they cover", "m"),
    "rival": ("score of the best rival, as a share", ""),
    "mismatch": ("mismatch (0 fits perfectly)", ""),
}


def in_words(edge: Edge) -> list[tuple[str, str]]:
    """(words, value with unit) of each figure of an edge, those that decided first; one without words goes by its own name."""
    figures = {check.figure: check.value for check in edge.checks} | dict(edge.figures)
    figures |= {"shift": edge.shift} if edge.shift else {}
    rows = []
    for name, value in figures.items():
        said, unit = _WORDS.get(name, (name.replace("_", " "), ""))
        rows.append((said, f"{value:.4g} {unit}".rstrip()))
    return rows
