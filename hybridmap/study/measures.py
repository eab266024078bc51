"""The figures of a study: name, unit and meaning."""

from __future__ import annotations

from hybridmap.metrics import FIGURES as SOLUTION
from hybridmap.study.model import StudyConfig

KEPT = 0.5
"""A loop whose final weight is above this counts as kept."""

NEAR_M = 0.05
"""A map this close to its reference counts as whole, m."""

OF_ODOMETRY = ("ate_m", "yaw_deg", "within_5_cm", "chi2", "chi2_own", "relation_m", "relation_deg", "relation_loop_m")
"""Figures that are those of odometry where a back-end failed or diverged."""

ERRORS = {"ate_m": "ATE", "relation_m": "relation error"}
"""The errors of position by which maps are compared, the preferred one first, and their names for people."""

VERDICT = ("1", "verdict on the map: 0 trusted, 1 doubtful, 2 failed")

MEASURES = {
    "ate_m": ("m", "RMSE of position against the reference after SE(2) alignment, over the nodes"),
    "yaw_deg": ("deg", "RMSE of heading against the reference after that alignment"),
    "within_5_cm": ("1", f"1 where ate_m is at most {NEAR_M} m, else 0"),
    "chi2_initial": ("1", "chi2 of the initial poses, false loops included"),
    "chi2": ("1", "chi2 at the end, false loops included"),
    "chi2_own": ("1", "chi2 at the end over the graph's own edges, without the false loops put into it"),
    "false_kept": ("1", f"false loops of weight above {KEPT}"),
    "own_lost": ("1", "of the graph's own loops, those rejected as outliers"),
    "own_lost_percent": ("%", "the same in percent of the graph's own loops"),
    "chi2_odometry": ("1", "share of chi2 from edges other than loops; large if true loops were rejected"),
    "unit_variance": SOLUTION["unit_variance/"],
    "verdict": VERDICT,
    "iterations": SOLUTION["iterations/"],
    "theta_max": ("1", "the paper's rule and the normalised one: rate from which it diverges, predicted: 2 / lambda_max"),
    "theta_max_measured": ("1", "the same, by trial"),
    "shrinks": ("1", "the same rules: factor on the error a sweep in the long run, predicted: 1 - theta lambda_2"),
    "shrinks_measured": ("1", "the same, over sweeps 2,700 to 3,000 from the start"),
}
"""Figures of a back-end on a graph, in the order of the tables."""

WRONG_M, WRONG_DEG = 0.5, 10.0
"""A loop of a drive is false if it is farther than either from the truth: the robot would not find its way by it."""

MAPPED = {
    "ate_m": ("m", "RMSE of position against the truth after SE(2) alignment, over the whole drive"),
    "relation_m": ("m", "mean translational error of the verified relations"),
    "relation_deg": ("deg", "mean rotational error of the verified relations"),
    "relation_loop_m": ("m", "mean translational error of the relations over more than 60 s"),
    "verdict": VERDICT,
    "clock_offset_s": ("s", "how much later views were found to be stamped than odometry; nothing where it is not known"),
    "nodes": ("1", "nodes of the map"),
    "loops": ("1", "loops in the graph"),
    "loops_rejected": ("1", "of those, the ones rejected as outliers by the back-end"),
    "loop_precision": ("1", f"share of the loops kept that are within {WRONG_M} m and {WRONG_DEG:g} deg of the truth"),
    "loop_recall": ("1", "share of the revisits (within 1 m and 30 deg, after 10 s or more) with such a loop within 3 nodes"),
    "false_kept": ("1", f"loops farther from the truth than that, of weight above {KEPT}"),
    "wrong_loops": ("1", "loops in the graph that are wrong by more than 1 m"),
    "loop_median_m": ("m", "translational error of the loops, median"),
    "loop_p95_m": ("m", "translational error of the loops, 95 %"),
    "loop_median_deg": ("deg", "rotational error of the loops, median"),
    "loop_p95_deg": ("deg", "rotational error of the loops, 95 %"),
    "loop_chi2_ratio": ("1", "median normalised squared error of the loops over the expected one; 1: covariances are right"),
    "registration_chi2_ratio": ("1", "the same of the registrations of consecutive nodes"),
    "kidnapped_m": ("m", "after a kidnapping: error of the pose at the first node"),
    "known_m": ("m", "after a kidnapping: travel until the robot was at a visited place with a similar heading"),
    "found_m": ("m", "after a kidnapping: travel until the pose was right and stayed right"),
}
"""Figures of a drive as it was mapped, by odometry or by a back-end of its configuration."""

TIMINGS = {
    "cpu_s": ("s", "process time of the back-end, or of mapping the drive"),
    "cpu_s_per_min": ("s/min", "process time of mapping a minute of the drive"),
    "cpu_ms_per_view": ("ms", "process time of mapping a scan or frame"),
}
"""What a cell cost when it was computed; apart from the others, since no two runs agree on it."""

FIGURES = (*dict.fromkeys((*MEASURES, *MAPPED, *TIMINGS)),)
"""Everything that a bar may be for."""


def measures_of(study: StudyConfig) -> dict[str, tuple[str, str]]:
    """Name of a figure -> its unit and meaning, for the figures that cells of a study can have, in the order of tables."""
    solves = any(variant.way != "mapped" for variant in study.backends)
    return (MEASURES if solves else {}) | (MAPPED if study.maps else {})


def unit_of(figure: str) -> str:
    """Unit of a figure, by its name in `FIGURES`; `1` for a plain number."""
    return (MEASURES | MAPPED | TIMINGS)[figure][0]
