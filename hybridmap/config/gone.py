"""Removed and renamed settings: what replaced each, and reading old configurations that still contain them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

# section, module, keys: each key is now the constant KEY in the module (`key:NAME` where it has another name)
_CONSTANTS = """
simulation simulation/surfaces.py speed_m_s
simulation simulation/stream.py turn_rate_rad_s odometry_rate_hz
simulation.wheels simulation/motion.py translation_m_per_sqrt_m rotation_deg_per_sqrt_m rotation_per_turn
simulation.wheels simulation/motion.py slips_per_m slip_m slip_deg
simulation.camera simulation/sensor_models.py forward_m:CAMERA_FORWARD_M height_m:CAMERA_HEIGHT_M
simulation.camera simulation/sensor_models.py range_min_m:CAMERA_RANGE_MIN_M range_max_m:CAMERA_RANGE_MAX_M
simulation.camera simulation/sensor_models.py depth_noise_m depth_noise_per_m depth_noise_width_px
simulation.camera simulation/sensor_models.py hole_fraction exposure_change color_noise
simulation.laser simulation/sensor_models.py forward_m:LASER_FORWARD_M height_m:LASER_HEIGHT_M
simulation.laser simulation/sensor_models.py range_min_m:LASER_RANGE_MIN_M noise_m:LASER_NOISE_M drop_fraction
neural neural/grid.py softplus_sharpness fourier_modes kernel_gain_first kernel_gain_zero kernel_widths
neural neural/rings.py band_cells band_width
neural neural/grid.py decode_box_m
neural neural/path_integrator.py orientation_deg orientation_step_deg neuron_noise_seed
neural.place neural/path_integrator.py theta_hz
neural.place neural/place.py attractor_width_cells
neural.place neural/place.py grid_inputs_side recruit_threshold inhibition max_cells
calibration calibration/online.py first_m every_m
backends.relaxation backends/relaxation/ratslam.py tolerance_m
backends.relaxation backends/relaxation/ratslam.py robust_scale_m robust_scale_rad robust_start
backends.robust backends/gtsam/factors.py huber_scale dcs_phi geman_mcclure_scale
backends.robust backends/objective.py odometry_scale
backends.gnc backends/gtsam/gnc.py chunk_nodes mu_factor max_rounds
backends.consistency backends/judging/prefilter.py neighbours
backends.consistency graph/agreement.py quantile
backends.isam2 backends/gtsam/incremental.py relinearize_m relinearize_rad settle_updates
backends.isam2 backends/gtsam/incremental.py patience
vision.templates vision/templates.py threshold stable_frames
vision.relocalising vision/relocalising.py support mismatch_max mismatch_scale wait_m
vision.relocalising vision/rgbd/closing.py span_m doubt_nodes:UNCERTAIN_NODES unrecognised_nodes known_m known_deg:KNOWN_RAD
vision.relocalising vision/rgbd/global_search.py separation doubtful_m:UNCERTAIN_M
vision.laser.scan vision/laser/cloud.py range_max_m cell_m
vision.laser.registration vision/laser/cloud.py reach_m:PARTNER_M field_sigma_m
vision.laser.registration vision/laser/scan_matching.py cauchy_scale_m:CAUCHY_CELLS inlier_m:INLIER_CELLS
vision.laser.registration vision/laser/scan_matching.py iterations sigma_m spurious
vision.laser.tracking vision/laser/tracking.py submap_nodes narrow wide lost inliers_sure contradiction_m contradiction_deg
vision.laser.tracking vision/laser/tracking.py floor_m floor_deg
vision.laser.tracking vision/laser/checks.py inliers_min inliers_weak translation_max_m
vision.laser.probes vision/laser/hypotheses.py length_m target_every_m target_half_m points gate_inflation gate_m gate_deg
vision.laser.probes vision/laser/hypotheses.py window_m targets modes_per_target modes modes_sure floor_m floor_deg
vision.laser.probes vision/laser/checks.py near_min violation_max loosest_max_m ambiguity_max
vision.laser.commitment vision/laser/commitment.py wait_m probes span_m span_per_efold_m
vision.laser.commitment vision/laser/hypotheses.py sure_sigma_m
vision.laser.commitment vision/laser/checks.py rival
vision.laser.relocalising vision/relocalising.py support mismatch_max mismatch_scale wait_m
vision.laser.relocalising vision/laser/kidnapping.py span_m unrecognised_probes from_m often_m submaps misfit
vision.laser.relocalising vision/laser/kidnapping.py map_violation sure_m
vision.laser.relocalising vision/laser/checks.py contradiction_sigmas violation:WAY_VIOLATION
vision.laser.relocalising vision/laser/hypotheses.py modes:MODES_ANYWHERE
vision.laser.revisits vision/laser/revisits.py radius_m partners probe_half_m target_half_m
vision.laser.revisits vision/laser/panorama.py every_m apart_m
vision.laser.revisits vision/laser/revisits.py search_m search_deg ambiguous_m floor_m floor_deg
vision.laser.retrace vision/laser/dense_trajectory.py block_nodes radius_m map_nodes prior_m prior_deg
vision.laser.retrace vision/laser/dense_trajectory.py inliers_min off_max_m off_max_deg
vision.rgbd.features vision/rgbd/features.py count fast_threshold ratio
vision.rgbd.registration vision/rgbd/tracking.py back keypoint_reach_m translation_floor_m:FLOORS rotation_floor_deg:FLOORS
vision.rgbd.registration vision/rgbd/tracking.py held_translation_floor_m:HELD_FLOORS held_rotation_floor_deg:HELD_FLOORS
vision.rgbd.registration vision/rgbd/depth_grid.py grid_px grid_columns
vision.rgbd.registration vision/rgbd/depth_registration.py iterations max_distance_m max_normal_deg min_points correlation
vision.rgbd.registration vision/rgbd/noise_level.py noise_factor
vision.rgbd.registration vision/rgbd/checks.py min_inliers:DEPTH_INLIERS_MIN contradiction_sigma
vision.rgbd.pnp vision/rgbd/checks.py min_inliers_alone max_height_m max_tilt_deg agree_m:REVERSE_M agree_deg:REVERSE_DEG
vision.rgbd.pnp vision/rgbd/checks.py map_inliers map_overlap map_points map_sigma_m
vision.rgbd.pnp vision/rgbd/pnp.py reprojection_px iterations
vision.rgbd.pnp vision/rgbd/pnp.py translation_floor_m:FLOORS rotation_floor_deg:FLOORS
vision.rgbd.pnp vision/rgbd/pnp.py held_translation_floor_m:HELD_FLOORS held_rotation_floor_deg:HELD_FLOORS
vision.rgbd.closing vision/rgbd/closing.py gate_per_m gate_growth_m heading_deg heading_deg_per_m accept separation
vision.rgbd.closing vision/rgbd/closing.py pending_nodes shift_sigma_m shift_sigma_deg
vision.rgbd.closing vision/rgbd/closing.py repropose_m repropose_per_node repropose_online
vision.rgbd.closing vision/rgbd/revisits.py repropose_sigma_m:MAP_SIGMA_M repropose_sigma_deg:MAP_SIGMA_DEG
vision.rgbd.closing vision/rgbd/support.py support_nodes
vision.rgbd.closing vision/gating.py min_age_s
vision.rgbd vision/base.py held_images
"""

RENAMED: dict[str, str] = {
    "vision.laser.tracking.enabled": "vision.tracking.enabled",
    "vision.rgbd.registration.enabled": "vision.tracking.enabled",
    "vision.laser.probes.gate_sigmas": "vision.closing.gate_sigmas",
    "vision.rgbd.closing.gate_sigma": "vision.closing.gate_sigmas",
    "vision.laser.revisits.rounds": "vision.closing.revisit_rounds",
    "vision.rgbd.closing.repropose_rounds": "vision.closing.revisit_rounds",
    "vision.laser.retrace.enabled": "vision.laser.dense_trajectory",
}
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
    "simulation.camera.noise": "simulation.noise is a factor for every sensor",
    "simulation.laser.noise": "simulation.noise is a factor for every sensor",
    "vision.matching.mu_d": "it is 1 - vision.matching.mu_r",
    "vision.matching.max_shift": "it is a quarter of vision.profile.width",
    "vision.templates.max_shift": "it is a sixteenth of vision.profile.width",
    "vision.laser.scan.profile_width": "vision.profile.width is that of every sensor",
    "vision.relocalising.candidates": "vision.relocalising.enabled says whether a lost robot is looked for",
    "vision.rgbd.registration.keypoints": "matched keypoints always join the depth",
    "vision.rgbd.pnp.refine": "poses by features are always refined on depth",
}
"""Old dotted key -> what there is instead."""


@cache
def constants() -> dict[str, tuple[str, str]]:
    """Removed settings that are constants now: old dotted key -> (module below `hybridmap/`, name of the constant)."""
    found = {}
    for section, module, *keys in map(str.split, _CONSTANTS.strip().splitlines()):
        for key in keys:
            old, _, name = key.partition(":")
            found[f"{section}.{old}"] = (module, name or old.upper())
    return found


def what_became_of(key: str, value: Any = None) -> str | None:
    """Explain in one line what replaced a removed or renamed setting or section; None if the key was never a setting.

    Args:
        key: dotted key, such as `neural.kernel_widths`.
        value: value found at the key. If it is a mapping (a removed section), the setting inside it is explained.
    """
    if key in RENAMED:
        return f"{key} is now called {RENAMED[key]}"
    if key in OTHERWISE:
        return f"{key} is no longer a setting: {OTHERWISE[key]}"
    if key in constants():
        module, name = constants()[key]
        return f"{key} is no longer a setting: it is the constant {name} in hybridmap/{module}"
    inner = value.items() if isinstance(value, Mapping) else ()
    found = next(filter(None, (what_became_of(f"{key}.{name}", held) for name, held in inner)), None)
    first = next((old for old in (*constants(), *OTHERWISE, *RENAMED) if old.startswith(f"{key}.")), None)
    if found is not None or first is None:
        return found
    return f"{key} is no longer a section of settings; {what_became_of(first)}"


def without_gone(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Copy a stored configuration, a mapping of sections: removed settings are left out, renamed ones get their new names."""
    kept: dict[str, Any] = {}
    for dotted, value in _leaves(tree, ""):
        if _is_gone(dotted):
            continue
        *sections, last = RENAMED.get(dotted, dotted).split(".")
        place = kept
        for section in sections:
            place = place.setdefault(section, {})
        place[last] = value
    return kept


def _leaves(tree: Mapping[str, Any], at: str) -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        dotted = f"{at}.{key}" if at else str(key)
        if isinstance(value, Mapping) and not _is_gone(dotted):
            yield from _leaves(value, dotted)
        else:
            yield dotted, value


def _is_gone(dotted: str) -> bool:
    return dotted in OTHERWISE or dotted in constants()
