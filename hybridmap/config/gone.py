"""Settings that have gone: one line for whoever still sets one, and old configurations without them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

# section, module, keys: each key is now the constant KEY in the module (`key:NAME` where it has another name)
_CONSTANTS = """
simulation simulation/stream.py speed_m_s turn_rate_rad_s odometry_rate_hz
simulation.wheels simulation/wheels.py translation_m_per_sqrt_m rotation_deg_per_sqrt_m rotation_per_turn
simulation.wheels simulation/wheels.py slips_per_m slip_m slip_deg
simulation.camera simulation/camera.py forward_m height_m range_min_m depth_noise_m depth_noise_per_m depth_noise_width_px
simulation.camera simulation/camera.py hole_fraction exposure_change color_noise
simulation.laser simulation/laser.py forward_m height_m range_min_m noise_m drop_fraction
neural neural/grid.py softplus_sharpness fourier_modes kernel_gain_first kernel_gain_zero kernel_widths
neural neural/band.py band_cells band_width
neural neural/grid.py decode_box_m
neural neural/path_integrator.py orientation_deg orientation_step_deg neuron_noise_seed
neural.place neural/path_integrator.py theta_hz
neural.place neural/place.py attractor_width_cells
neural.place neural/place.py grid_inputs_side recruit_threshold inhibition max_cells
calibration calibration/online.py first_m every_m
backends.relaxation backends/relaxation/relaxing.py tolerance_m
backends.relaxation backends/relaxation/sweeps.py robust_scale_m robust_scale_rad robust_start
backends.robust backends/gtsam/factors.py huber_scale dcs_phi geman_mcclure_scale
backends.robust backends/judging/weak.py odometry_scale
backends.gnc backends/gtsam/gnc.py chunk_nodes mu_factor max_rounds
backends.consistency backends/judging/consistency.py neighbours
backends.consistency graph/agreement.py quantile
backends.isam2 backends/gtsam/smoother.py relinearize_m relinearize_rad settle_updates
backends.isam2 backends/gtsam/incremental.py patience
"""

RENAMED: dict[str, str] = {}
"""Old dotted key -> the key that has taken its place, with the same meaning."""

_RING = "loops agree by the covariances of the map and of their own"
OTHERWISE: dict[str, str] = {
    "neural.dtype": "every population has double precision",
    "vision.laser.commitment.heading_deg_per_sqrt_m": _RING,
    "vision.laser.relocalising.agree_m": _RING,
    "vision.laser.relocalising.agree_deg": _RING,
    "vision.relocalising.agree_m": _RING,
    "vision.relocalising.agree_deg": _RING,
    "vision.rgbd.closing.support_m": _RING,
    "vision.rgbd.closing.support_deg": _RING,
}
"""Old dotted key -> what there is instead."""


@cache
def constants() -> dict[str, tuple[str, str]]:
    """Old dotted key -> module (path below `hybridmap/`) and name of the constant that it has become."""
    found = {}
    for section, module, *keys in map(str.split, _CONSTANTS.strip().splitlines()):
        for key in keys:
            old, _, name = key.partition(":")
            found[f"{section}.{old}"] = (module, name or old.upper())
    return found


def what_became_of(key: str, value: Any = None) -> str | None:
    """One line on a setting that has gone; None if there never was one.

    Args:
        key: dotted.
        value: what it was set to; where `key` is a section that has gone, its first key is looked up.
    """
    if isinstance(value, Mapping) and value and key not in {*RENAMED, *OTHERWISE}:
        name = next(iter(value))
        return what_became_of(f"{key}.{name}", value[name])
    if key in RENAMED:
        return f"{key} is now called {RENAMED[key]}"
    if key in OTHERWISE:
        return f"{key} is no longer a setting: {OTHERWISE[key]}"
    if key in constants():
        module, name = constants()[key]
        return f"{key} is no longer a setting: it is the constant {name} in hybridmap/{module}"
    return None


def without_gone(tree: Mapping[str, Any], at: str = "") -> dict[str, Any]:
    """A stored configuration without the settings that have gone; those that were renamed have their new names.

    Args:
        tree: nested mapping of sections.
        at: dotted name of the section that it is; empty for the whole configuration.
    """
    kept: dict[str, Any] = {}
    for dotted, value in _leaves(tree, at):
        if dotted in OTHERWISE or dotted in constants():
            continue
        *sections, last = RENAMED.get(dotted, dotted).removeprefix(f"{at}." if at else "").split(".")
        place = kept
        for section in sections:
            place = place.setdefault(section, {})
        place[last] = value
    return kept


def _leaves(tree: Mapping[str, Any], at: str) -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        dotted = f"{at}.{key}" if at else str(key)
        if isinstance(value, Mapping):
            yield from _leaves(value, dotted)
        else:
            yield dotted, value
