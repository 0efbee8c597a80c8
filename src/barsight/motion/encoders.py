"""The encoders in the graph: their latency is estimated, and what contradicts the rest leaves.

A reading stamped t says where the crane was at t minus the latency. That shows wherever the speed changes,
since pictures and IMU know the way by themselves. Their scale against the baseline is the rig's drift; a
constant offset is seen by nothing in the recording: it stays what the yard's origin is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import E, X

from barsight.core.arrays import Bool, Float64, Int64
from barsight.core.stamps import NS_PER_S
from barsight.motion.problem import Placed, Problem
from barsight.motion.rig_drift import HUBER_SIGMAS

FARTHEST_SIGMAS = 5.0
LEAST_SIGMA_M = 0.0003
LEAST_AGREEING_SIGMA_M = 0.001
"""What a parabola through the readings may be off by while the crane jerks, which isn't a disagreement."""
NOTED_LATENCY_SIGMAS = 5.0
NOTED_LATENCY_S = 0.005


@dataclass(frozen=True)
class EncoderState:
    """latency_s and its sigma: zero and the prior's where nothing shows it."""

    latency_s: float
    latency_sigma_s: float


def add_encoders(graph: Any, problem: Problem) -> None:
    """Factors for the problem's places, Huber, and the prior of the latency."""
    if problem.prior is None and problem.has_latency:
        prior = gtsam.noiseModel.Isotropic.Sigma(1, problem.encoder_latency_sigma_s)
        graph.add(gtsam.PriorFactorVector(E(0), np.zeros(1), prior))
    huber = gtsam.noiseModel.mEstimator.Huber.Create(HUBER_SIGMAS)
    for place in problem.placed:
        sigma = max(place.sigma_m, LEAST_SIGMA_M)
        model = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Isotropic.Sigma(3, sigma))
        graph.add(gtsam.CustomFactor(model, [X(place.node), E(0)], _error(place)))


def disagreement(values: Any, problem: Problem) -> Float64:
    """(P, 3) m by which the encoders' places are off the poses."""
    if not problem.placed:
        return np.empty((0, 3))
    latency = float(values.atVector(E(0))[0])
    bodies = [np.asarray(values.atPose3(X(place.node)).translation()) for place in problem.placed]
    readings = [_reading(place, latency)[0] for place in problem.placed]
    off: Float64 = np.array(readings) - np.array(bodies)
    return off


def agreeing(values: Any, problem: Problem) -> Bool:
    """(P,) places within 5 sigma of the poses."""
    sigma = np.array([max(place.sigma_m, LEAST_AGREEING_SIGMA_M) for place in problem.placed])
    kept: Bool = np.linalg.norm(disagreement(values, problem), axis=1) < FARTHEST_SIGMAS * sigma
    return kept


def encoder_state(values: Any, latency_sigma_s: float) -> EncoderState:
    """What was found of the encoders."""
    return EncoderState(float(values.atVector(E(0))[0]), latency_sigma_s)


def encoder_warnings(
    state: EncoderState | None, node_stamp_ns: Int64, placed: tuple[Placed, ...], off_m: Float64, kept: Bool
) -> tuple[str, ...]:
    """Sentences on a latency that matters, and on stretches where encoders and the rest disagree.

    off_m: (P, 3) from `disagreement`. Times are seconds since the first node.
    """
    sentences = []
    if state is not None and abs(state.latency_s) > max(
        NOTED_LATENCY_S, NOTED_LATENCY_SIGMAS * state.latency_sigma_s
    ):
        sentences.append(
            f"the encoders are {1e3 * state.latency_s:.0f} ms late "
            f"(1 sigma {1e3 * state.latency_sigma_s:.0f} ms); this was taken off"
        )
    begin = 0
    for k in range(1, len(placed) + 1):
        if k < len(placed) and kept[k] == kept[begin]:
            continue
        if not kept[begin]:
            first, last = (node_stamp_ns[placed[j].node] - node_stamp_ns[0] for j in (begin, k - 1))
            size = np.linalg.norm(off_m[begin:k], axis=1).max()
            sentences.append(
                f"encoders and the other sensors disagree by up to {1e3 * size:.0f} mm from "
                f"{first / NS_PER_S:.1f} s to {last / NS_PER_S:.1f} s; the encoders were left out there"
            )
        begin = k
    return tuple(sentences)


def _reading(place: Placed, latency_s: float) -> tuple[Float64, Float64]:
    """The encoders' place `latency_s` later and its speed, by their parabola."""
    velocity = place.velocity_mps + place.acceleration_mps2 * latency_s
    return place.position_m + (place.velocity_mps + velocity) / 2 * latency_s, velocity


def _error(place: Placed) -> Callable[[Any, Any, list[Float64] | None], Float64]:
    """The body's place minus the encoders' reading `latency` later, and its derivatives."""

    def error(factor: Any, values: Any, jacobians: list[Float64] | None) -> Float64:
        pose = values.atPose3(factor.keys()[0])
        reading, velocity = _reading(place, float(values.atVector(factor.keys()[1])[0]))
        if jacobians is not None:
            jacobians[0] = np.hstack([np.zeros((3, 3)), pose.rotation().matrix()])
            jacobians[1] = -velocity[:, None]
        result: Float64 = np.asarray(pose.translation()) - reading
        return result

    return error
