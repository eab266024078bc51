"""What a drive tells of its odometry's calibration: a value that it does not tell is refused or left as it is, never reported.

A circle driven at one speed says how far the robot turned a metre, and nothing of whether turn gain or heading bias made it so;
the noise of odometry still tells the two columns of the fit apart, and the fit then explains noise.
"""

from __future__ import annotations

import numpy as np

from hybridmap.calibration.estimate import SIGNIFICANT_SIGMAS
from hybridmap.errors import EvaluationError
from hybridmap.geometry import Array

MAX_CONDITION = 400.0
"""Of the information with a unit diagonal: turning a metre that varies by a tenth of its mean. Recorded drives have 1 to 7."""

MIN_TURN = 3.0
"""Root mean square of the legs' turns over their standard deviation; below it odometry's own noise makes up the turns."""

MAX_SIGMA = 1.0 / SIGNIFICANT_SIGMAS
"""Above it an estimate would not even differ significantly from one that is wrong by 1, 1, 1 rad/m or 1 s."""

DELAY_LIMIT_S = 1.0
"""As far as `sensors.odometry_delay_s` goes."""


class NotToldError(EvaluationError):
    """A drive that leaves open what was asked of it."""


def require_told(slope: Array) -> None:
    """Refuse legs whose headings do not tell the unknowns.

    Args:
        slope: (L, K) derivatives of the whitened (and weighted) headings by turn gain, heading bias and, with K = 3, delay.

    Raises:
        NotToldError: the legs hardly turn, or two unknowns do the same to all of them.
    """
    turn = float(np.sqrt(np.mean(slope[:, 0] ** 2)))
    if not turn >= MIN_TURN:
        raise NotToldError(
            f"calibration: the drive does not tell the turn gain: found legs that turn by {turn:.1f} standard deviations of "
            f"their heading where it takes {MIN_TURN:g}; expected one that turns"
        )
    condition = condition_number(slope)
    if not condition <= MAX_CONDITION:
        raise NotToldError(
            f"calibration: the drive does not tell turn gain and heading bias apart: found a condition number of "
            f"{condition:.2g}, expected at most {MAX_CONDITION:g}; give one that goes straight as well as it turns"
        )


def require_delay(delay_s: float) -> float:
    """The delay, if it is one that a sensor's clock may have.

    Raises:
        EvaluationError: it is beyond `DELAY_LIMIT_S`.
    """
    if abs(delay_s) <= DELAY_LIMIT_S:
        return delay_s
    raise EvaluationError(
        f"calibration: found a delay of {delay_s:.2f} s between odometry and the poses, expected at most {DELAY_LIMIT_S:g} s; "
        f"are both on one clock?"
    )


def condition_number(slope: Array) -> float:
    """Condition number of the information matrix of a slope (L, K), each unknown in units of its own information."""
    norms = np.linalg.norm(slope, axis=0)
    if not (np.isfinite(norms).all() and np.all(norms > 0.0)):
        return float("inf")
    return float(np.linalg.cond(slope / norms)) ** 2
