"""The table of the verification: one metric per row, with the limit (bar) that it must keep."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hybridmap.geometry import Array
from hybridmap.metrics import Metric
from hybridmap.verification.laps import CLOSURE_M, LAPS_NOISE
from hybridmap.verification.path_error import VON_MISES, PathErrors
from hybridmap.verification.physiology import gridness, ideal_map, tuning_width, vector_length
from hybridmap.verification.rate_maps import PlaceResult
from hybridmap.verification.shadow import STEPS_ON
from hybridmap.verification.single_cells import CHANCE, HEADING, SCORES, PathVerification
from hybridmap.verification.verification import CellVerification

PHASE_BAR_PERCENT = {"relu": 0.6, "softplus": 0.02}
ROOM_BAR_MM, CORRIDOR_BAR_MM = 0.5, 0.1
RECALIBRATED_BAR_M = 0.15
_SHADOW_BAR = 1e-6
_ONE_BUMP_BAR_PERCENT = 99.0
_LEARNT = {"recruited": "recruited place cells", "printed": "place cells by the printed rule"}
_SPACING_OF_BARS_M = 0.12  # that of the finest grid for which the bars in metres hold; errors grow with it
_HEADING_BAR_RAD = 1e-9
_SCORE_NAMES = {
    "sargolini": ("1", "grid score after Sargolini"),
    "langston": ("1", "grid score after Langston"),
    "information": ("bits/spike", "spatial information"),
    "vector_length": ("1", "mean vector length of the tuning"),
}
_AT_MOST, _AT_LEAST = "at most", "at least"


def rows_of(result: CellVerification) -> list[Metric]:
    """All rows of the verification's table, named `verify/<row>`; a row with a limit states whether it keeps it."""
    parts: Sequence[Callable[[CellVerification], list[Metric]]] = (
        head_direction_rows,
        band_rows,
        gridness_rows,
        phase_rows,
        position_rows,
        shadow_rows,
        place_rows,
        recurrence_rows,
        standstill_rows,
        noise_rows,
        recalibration_rows,
        kernel_rows,
    )
    return [row for part in parts for row in part(result)]


def _row(name: str, value: float, unit: str, description: str, bar: float | None = None, side: str = _AT_MOST) -> Metric:
    if bar is None:
        return Metric(f"verify/{name}", value, unit, description)
    passed = value >= bar if side == _AT_LEAST else value <= bar  # NaN passes neither
    return Metric(f"verify/{name}", value, unit, f"{description}; {side} {bar:g}", bar, bool(passed))


def head_direction_rows(result: CellVerification) -> list[Metric]:
    """Rows on the head-direction ring: error of the decoded heading after many turns, and modulation by the turn rate."""
    heading = result.head_direction
    gain = float(heading.rates[-1].max() / heading.rates[0].max())
    fastest = heading.turn_rates_rad_s[-1]
    return [
        _row(
            "head_direction_float64", heading.error_rad["float64"], "rad", "decoded heading against the sum of the turns", 1e-9
        ),
        _row("head_direction_float32", heading.error_rad["float32"], "rad", "the same in float32", 1e-3),
        _row("head_direction_von_mises", heading.error_rad["von_mises"], "rad", "the same, sharper tuning (von Mises)", 1e-9),
        *(
            row
            for name, tuning in (("cosine", "the paper's cosine"), ("von_mises", f"von Mises, concentration {VON_MISES:g}"))
            for row in (
                _row(
                    f"tuning_width_{name}", np.degrees(tuning_width(heading.curves[name])), "deg", f"at half height: {tuning}"
                ),
                _row(f"tuning_vector_{name}", vector_length(heading.curves[name]), "1", f"mean vector length: {tuning}"),
            )
        ),
        _row(
            "turn_rate_modulation",
            gain,
            "1",
            f"peak rate shown at {fastest:g} rad/s over that at rest; for display, no other cell sees it",
        ),
    ]


def band_rows(result: CellVerification) -> list[Metric]:
    """Rows on the band cells: orientation and period of every band, from rate maps."""
    lattice = result.lattice
    orientation = float(lattice.band_orientation_error_deg.max())
    period = 100.0 * float(lattice.band_period_error.max())
    return [
        _row("band_orientation", orientation, "deg", "worst band, from the FFT of its rate map", 0.5),
        _row("band_period", period, "%", "worst band, from the FFT of its rate map", 2.0),
    ]


