"""Refuse settings by the names that they had before they were renamed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from barsight.core.errors import ConfigError

RENAMED = {
    "alike_grey": "alike_gray",
    "along_share": "along_ratio",
    "coarsest_cell_m": "max_cell_m",
    "crossed_share": "crossed_ratio",
    "edge_share": "edge_error_ratio",
    "farthest_baselines": "max_range_baselines",
    "fewest_votes": "min_votes",
    "first_at_half_size": "half_size_steps",
    "first_share": "first_ratio",
    "fusion.calibration_sigma_px": "offset_prior_px",
    "gray_share": "gray_weight",
    "highest_disparity_px": "max_disparity_px",
    "large_jump": "p2",
    "last_share": "last_ratio",
    "least_bar_m": "min_bar_diameter_m",
    "least_confidence": "min_confidence",
    "least_count_probability": "min_count_probability",
    "least_freeboard_m": "min_freeboard_m",
    "least_gate_m": "min_gate_m",
    "least_inliers": "min_inliers",
    "least_jump": "min_p2",
    "least_length_m": "min_length_m",
    "least_matches": "min_matches",
    "least_rise_m": "min_rise_m",
    "least_shift": "min_shift",
    "least_single_m": "min_single_diameter_m",
    "lowest_disparity_px": "min_disparity_px",
    "max_overhang_share": "max_overhang_ratio",
    "max_refused_share": "max_refused_ratio",
    "max_unexplained_share": "max_unexplained_ratio",
    "max_unknown_share": "max_unknown_ratio",
    "missing_share": "missing_ratio",
    "most_mm": "max_depth_error_mm",
    "most_off_row_px": "max_row_error_px",
    "most_points": "max_points",
    "most_rounds": "max_rounds",
    "most_scale": "max_scale",
    "most_views": "max_views",
    "narrowest_m": "min_width_m",
    "nearest_m": "min_range_m",
    "odometry.calibration_sigma_px": "offset_sigma_px",
    "other_side_share": "other_side_error_ratio",
    "outlier_grey": "outlier_gray",
    "own_share": "own_ratio",
    "packing_share": "packing_error_ratio",
    "ribbed_share": "ribbed_ratio",
    "rough.calibration_sigma_px": "offset_sigma_px",
    "single_share": "single_error_ratio",
    "small_jump": "p1",
    "start_share": "start_error_ratio",
    "top_share": "top_ratio",
    "vertical_share": "vertical_error_ratio",
    "vote_share": "min_vote_ratio",
    "widest_edge_px": "max_edge_px",
    "widest_m": "max_width_m",
}
"""New names of settings by their old ones, of one section or of any."""


def refuse_old_keys(content: Mapping[str, Any], section: str = "") -> None:
    """Raise ConfigError naming the new name of the first old key of nested settings."""
    for key, value in content.items():
        if (new := _new_name(section, key)) is not None:
            raise ConfigError(f"{section}{key} is called {section}{new} now")
        if isinstance(value, Mapping):
            refuse_old_keys(value, f"{section}{key}.")


def refuse_old_flags(arguments: Sequence[str]) -> None:
    """Raise ConfigError naming the new name of the first old flag of a command line."""
    for argument in arguments:
        section, dot, name = argument.partition("=")[0].removeprefix("--").rpartition(".")
        new = _new_name(section, name.replace("-", "_"))
        if argument.startswith("--") and new is not None:
            section = f"--{section}{dot}"
            raise ConfigError(f"{section}{name} is called {section}{new.replace('_', '-')} now")


def _new_name(section: str, key: str) -> str | None:
    return RENAMED.get(f"{section.rstrip('.').rpartition('.')[2]}.{key}", RENAMED.get(key))
