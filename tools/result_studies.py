"""The topics of `docs/results.md`: the commands to run, the figures to record with their bars, and the lines of the page."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """A figure to record from the `--json` output of a command.

    Attributes:
        name: name of the metric. `PRIMARY` in it stands for the primary back-end of the session.
        bar: limit that the figure is held against; None for none.
        at_least: True if the figure must be at least its bar; else it must be at most its bar.
    """

    name: str
    bar: float | None = None
    at_least: bool = False


@dataclass(frozen=True)
class Step:
    """One command.

    Attributes:
        command: the command line. `$HYBRIDMAP_DATA` in it stands for the folder of recordings.
        figures: figures to record from its `--json` output.
        wall_bar_s: bar of its wall time, which is then recorded as well.
        holds: name of a figure that is 1 if the command succeeds, else 0. Without it, a command that fails is an error.
        same_graph: True if the graph must equal that of the steps before.
        own_bars: True to record also each figure that the command itself holds against a bar.
        study: output folder of a study. The figures are then read from its `bars.csv`.
    """

    command: str
    figures: tuple[Figure, ...] = ()
    wall_bar_s: float | None = None
    holds: str = ""
    same_graph: bool = False
    own_bars: bool = False
    study: str = ""


@dataclass(frozen=True)
class Question:
    """A line of the page: its text, and patterns for the names of the figures that it sums up."""

    what: str
    figures: tuple[str, ...]


@dataclass(frozen=True)
class Topic:
    """Steps that run one after the other in one empty folder, and the questions that their figures answer.

    Attributes:
        name: name for `--only`.
        title: text on the page.
        steps: the commands.
        questions: the lines of the page.
        needs: file in the folder of recordings without which the topic is left out.
    """

    name: str
    title: str
    steps: tuple[Step, ...]
    questions: tuple[Question, ...]
    needs: str = ""


def _asked(*pairs: tuple[str, str]) -> tuple[Question, ...]:
    return tuple(Question(what, tuple(patterns.split(" | "))) for what, patterns in pairs)


def _study(name: str) -> Step:
    return Step(f"hybridmap study {name} --out {name}", study=name, own_bars=True)


def _log(name: str, file: str, bars: tuple[float, float], more: tuple[Step, ...] = ()) -> tuple[Step, ...]:
    source = f"$HYBRIDMAP_DATA/real/{name}"
    return (
        Step(f"hybridmap map {source}/{file} --out {name}", (Figure("cpu_s_per_min", 1.5), Figure("nodes"))),
        Step(
            f"hybridmap evaluate {name} --relations {source}/relations.txt",
            (
                Figure("relation_trans_mean/odometry"),
                Figure("relation_trans_mean/PRIMARY", bars[0]),
                Figure("relation_rot_mean/PRIMARY"),
                Figure("relation_loop_trans_mean/odometry"),
                Figure("relation_loop_trans_mean/PRIMARY", bars[1]),
            ),
        ),
        *more,
    )


_COMPARED = ("odometry", "relaxation-ratslam", "gtsam-lm", "gtsam-isam2", "gtsam-cauchy", "gtsam-gnc")
_OF_LOG = _asked(
    ("relation error of odometry", "relation_trans_mean/odometry"),
    ("relation error of the map", "relation_trans_mean/gtsam-gnc"),
    ("of that, loops of more than 60 s", "relation_loop_trans_mean/gtsam-gnc"),
    ("CPU time per minute of the recording", "cpu_s_per_min"),
)
_OFFICE = (Figure("ate_rmse/PRIMARY", 0.20),)
_GRAPHS = (
    ("intel.g2o", 45.0492, 1e-6),
    ("CSAIL.g2o", 40.5914, 1e-6),
    ("FR079_P_toro.graph", 37.6093, None),
    ("manhattanOlson3500.g2o", 146.2248, 1e-6),
    ("city10000.g2o", 512.4995, 1e-6),
)

TOPICS = (
    Topic(
        "demo",
        "demo: a simulated laboratory, RGB-D",
        (
            Step(
                "hybridmap demo --out demo",
                (
                    Figure("ate_rmse/odometry"),
                    Figure("ate_rmse/relaxation-ratslam"),
                    Figure("ate_rmse/gtsam-gnc"),
                    Figure("loops_accepted"),
                    Figure("loop_precision/graph"),
                ),
                wall_bar_s=45.0,
            ),
        ),
        _asked(
            ("ATE of odometry", "ate_rmse/odometry"),
            ("ATE of relaxation", "ate_rmse/relaxation-ratslam"),
            ("ATE of the map", "ate_rmse/gtsam-gnc"),
            ("share of accepted loops that are true", "loop_precision/graph"),
            ("wall time", "wall_time"),
        ),
    ),
    Topic(
        "fr079",
        "fr079: a real office building, laser, wheels that drift badly",
        _log(
            "fr079",
            "fr079.mcap",
            (0.048, 0.070),
            (Step(f"hybridmap compare fr079 --backends {','.join(_COMPARED)}", tuple(Figure(f"chi2/{n}") for n in _COMPARED)),),
        ),
        _OF_LOG,
        needs="real/fr079/fr079.mcap",
    ),
    Topic(
        "aces",
        "aces: a real building with long corridors, laser, few loops",
        _log("aces", "aces.bag", (0.040, 0.060)),
        _OF_LOG,
        needs="real/aces/aces.bag",
    ),
    Topic(
        "office",
        "office: two laps of a simulated office, RGB-D; mapped live, from two kinds of bag and from a TUM folder",
        (
            Step(
                "hybridmap map office --out live",
                (Figure("ate_rmse/odometry"), *_OFFICE, Figure("ate_rmse/relaxation-ratslam")),
            ),
            Step("hybridmap simulate office --out office.bag"),
            Step("hybridmap map office.bag --config office --out bag", _OFFICE, same_graph=True),
            Step("hybridmap simulate office --out office.mcap"),
            Step("hybridmap map office.mcap --config office --out mcap", _OFFICE, same_graph=True),
            Step("hybridmap simulate office --out office-tum"),
            Step("hybridmap map office-tum --config office --out tum", _OFFICE, same_graph=True),
        ),
        _asked(
            ("ATE of odometry", "ate_rmse/odometry"),
            ("ATE of the map", "ate_rmse/gtsam-gnc"),
            ("the same graph whatever the source", "same_graph"),
        ),
    ),
    Topic(
        "hololens",
        "hololens: a real office, hand-held RGB-D camera",
        (
            Step(
                "hybridmap map $HYBRIDMAP_DATA/real/hololens_office --out hololens",
                (
                    Figure("nodes"),
                    Figure("loops_accepted"),
                    Figure("ate_rmse/odometry"),
                    Figure("ate_rmse/PRIMARY"),
                    Figure("cpu_s_per_min"),
                ),
            ),
            Step("hybridmap export hololens --format ply --out hololens.ply", holds="the merged cloud is written"),
        ),
        _asked(
            ("ATE of the synthetic odometry", "ate_rmse/odometry"),
            ("ATE of the map", "ate_rmse/gtsam-gnc"),
            ("CPU time per minute of the recording", "cpu_s_per_min"),
        ),
        needs="real/hololens_office/rgb.txt",
    ),
    Topic(
        "rgbd-drives",
        "simulated office and laboratory, RGB-D, five seeds each",
        (_study("rgbd-drives"),),
        _asked(
            ("ATE of the map, office", "ate_m/office/*"),
            ("ATE of the map, laboratory", "ate_m/lab/*"),
            ("recall of revisits", "loop_recall/*"),
            ("false loops kept", "false_kept/*"),
            ("position error of the loops, median", "loop_median_m/*"),
            ("position error of the loops, 95th percentile", "loop_p95_m/*"),
            ("heading error of the loops, median", "loop_median_deg/*"),
            ("heading error of the loops, 95th percentile", "loop_p95_deg/*"),
            ("squared error of the loops over that expected from their covariances", "loop_chi2_ratio/*"),
            ("squared error of the registrations over that expected", "registration_chi2_ratio/*"),
        ),
    ),
    Topic(
        "rgbd-cost",
        "simulated office, 320 x 240 at 10 Hz, `gtsam-isam2`",
        (_study("rgbd-cost"),),
        _asked(("CPU time per frame", "cpu_ms_per_view/*")),
    ),
    Topic(
        "rgbd-robustness",
        "simulated laboratory with degraded cameras and wheels",
        (_study("rgbd-robustness"),),
        _asked(("ATE of the map, held against that of odometry", "ate_m/*"), ("false loops kept", "false_kept/*")),
    ),
    Topic(
        "laser-robustness",
        "fr079 and aces with degraded lasers, wheels and clocks",
        (_study("laser-robustness"),),
        _asked(
            ("relation error of fr079, held against odometry's", "relation_m/fr079/*"),
            ("relation error of aces, held against odometry's", "relation_m/aces/*"),
        ),
        needs="real/fr079/fr079.mcap",
    ),
    Topic(
        "kidnapped",
        "kidnapped robot, put down 20 m away in a known place",
        (_study("kidnapped"),),
        _asked(
            ("distance driven until the robot is localised, by laser", "found_m/office by laser/*"),
            ("distance driven until the robot is localised, by RGB-D", "found_m/office by RGB-D/*"),
            ("loops wrong by more than 1 m", "wrong_loops/*"),
        ),
    ),
    Topic(
        "kidnapped-recording",
        "kidnapped robot, made by cutting pieces out of fr079",
        (_study("kidnapped-recording"),),
        _asked(
            ("distance driven until the robot is localised", "found_m/*"), ("loops wrong by more than 1 m", "wrong_loops/*")
        ),
        needs="real/fr079/fr079.mcap",
    ),
    Topic(
        "threshold-sweep-laser",
        "fr079 with a threshold for loops by laser from far too strict to far too loose",
        (_study("threshold-sweep-laser"),),
        _asked(("relation error, held against odometry's", "relation_m/*")),
        needs="real/fr079/fr079.mcap",
    ),
    Topic(
        "threshold-sweep-rgbd",
        "simulated office with a threshold for loops by RGB-D from far too strict to far too loose",
        (_study("threshold-sweep-rgbd"),),
        _asked(("ATE, held against odometry's", "ate_m/*")),
    ),
    Topic(
        "manhattan",
        "manhattanOlson3500, several back-ends",
        (
            Step(
                "hybridmap compare $HYBRIDMAP_DATA/posegraphs/manhattanOlson3500.g2o"
                " --backends odometry,relaxation-ratslam,gtsam-lm,gtsam-gnc",
                (
                    Figure("chi2/odometry"),
                    Figure("chi2/relaxation-ratslam"),
                    Figure("chi2/gtsam-lm", 146.09),
                    Figure("chi2/gtsam-gnc"),
                ),
            ),
        ),
        _asked(
            ("chi2 of odometry", "chi2/odometry"),
            ("chi2 of relaxation", "chi2/relaxation-ratslam"),
            ("chi2 of `gtsam-lm`", "chi2/gtsam-lm"),
        ),
        needs="posegraphs/manhattanOlson3500.g2o",
    ),
    Topic(
        "optima",
        "five standard pose graphs, `gtsam-lm`",
        tuple(
            Step(
                f"hybridmap optimize $HYBRIDMAP_DATA/posegraphs/{name} --backend gtsam-lm",
                (
                    Figure("chi2/gtsam-lm", bar),
                    Figure("chi2_gap/gtsam-lm", 1e-3),
                    Figure("certificate_gap/gtsam-lm", gap),
                    Figure("cpu_s/gtsam-lm", 2.0),
                ),
            )
            for name, bar, gap in _GRAPHS
        ),
        _asked(
            ("chi2, held against 1.001 of the best known", "chi2/gtsam-lm"),
            ("proved gap of chi2 to the least of any map", "chi2_gap/gtsam-lm"),
            ("proved gap of the objective with isotropic noise", "certificate_gap/gtsam-lm"),
            ("CPU time", "cpu_s/gtsam-lm"),
        ),
        needs="posegraphs/city10000.g2o",
    ),
    Topic(
        "false-loops-intel",
        "false loops on intel, `gtsam-gnc`, ten seeds",
        (_study("false-loops-intel"),),
        _asked(
            ("10 and 40 % false: share of seeds with an ATE within 5 cm", "within_5_cm mean/*"),
            ("10 and 40 % false: ATE", "ate_m/*10 %/* | ate_m/*40 %/*"),
            ("10 and 40 % false: true loops lost", "own_lost_percent/*"),
            ("10 and 40 % false: false loops kept", "false_kept/*"),
            ("70 % false: ATE, median over the seeds", "ate_m median/*70 %/*"),
            ("70 % false: ATE", "ate_m/*70 %/*"),
        ),
        needs="posegraphs/intel.g2o",
    ),
    Topic(
        "false-loops-manhattan",
        "10 to 40 % false loops on manhattanOlson3500, `gtsam-gnc`, three seeds",
        (_study("false-loops-manhattan"),),
        _asked(("random: ATE", "ate_m/*random*"), ("aliased: ATE", "ate_m/*aliased*")),
        needs="posegraphs/manhattanOlson3500.g2o",
    ),
    Topic(
        "false-loops-relaxation",
        "up to 10 % false loops on intel, `relaxation-robust`, ten seeds",
        (_study("false-loops-relaxation"),),
        _asked(("ATE", "ate_m/*relaxation-robust")),
        needs="posegraphs/intel.g2o",
    ),
    Topic(
        "bent-odometry",
        "intel and manhattanOlson3500 with a heading bias of 3.4 deg/m added to the odometry, `gtsam-calibrated`",
        (_study("bent-odometry"),),
        _asked(("ATE", "ate_m/*gtsam-calibrated"), ("true loops lost", "own_lost_percent/*gtsam-calibrated")),
        needs="posegraphs/intel.g2o",
    ),
    Topic(
        "cells",
        "cells compared with exact integration over 230 m",
        (Step('python -m pytest -q -m slow tests/neural -k "230_m"', holds="within_their_bars"),),
        _asked(("modules within 0.5 % of their spacing, position within 0.3 mm, three seeds", "within_their_bars")),
    ),
    Topic(
        "verify",
        "cells compared with physiology, three seeds",
        tuple(
            Step(f"hybridmap verify --seed {seed} --out verify-{seed}", own_bars=True, wall_bar_s=180.0)
            for seed in (1, 7, 2026)
        ),
        _asked(
            ("gridness", "verify/gridness"),
            ("orientation of the bands", "verify/band_orientation"),
            ("period of the bands", "verify/band_period"),
            ("phase error over the spacing", "verify/phase_error_relu_*"),
            ("position over 240 m, ReLU", "verify/position_room_relu"),
            ("cells with a single field", "verify/place_single_recruited"),
            ("one bump in the attractor", "verify/attractor_one_bump_*"),
            (
                "other errors, each against its own bar",
                "verify/head_direction_* | verify/phase_error_softplus_* | verify/position_corridor_* |"
                " verify/position_room_softplus | verify/no_shadow_*",
            ),
        ),
    ),
    Topic(
        "calibration",
        "end error of calibrated odometry in % of that of raw odometry, on the second half of each log",
        (Step("python tools/calibration_study.py --data $HYBRIDMAP_DATA/real --out $OUT", own_bars=True),),
        _asked(
            ("fr079 and aces, windows of 16.8 m", "end_error/fr079-16.8m-* | end_error/aces-16.8m-*"),
            ("fr079 and aces, windows of 70 m", "end_error/fr079-70m-* | end_error/aces-70m-*"),
            ("five robots with motion capture, windows of 16.8 m", "end_error/mrclam6-*"),
            ("number of these robots that calibration improves", "better/mrclam6-*"),
        ),
        needs="real/mrclam6",
    ),
    Topic(
        "cost-backends",
        "CPU time of the back-ends, as ratios within one run",
        (Step("python tools/backend_bench.py sweep overhead gnc isam2 --data $HYBRIDMAP_DATA", own_bars=True),),
        _asked(
            ("sweep of relaxation, times as fast as plain Python", "speed/relaxation-*"),
            ("`gtsam-lm` over GTSAM alone", "overhead/*"),
            ("`gtsam-gnc`, times as fast as GTSAM's own GNC", "speed_gnc/*"),
            ("one batch optimisation over the median update of `gtsam-isam2`", "updates_a_batch/*"),
            ("chi2 of `gtsam-isam2` over that of batch", "chi2_last_update/* | chi2_at_the_end/*"),
        ),
        needs="posegraphs/city10000.g2o",
    ),
    Topic(
        "speed-cells",
        "speed of the cells on one core",
        (Step("python tools/bench_neural.py", own_bars=True),),
        _asked(
            ("sheets of grid cells, times as fast as plain `numpy.fft`", "sheets_over_baseline/*"),
            ("path integrator at 100 Hz, times real time", "x_real_time_at_100_Hz/*"),
        ),
    ),
    Topic(
        "speed-matching",
        "search for known places among 1,000 to 100,000 nodes",
        (Step("python tools/bench_matching.py", own_bars=True),),
        _asked(
            ("time over that of `cv2.batchDistance` alone", "search_over_bare/*"),
            ("times as fast as plain numpy", "numpy_over_search/*"),
            ("time of a gated search over that on the smallest map", "gated_against_the_smallest/*"),
        ),
    ),
)

PARTS = {
    "Maps": ("demo", "fr079", "aces", "office", "hololens", "rgbd-drives", "rgbd-cost"),
    "What may go wrong": (
        *(
            "rgbd-robustness",
            "laser-robustness",
            "kidnapped",
            "kidnapped-recording",
            "threshold-sweep-laser",
            "threshold-sweep-rgbd",
        ),
    ),
    "Back-ends on standard graphs": (
        *("manhattan", "optima", "false-loops-intel", "false-loops-manhattan", "false-loops-relaxation", "bent-odometry"),
    ),
    "Cells and odometry": ("cells", "verify", "calibration"),
    "Speed": ("cost-backends", "speed-cells", "speed-matching"),
}
"""Heading on the page -> names of its topics."""


@dataclass(frozen=True)
class Headline:
    """A line of the table in the README: one error of odometry and of the map, both in m."""

    topic: str
    label: str
    odometry: str
    mapped: str


def _headline(topic: str, label: str, measure: str) -> Headline:
    return Headline(topic, label, f"{measure}/odometry", f"{measure}/gtsam-gnc")


HEADLINES = (
    _headline("demo", "demo, simulated laboratory, RGB-D: ATE", "ate_rmse"),
    _headline("office", "two laps of a simulated office, RGB-D: ATE", "ate_rmse"),
    _headline("hololens", "a real office, hand-held RGB-D: ATE", "ate_rmse"),
    _headline("fr079", "fr079, real wheels and laser: mean relation error", "relation_trans_mean"),
    _headline("aces", "aces, real wheels and laser: mean relation error", "relation_trans_mean"),
)