def gridness_rows(result: CellVerification) -> list[Metric]:
    """Rows on the grid score, mostly Sargolini's: of the sampled cells, of an ideal map, and of cells on a square lattice."""
    scores = result.lattice.gridness
    spacings = result.lattice.spacings_m / result.lattice.pitch_m
    side = result.lattice.grid.shape[-1]
    ideal = min(gridness(ideal_map(side, spacing, 0.1)) for spacing in spacings)
    return [
        _row(
            "gridness", float(scores.min()), "1", f"worst of {scores.size} grid cells in {len(scores)} modules", 1.1, _AT_LEAST
        ),
        _row("gridness_median", float(np.median(scores)), "1", "median of the same cells"),
        _row("gridness_langston", float(result.lattice.langston.min()), "1", "worst of the same cells by Langston's score"),
        _row("gridness_ideal", ideal, "1", "ideal map (three plane waves) of the same size, by the same code"),
        _row("gridness_square", float(np.median(result.square.gridness)), "1", "median with orthogonal bands, square metric"),
    ]


def phase_rows(result: CellVerification) -> list[Metric]:
    """Rows on the phase error of the worst grid module over all drives, per rectifier and step rate."""
    return [
        _row(
            f"phase_error_{rectifier}_{hz:g}hz",
            100.0 * max(float(path.module.max()) for path in paths),
            "%",
            f"of the spacing: worst module on {len(paths)} drives of {paths[0].distance_m[-1]:.0f} m",
            PHASE_BAR_PERCENT[rectifier],
        )
        for (rectifier, hz), paths in result.room.items()
    ]


def position_rows(result: CellVerification) -> list[Metric]:
    """Rows on the error of the position decoded from all modules, in the room and down the corridor."""
    rows = []
    for rectifier, corridor in result.corridor.items():
        drives = [path for (f, _), paths in result.room.items() if f == rectifier for path in paths]
        room = 1e3 * max(float(path.position_m.max()) for path in drives)
        what = f"all modules together, largest error on {len(drives)} drives in 10 x 3 m"
        rows.append(_row(f"position_room_{rectifier}", room, "mm", what, ROOM_BAR_MM))
        down = 1e3 * float(corridor.position_m.max())
        rows.append(_row(f"position_corridor_{rectifier}", down, "mm", "the same down a 16.8 m corridor", CORRIDOR_BAR_MM))
    return rows


def shadow_rows(result: CellVerification) -> list[Metric]:
    """Rows on overwritten activity: whether the decoded pose moves by exactly its shift, and which cells hold the position."""
    at_once = "spacings by which the pose misses a shift written into the sheets"
    on = f"the same with rings and sheets shifted together, largest over {STEPS_ON} steps of driving on"
    rows = [
        row
        for rectifier, ending, bar in (("softplus", "", _SHADOW_BAR), ("relu", "_relu", None))
        for row in (
            _row(f"no_shadow_integrator{ending}", float(result.overwritten[rectifier].at_once.max()), "1", at_once, bar),
            _row(f"no_shadow_driving_on{ending}", result.overwritten[rectifier].driving_on, "1", on, bar),
        )
    ]
    shown, shift_mm = result.overwritten["softplus"].shown, 1e3 * result.overwritten["softplus"].shift_m
    for stripes, ending, how in ((True, "", ""), (False, "_without_stripes", " (band_drive 0)")):
        for cells in ("sheets", "rings"):
            what = f"of {shift_mm:.0f} mm written into the {cells} alone is in the pose {STEPS_ON} steps later{how}, softplus"
            rows.append(_row(f"shift_of_{cells}{ending}", 100.0 * float(shown[cells, stripes][-1]), "%", what))
    return rows


def place_rows(result: CellVerification) -> list[Metric]:
    """Rows on the share of place cells with a single field, with and without recruitment."""
    place = result.place
    recruited = f"of {len(place.recruited.fields)} recruited place cells have one field"
    printed = f"of {len(place.printed.fields)} cells by the printed rule have one field"
    sampled, of = len(result.room_fields.sampled.fields), result.room_fields.recruited
    room = f"of {sampled} of the {of} cells recruited on a drive through 10 x 3 m have one field in all of it"
    return [
        _row("place_single_recruited", 100.0 * place.recruited.single, "%", recruited, 95.0, _AT_LEAST),
        _row("place_single_printed", 100.0 * place.printed.single, "%", printed),
        _row("place_single_room", 100.0 * result.room_fields.sampled.single, "%", room, 95.0, _AT_LEAST),
    ]


