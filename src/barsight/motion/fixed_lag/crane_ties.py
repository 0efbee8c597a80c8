"""Tie a window's nodes to the crane: its nominal attitude and the encoders' positions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barsight.core.errors import Failed
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.stamps import seconds_to_ns
from barsight.motion.crane.encoder_trajectory import CraneSettings, reestimate_noise
from barsight.motion.crane.known_motion import way_around
from barsight.motion.crane.places import PLACE_SPACING_S, place_spacing_ns
from barsight.motion.fixed_lag.sensor_buffer import SensorBuffer
from barsight.motion.fixed_lag.sliding_window import Window
from barsight.motion.frontend.sightings import Sighting
from barsight.motion.problem.encoder_factors import encoder_position
from barsight.motion.problem.problem import AttitudePrior
from barsight.motion.problem.travel import EncoderTravel

FIT_S = PLACE_SPACING_S / 2 + 0.01


def with_attitudes(
    window: Window, first: int, readings: CraneSamples | None, settings: CraneSettings
) -> Window:
    """Add priors of the nominal attitude at the nodes from `first` on: loose ones under way, and a single
    one at rest, since there the error is the same each time.
    """
    if readings is None:
        return window
    problem, stood, added = window.problem, window.stood, []
    for k in range(first, len(problem.start)):
        sigma, sways = settings.attitude_std_deg * 1.6, k not in problem.still
        if not sways:
            if stood:
                continue
            sigma, stood = settings.sway_std_deg, True
        added.append(AttitudePrior(k, readings.yard_from_body_nominal, np.full(3, np.deg2rad(sigma)), sways))
    extended = replace(problem, attitudes=problem.attitudes + tuple(added))
    return replace(window, problem=extended, stood=stood)


def with_encoder_positions(
    window: Window, sighting: Sighting | None, now: SensorBuffer, settings: CraneSettings, arrived_ns: int
) -> Window:
    """Add the encoder positions, 0.4 s apart, of the nodes for whose fit all readings have arrived; at once
    where nothing else ties the last node to the one before. arrived_ns: up to when readings have arrived.
    """
    if now.crane is None:
        return window
    crane, placed, problem = reestimate_noise(now.crane), list(window.problem.placed), window.problem
    placed_ns = window.placed_ns
    half, spacing = crane.reach_ns(seconds_to_ns(FIT_S)), 0.97 * place_spacing_ns(crane)
    complete, last = arrived_ns - half, len(problem.start) - 1
    by_imu = last > 0 and problem.preintegrated[-1] is not None
    loose = not by_imu and (sighting is None or sighting.motion is None)
    for k, node_ns in enumerate(problem.stamp_ns.tolist()):
        at_once = loose and k == last
        near = placed_ns is not None and node_ns - placed_ns < spacing
        if not at_once and (near or node_ns > complete):
            continue
        wide, way = seconds_to_ns(settings.window_s) if at_once else half, None
        if now.imu is not None and not at_once:
            way = way_around(now.imu, node_ns, half, window.pose(k).rotation, window.bias, 2)
        found = encoder_position(crane, k, node_ns, wide, way)
        if not isinstance(found, Failed):
            placed.append(found)
            placed_ns = node_ns
    travelled = EncoderTravel.of([place.position_m for place in placed], problem.travelled)
    problem = replace(problem, placed=tuple(placed), travelled=travelled)
    return replace(window, problem=problem, placed_ns=placed_ns)
