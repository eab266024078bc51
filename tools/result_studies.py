"""The studies behind `docs/results.md`: commands, the figures that are taken from them, and the bars they are held against."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """A figure of a command's `--json`; `PRIMARY` in its name stands for the session's primary back-end.

    Attributes:
        name: of the metric.
        bar: what it is held against.
        at_least: the bar is a lower one.
    """

    name: str
    bar: float | None = None
    at_least: bool = False


@dataclass(frozen=True)
class Step:
    """One command.

    Attributes:
        command: as one would type it; `$HYBRIDMAP_DATA` is the folder of recordings.
        figures: taken from its `--json`.
        own_bars: every figure that the command itself holds against a bar is taken.
        wall_bar_s: its wall time is a figure, held against this.
        holds: what is shown by the command's success; without it a failing command is an error.
        same_graph: the graph must be that of the steps before.
    """

    command: str
    figures: tuple[Figure, ...] = ()
    wall_bar_s: float | None = None
    holds: str = ""
    same_graph: bool = False
    own_bars: bool = False


@dataclass(frozen=True)
class Study:
    """Steps that are run one after the other in one empty folder."""

    name: str
    title: str
    about: str
    steps: tuple[Step, ...]
    needs: str = ""


OFFICE = (Figure("ate_rmse/PRIMARY", 0.20),)


def _survival(shares: tuple[str, ...], worst_m: float, seeds: int | None) -> tuple[Figure, ...]:
    """Figures of `gtsam-gnc` at some shares of false loops: worst error, seeds within 5 cm of ten (else the median), counts."""
    found = []
    for where in (f"gtsam-gnc-{mode}-{share}" for share in shares for mode in ("random", "aliased")):
        usual = Figure(f"within_5_cm/{where}", seeds, at_least=True) if seeds else Figure(f"ate_median/{where}", 0.05)
        counts = Figure(f"true_lost/{where}", 0.5 if seeds else None), Figure(f"false_kept/{where}", 2 if seeds else None)
        found += [usual, Figure(f"ate_max/{where}", worst_m), *counts]
    return tuple(found)


STUDIES = (
    Study(
        "demo",
        "The demo",
        "A laboratory of 10 x 3 m, rendered, driven and mapped with RGB-D; errors against the simulated truth.",
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
    ),
    Study(
        "fr079",
        "fr079: an office building, laser, badly drifting wheels",
        "A real log, mapped with no other option; errors of the published verified relations.",
        (
            Step(
                "hybridmap map $HYBRIDMAP_DATA/real/fr079/fr079.mcap --out fr079",
                (Figure("cpu_s_per_min", 1.5), Figure("nodes")),
            ),
            Step(
                "hybridmap evaluate fr079 --relations $HYBRIDMAP_DATA/real/fr079/relations.txt",
                (
                    Figure("relation_trans_mean/odometry"),
                    Figure("relation_trans_mean/PRIMARY", 0.048),
                    Figure("relation_rot_mean/PRIMARY"),
                    Figure("relation_loop_trans_mean/odometry"),
                    Figure("relation_loop_trans_mean/PRIMARY", 0.070),
                ),
            ),
            Step(
                "hybridmap compare fr079 --backends odometry,relaxation-ratslam,gtsam-lm,gtsam-isam2,gtsam-cauchy,gtsam-gnc",
                tuple(
                    Figure(f"chi2/{name}")
                    for name in ("odometry", "relaxation-ratslam", "gtsam-lm", "gtsam-isam2", "gtsam-cauchy", "gtsam-gnc")
                ),
            ),
        ),
        needs="real/fr079/fr079.mcap",
    ),
    Study(
        "aces",
        "aces: a building of corridors, laser, few loops",
        "A real log, mapped with no other option; errors of the published verified relations.",
        (
            Step(
                "hybridmap map $HYBRIDMAP_DATA/real/aces/aces.bag --out aces", (Figure("cpu_s_per_min", 1.5), Figure("nodes"))
            ),
            Step(
                "hybridmap evaluate aces --relations $HYBRIDMAP_DATA/real/aces/relations.txt",
                (
                    Figure("relation_trans_mean/odometry"),
                    Figure("relation_trans_mean/PRIMARY", 0.040),
                    Figure("relation_rot_mean/PRIMARY"),
                    Figure("relation_loop_trans_mean/odometry"),
                    Figure("relation_loop_trans_mean/PRIMARY", 0.060),
                ),
            ),
        ),
        needs="real/aces/aces.bag",
    ),
    Study(
        "office",
        "office: two laps of a simulated office, from four kinds of source",
        "The same drive mapped from the live stream, a ROS 1 bag, a ROS 2 mcap and a TUM folder: the same nodes and edges.",
        (
            Step(
                "hybridmap map office --out live", (Figure("ate_rmse/odometry"), *OFFICE, Figure("ate_rmse/relaxation-ratslam"))
            ),
            Step("hybridmap simulate office --out office.bag"),
            Step("hybridmap map office.bag --config office --out bag", OFFICE, same_graph=True),
            Step("hybridmap simulate office --out office.mcap"),
            Step("hybridmap map office.mcap --config office --out mcap", OFFICE, same_graph=True),
            Step("hybridmap simulate office --out office-tum"),
            Step("hybridmap map office-tum --config office --out tum", OFFICE, same_graph=True),
        ),
    ),
    Study(
        "hololens",
        "A real office, RGB-D, hand-held",
        "Real colour and depth of a hand-held device, with made-up odometry; errors against the device's own tracking.",
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
        needs="real/hololens_office/rgb.txt",
    ),
    Study(
        "rgbd",
        "Revisits, edges and maps of simulated RGB-D drives, five seeds",
        "Recall of revisits, false loops that the robust back-end keeps, errors of the loop edges, their squared errors over "
        "their own covariances (1: calibrated; the bar's other side is 0.5), and the map.",
        (Step("python tools/rgbd_study.py --recordings $OUT --worlds office lab", own_bars=True),),
    ),
    Study(
        "rgbd-cost",
        "The cost of an RGB-D frame",
        "Process time a frame, everything included, at 320 x 240 pixels and 10 Hz with `gtsam-isam2`.",
        (
            Step(
                "python tools/rgbd_study.py --recordings $OUT --worlds office --seeds 1 --camera 320x240@10"
                " --backend gtsam-isam2",
                own_bars=True,
            ),
        ),
    ),
    Study(
        "rgbd-robustness",
        "Worse cameras, worse wheels",
        "Error of the robust map where pictures are spoilt, wheels worse or the camera is another one; its bar is the error of "
        "odometry. Beside it the false loops that the robust back-end keeps.",
        (Step("python tools/rgbd_robustness.py --recordings $OUT", own_bars=True),),
    ),
    Study(
        "carried",
        "Carried away unseen",
        "A robot is carried 20 m away and drives on in a place that it knows. How far until its map has it there, and loops "
        "that are wrong by more than 1 m; by laser and by RGB-D camera.",
        (
            Step("python tools/carried_study.py office --config laser --seeds 1 2 3 4 5", own_bars=True),
            Step("python tools/carried_study.py office --config rgbd --seeds 1 2 3", own_bars=True),
        ),
    ),
    Study(
        "never-harmful",
        "A threshold from far too strict to far too loose",
        "Error of the robust map at each value of an acceptance threshold; its bar is the error of odometry.",
        (
            Step(
                "python tools/threshold_sweep.py $HYBRIDMAP_DATA/real/fr079/fr079.mcap --config laser"
                " --relations $HYBRIDMAP_DATA/real/fr079/relations.txt"
                " --key vision.laser.probes.fit_min --values 0.99 0.95 0.85 0.7 0.5 0.3 0.1 0.01",
                own_bars=True,
            ),
            Step(
                "python tools/threshold_sweep.py office --key vision.rgbd.pnp.min_inliers --values 400 150 60 30 12 8 6 4",
                own_bars=True,
            ),
        ),
        needs="real/fr079/fr079.mcap",
    ),
    Study(
        "manhattan",
        "manhattanOlson3500, one referee",
        "A standard pose graph through several back-ends. Its best known chi2 is 146.08.",
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
        needs="posegraphs/manhattanOlson3500.g2o",
    ),
    Study(
        "optima",
        "Standard pose graphs, the global optimum",
        "From the file's own poses; the bar of chi2 is 1.001 times the best known. Where the gap is proved, no map is better.",
        tuple(
            Step(
                f"hybridmap optimize $HYBRIDMAP_DATA/posegraphs/{name} --backend gtsam-lm",
                (Figure("chi2/gtsam-lm", bar), Figure("certificate_gap/gtsam-lm", gap), Figure("cpu_s/gtsam-lm", 2.0)),
            )
            for name, bar, gap in (
                ("intel.g2o", 45.0492, 1e-6),
                ("CSAIL.g2o", 40.5914, 1e-6),
                ("FR079_P_toro.graph", 37.6093, None),
                ("manhattanOlson3500.g2o", 146.2248, 1e-6),
                ("city10000.g2o", 512.4995, 1e-6),
            )
        ),
        needs="posegraphs/city10000.g2o",
    ),
    Study(
        "false-loops",
        "What survives false loops",
        "Ten seeds on intel and three on manhattanOlson3500; loops at random, and copies of true ones that are moved together. "
        "Errors are against the optimum of the clean graph. Then robust relaxation, and an odometry that pulls to one side by "
        "0.06 rad/m, with no false loop.",
        (
            Step(
                "python tools/false_loop_study.py $HYBRIDMAP_DATA/posegraphs/intel.g2o --seeds 10 --shares 0.1 0.4 0.7",
                (*_survival(("10%", "40%"), 0.15, 9), *_survival(("70%",), 0.30, None)),
            ),
            Step(
                "python tools/false_loop_study.py $HYBRIDMAP_DATA/posegraphs/manhattanOlson3500.g2o --seeds 3"
                " --shares 0.1 0.2 0.4",
                tuple(
                    Figure(f"ate_max/gtsam-gnc-{mode}-{share}", bar)
                    for share in ("10%", "20%", "40%")
                    for mode, bar in (("random", 0.25), ("aliased", 0.05))
                ),
            ),
            Step(
                "python tools/false_loop_study.py $HYBRIDMAP_DATA/posegraphs/intel.g2o --seeds 10 --shares 0 0.05 0.1"
                " --backends relaxation-robust relaxation-ratslam",
                tuple(
                    Figure(f"ate_max/{name}-{mode}-{share}", 0.10 if name == "relaxation-robust" else None)
                    for share in ("0%", "5%", "10%")
                    for mode in ("random", "aliased")
                    for name in ("relaxation-robust", "relaxation-ratslam")
                ),
            ),
            *(
                Step(
                    f"python tools/false_loop_study.py $HYBRIDMAP_DATA/posegraphs/{graph}.g2o --bias 0.06 --shares 0 --seeds 1"
                    " --modes random --backends odometry relaxation-ratslam gtsam-lm gtsam-cauchy gtsam-gnc gtsam-calibrated",
                    (
                        *(
                            Figure(f"ate_max/{name}-random-0%")
                            for name in ("odometry", "relaxation-ratslam", "gtsam-lm", "gtsam-cauchy", "gtsam-gnc")
                        ),
                        Figure("ate_max/gtsam-calibrated-random-0%", 0.5),
                        Figure("true_lost/gtsam-calibrated-random-0%", 1.0),
                    ),
                )
                for graph in ("intel", "manhattanOlson3500")
            ),
        ),
        needs="posegraphs/intel.g2o",
    ),
    Study(
        "cost-backends",
        "The cost of the back-ends",
        "Process time as ratios within one run: a sweep of relaxation against plain Python, `gtsam-lm` against bare GTSAM, "
        "`gtsam-gnc` against GTSAM's own, an update of `gtsam-isam2` against one batch optimisation; and what false edges "
        "leave behind once they are taken out.",
        (Step("python tools/backend_bench.py sweep overhead gnc isam2 --data $HYBRIDMAP_DATA", own_bars=True),),
        needs="posegraphs/city10000.g2o",
    ),
    Study(
        "cells",
        "The cells against exact integration",
        "Decoded from activity alone, against exact integration of the same increments over 230 m.",
        (
            Step(
                'python -m pytest -q -m slow tests/neural -k "230_m"',
                holds="at 30 Hz every module stays within 0.5 % of its spacing, the position within 0.3 mm (3 seeds)",
            ),
        ),
    ),
    Study(
        "verify",
        "The cells against physiology, three seeds",
        "Every row that has a bar; the page of each run shows the maps and curves behind it.",
        tuple(
            Step(f"hybridmap verify --seed {seed} --out verify-{seed}", own_bars=True, wall_bar_s=180.0)
            for seed in (1, 7, 2026)
        ),
    ),
    Study(
        "speed-cells",
        "The speed of the cells",
        "Steps per CPU-second of the sheets against a plain `numpy.fft` implementation of the same dynamics, and of the whole "
        "front-end at 100 Hz, in one run on one core.",
        (Step("python tools/bench_neural.py", own_bars=True),),
    ),
    Study(
        "speed-matching",
        "The speed of the search for known places",
        "Four bands x 64: the exact search against bare `cv2.batchDistance` and plain numpy on the same data, and how the time "
        "a frame grows with spatial gating, in one run on one core.",
        (Step("python tools/bench_matching.py", own_bars=True),),
    ),
    Study(
        "calibration",
        "Calibration of odometry",
        "Trained on the first half of each log, tested on every window of the second: end error of dead reckoning in % of raw. "
        "The table of every row is in docs/calibration.md.",
        (Step("python tools/calibration_study.py --data $HYBRIDMAP_DATA/real --out $OUT", own_bars=True),),
        needs="real/mrclam6",
    ),
)


@dataclass(frozen=True)
class Headline:
    """A line of the README's table: one figure of odometry and of the primary back-end, both in m."""

    study: str
    label: str
    odometry: str
    mapped: str


HEADLINES = (
    Headline("demo", "demo, simulated laboratory, RGB-D: ATE", "ate_rmse/odometry", "ate_rmse/gtsam-gnc"),
    Headline("office", "two laps of a simulated office, RGB-D: ATE", "ate_rmse/odometry", "ate_rmse/gtsam-gnc"),
    Headline("hololens", "a real office, hand-held RGB-D: ATE", "ate_rmse/odometry", "ate_rmse/gtsam-gnc"),
    Headline(
        "fr079",
        "fr079, real wheels and laser: mean relation error",
        "relation_trans_mean/odometry",
        "relation_trans_mean/gtsam-gnc",
    ),
    Headline(
        "aces",
        "aces, real wheels and laser: mean relation error",
        "relation_trans_mean/odometry",
        "relation_trans_mean/gtsam-gnc",
    ),
)