def recurrence_rows(result: CellVerification) -> list[Metric]:
    """Rows on recurrent competition in the attractor sheet: places with one bump, cells with one field, with and without."""
    rows, place = [], result.place
    for learnt, cells in _LEARNT.items():
        for stage, how in (("input", "without competition"), ("settled", "after settled competition")):
            bumps = f"of the places at which the attractor's sheet holds one bump, {how}, driven by {cells}"
            bar = _ONE_BUMP_BAR_PERCENT if stage == "settled" else None
            one_bump = 100.0 * place.one_bump[learnt, stage]
            rows.append(_row(f"attractor_one_bump_{learnt}_{stage}", one_bump, "%", bumps, bar, _AT_LEAST))
            what = f"of the attractor's cells have one field, {how}, driven by {cells}"
            rows.append(_row(f"attractor_single_{learnt}_{stage}", 100.0 * place.sheet[learnt, stage].single, "%", what))
    return rows


def recurrence_verdict(place: PlaceResult) -> str:
    """Sentences on the effect of recurrent competition on the attractor sheet, for each kind of place cells, on one line."""
    sentences = []
    for learnt, cells in _LEARNT.items():
        before, after = (100.0 * place.sheet[learnt, stage].single for stage in ("input", "settled"))
        several, one = (100.0 * place.one_bump[learnt, stage] for stage in ("input", "settled"))
        sentences.append(
            f"Behind {cells}, settled competition {verb_of_change(after - before)} the share of the attractor's cells with a "
            f"single field ({before:.1f} % before, {after:.1f} % after). The sheet holds one bump at a time in {several:.1f} % "
            f"of the places before and in {one:.1f} % after."
        )
    return " ".join(sentences)


def verb_of_change(percent: float) -> str:
    """The verb for a change in per cent of all cells: `does not change`, `hardly changes`, `raises` or `lowers`."""
    if abs(percent) < 0.5:
        return "does not change"
    return "hardly changes" if abs(percent) < 5.0 else "raises" if percent > 0.0 else "lowers"


def standstill_rows(result: CellVerification) -> list[Metric]:
    """Rows on standing still: with the path integrator as it is, and with its dynamics kept running."""
    still = result.standstill
    rows = [_row("standing_still", still.pose_change, "m", "largest change of the pose over all steps without motion", 0.0)]
    for rectifier, crept in still.ungated.items():
        what = f"of the spacing that the worst sheet crept with its dynamics running on, {rectifier}"
        rows.append(_row(f"standing_still_ungated_{rectifier}", 100.0 * crept, "%", what))
    return rows


def noise_rows(result: CellVerification) -> list[Metric]:
    """Rows on the drift that neuron noise causes."""
    rows = []
    for share, drives in result.noise.items():
        curve = noise_curve(drives)
        low, high = curve.quartiles[:, -1]
        what = (
            f"RMS position error of {len(drives)} drives after {curve.distance_m[-1]:.0f} m with {100.0 * share:g} % noise on "
            f"every rate, every step; half of them between {low:.3g} and {high:.3g} m"
        )
        rows.append(_row(f"noise_{100.0 * share:g}_percent", float(curve.rms[-1]), "m", what))
    return rows


def recalibration_rows(result: CellVerification) -> list[Metric]:
    """Rows on recalibration: where in the map noisy cells show the robot on laps of the office, with closures and without."""
    percent, rows = 100.0 * LAPS_NOISE, []
    for name, laps, how, bar in (
        ("recalibrated", result.recalibrated, f"a closure every {CLOSURE_M:g} m", RECALIBRATED_BAR_M),
        ("not_recalibrated", result.alone, "no closures", None),
    ):
        what = (
            f"largest error of the place in the map that the cells show, from the second lap on, over "
            f"{laps.distance_m[-1]:.0f} m of laps of {laps.lap_m:.0f} m with {percent:g} % noise and {how}"
        )
        rows.append(_row(f"{name}_{percent:g}_percent", float(laps.error_m.max()), "m", what, bar))
    return rows


