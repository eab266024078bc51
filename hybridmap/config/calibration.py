"""Settings of the calibration while driving."""

from __future__ import annotations

from pydantic import Field

from hybridmap.config.section import Section


class CalibrationConfig(Section):
    """Odometry gains estimated from the map as it grows; every change is logged, and kept in the map file."""

    online: bool = False
    """Change the path integrator's gains while driving, where the estimate differs from those in use by three sigma."""
    first_m: float = Field(default=50.0, gt=0)
    """Travel before the first estimate, m."""
    every_m: float = Field(default=25.0, gt=0)
    """Travel between two estimates, m."""