@dataclass(frozen=True, slots=True)
class NoiseCurve:
    """Errors of several drives over distance: of position, m, or of heading, rad, as asked for (`noise_curve`).

    Attributes:
        distance_m: (S,) distances that all drives reach.
        rms: (S,) root mean square of the error over the drives.
        quartiles: (2, S) lower and upper quartile of the error over the drives.
    """

    distance_m: Array
    rms: Array
    quartiles: Array


def noise_curve(drives: Sequence[PathErrors], what: Literal["position_m", "heading_rad"] = "position_m") -> NoiseCurve:
    """Statistics of the position errors, m, or heading errors, rad, of drives with the same noise, as far as all of them go."""
    count = min(len(drive.distance_m) for drive in drives)
    errors = np.array([getattr(drive, what)[:count] for drive in drives])
    rms = np.sqrt((errors**2).mean(axis=0))
    return NoiseCurve(drives[0].distance_m[:count], rms, np.quantile(errors, (0.25, 0.75), axis=0))


def kernel_rows(result: CellVerification) -> list[Metric]:
    """Rows on whether the instability of the paper's printed kernel is detected and reported."""
    named = float("do not settle" in result.printed_kernel)
    return [_row("printed_kernel_refused", named, "1", "the instability of the printed kernel is named", 1.0, _AT_LEAST)]


def path_rows(result: PathVerification) -> list[Metric]:
    """All rows on the cells along a recorded path, named `verify/<row>`; only path integration has bars."""
    track, errors = result.track, result.errors
    spacing_m = float(result.spacings_m.min())
    position_mm, heading = 1e3 * float(errors.position_m.max()), float(errors.heading_rad.max())
    bar_mm = ROOM_BAR_MM * spacing_m / _SPACING_OF_BARS_M
    phase_bar = PHASE_BAR_PERCENT[str(result.settings.get("rectifier", "relu"))]
    lost_s = float(np.count_nonzero(~track.known)) / track.drive.hz
    return [
        _row("path_duration", float(track.stamps_s[-1]), "s", "of the recorded path"),
        _row("path_unknown", lost_s, "s", "of it without positions less than a second apart: nothing is counted there"),
        _row("path_length", float(track.drive.distance_m[-1]), "m", "length of the path at the steps of the cells"),
        _row("path_reached", 100.0 * float(result.arena.reached.mean()), "%", "of the bins of its bounding box have a rate"),
        _row("path_position", position_mm, "mm", "largest error of the position decoded from the cells", bar_mm),
        _row("path_phase", 100.0 * float(errors.module.max()), "%", "of the spacing: phase error, worst module", phase_bar),
        _row("path_heading", heading, "rad", "largest error of the decoded heading", _HEADING_BAR_RAD),
        *(row for kind, names in SCORES.items() for name in names for row in _score_rows(result, kind, name)),
        _row("head_direction_width", _median_width_deg(result), "deg", "width of the tuning at half height, median"),
    ]


def _score_rows(result: PathVerification, kind: str, name: str) -> list[Metric]:
    """Median of a score over the cells of a kind, median of what chance gives them, and how many exceed that."""
    scores = np.array([found.scores[name] for _, _, found in result.of_kind(kind)])
    chance = np.array([found.chance[name] for _, _, found in result.of_kind(kind)])
    stem = f"{kind.replace('-', '_')}_{name}"
    unit, words = _SCORE_NAMES[name]
    above = 100.0 * float((scores > chance).mean())  # NaN, a cell without a score, is not above
    quantile = f"{100.0 * CHANCE:g} % quantile of its spikes shifted in time"
    return [
        _row(stem, _median(scores), unit, f"{words}, median of {len(scores)} {kind} cells"),
        _row(f"{stem}_chance", _median(chance), unit, f"{quantile}, median"),
        _row(f"{stem}_above", above, "%", "of these cells score above their own quantile"),
    ]


def _median_width_deg(result: PathVerification) -> float:
    return float(np.degrees(_median(np.array([found.width_rad for _, _, found in result.of_kind(HEADING)]))))


def _median(values: Array) -> float:
    """Median of the values that are numbers; NaN if none is."""
    there = values[np.isfinite(values)]
    return float(np.median(there)) if len(there) else float("nan")
