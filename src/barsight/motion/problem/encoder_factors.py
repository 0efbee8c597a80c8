"""Form the encoders' residuals with an estimated latency, and remove outliers.

A reading stamped t gives the crane's position at t minus the latency. The latency can be observed wherever
the speed changes, since pictures and IMU know the travel by themselves. The encoders' scale against the
baseline is the rig's drift. A constant offset can't be observed in the recording: it remains part of the
yard's origin.

Encoders measure the positions of wheels and drum, not of the body: wavy rails and a swinging girder move it
by millimetres, by the same amount over a stretch of the travel. Treated as independent noise of readings,
which averages out, that would tilt the whole yard with great confidence. So a position's variance is that of
its readings plus that of this unevenness times the number of positions nearby; its size on each axis is
learnt from the recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from gtsam.symbol_shorthand import B, X

from barsight.core.arrays import Bool, Float64, Int64
from barsight.core.errors import Failed
from barsight.core.records.sensor_samples import AXES, CraneSamples, EncoderJump, ImuSamples
from barsight.core.stamps import NS_PER_S, seconds_to_ns
from barsight.inertial.model import ImuBias
from barsight.motion.crane.encoder_trajectory import fit_position
from barsight.motion.crane.known_motion import ImuWay, way_around
from barsight.motion.linear.chain_elimination import Chain
from barsight.motion.problem.problem import (
    FIRST_UNEVEN_M,
    EncoderPosition,
    Problem,
    encoder_unknowns_of,
    poses_of,
)
from barsight.motion.problem.rig_drift import HUBER_SIGMAS
from barsight.motion.problem.travel import Scales

FARTHEST_SIGMAS = 5.0
WINDOW_S = 0.21
"""Maximum distance in time of a node's readings: all are used, since nodes are 0.4 s apart."""
MIN_SIGMA_M = 0.0003
MIN_AGREEING_SIGMA_M = 0.001
"""Lower bound of a position's sigma when outliers are removed: the error of a parabola through the readings
while the crane jerks, which is no disagreement.
"""
PRIOR_STRETCHES = 3.0
"""Weight of the initial unevenness as a prior, in stretches of a recording."""
MAX_UNEVEN_M = 0.006
"""Largest residual that counts towards the unevenness: a larger one is a fault, and is clipped."""
NOTED_LATENCY_SIGMAS = 5.0
NOTED_LATENCY_S = 0.005
PLAY_M = 0.002
"""Standard deviation of an encoder's play and of rails, which pass for scale over a short travel."""
SURE_SCALE_SIGMAS = 4.7
"""Significance from which a scale is wrong, as that of a jump; one that is less significant may be wrong."""


@dataclass(frozen=True)
class EncoderState:
    """latency_s and its sigma: zero and the prior's where nothing shows it. jump_m, jump_sigma_m: (J,) size
    of each jump and its sigma. excess: (S,) by how much each encoder whose scale is an unknown travels too
    far.
    """

    latency_s: float
    latency_sigma_s: float
    jump_m: Float64
    jump_sigma_m: Float64
    excess: Scales


def encoder_position(
    crane: CraneSamples, node: int, stamp_ns: int, window_ns: int, way: ImuWay | None, late_ns: int = 0
) -> EncoderPosition | Failed:
    """Interpolate the body's position at a node from the readings around it; see `fit_position`."""
    fit = fit_position(crane, stamp_ns, window_ns, way, late_ns)
    if isinstance(fit, Failed):
        return fit
    place, sigma = fit.position_m + crane.crane_to_body_m, float(np.sqrt(fit.covariance[0, 0]))
    return EncoderPosition(node, place, fit.velocity_mps, fit.acceleration_mps2, sigma)


def encoder_positions(
    crane: CraneSamples, imu: ImuSamples | None, stamp_ns: Int64, nodes: Sequence[int]
) -> tuple[EncoderPosition, ...]:
    """Interpolate the body's position at some nodes of stamps (M,), with the attitude taken as nominal."""
    found, half = [], crane.reach_ns(seconds_to_ns(WINDOW_S))
    for k in nodes:
        stamp, nominal, none = int(stamp_ns[k]), crane.yard_from_body_nominal, ImuBias.none()
        way = None if imu is None else way_around(imu, stamp, half, nominal, none, 2)
        found.append(encoder_position(crane, k, stamp, half, way))
    return tuple(place for place in found if not isinstance(place, Failed))


def with_known_way(problem: Problem, values: Any) -> Problem:
    """Refine the positions by the travel from the IMU, integrated with the estimate's attitudes, biases and
    latency: they become 1.5 times as precise.
    """
    crane, imu = problem.crane, problem.imu
    if crane is None or imu is None or not problem.has_imu or not problem.placed:
        return problem
    late_ns, found = seconds_to_ns(float(encoder_unknowns_of(values)[0])), []
    half = crane.reach_ns(seconds_to_ns(WINDOW_S)) + abs(late_ns)
    for place in problem.placed:
        k, stamp = place.node, int(problem.stamp_ns[place.node])
        bias = values.atConstantBias(B(k))
        known = ImuBias(np.array(bias.gyroscope()), np.array(bias.accelerometer()))
        way = way_around(imu, stamp, half, values.atPose3(X(k)).rotation().matrix(), known, 1)
        again = encoder_position(crane, k, stamp, seconds_to_ns(WINDOW_S), way, late_ns)
        found.append(place if way is None or isinstance(again, Failed) else again)
    return replace(problem, placed=tuple(found))


def add_encoders(chain: Chain, problem: Problem, poses: Float64, unknowns: Float64) -> None:
    """Add the Huber-weighted position residuals to the chain's nodes and the encoders' `unknowns` (S,).
    poses: (M, 4, 4).
    """
    if not problem.placed:
        return
    node = _nodes(problem.placed)
    reading, by_unknowns = _readings(problem, unknowns)
    turn, error = poses[node, :3, :3], poses[node, :3, 3] - reading
    sigma = encoder_sigmas(problem)
    distance = np.linalg.norm(error / sigma, axis=1)
    weight = (HUBER_SIGMAS / np.maximum(distance, HUBER_SIGMAS))[:, None] / sigma**2
    shift = np.arange(3, 6)  # of GTSAM's pose, in body axes
    chain.own[node[:, None, None], shift[:, None], shift] += np.einsum("pij,pi,pik->pjk", turn, weight, turn)
    chain.gradient[node, 3:6] += np.einsum("pi,pij,pi->pj", weight, turn, error)
    chain.side[node, 3:6] -= np.einsum("pi,pij,pis->pjs", weight, turn, by_unknowns)
    chain.corner[:] += np.einsum("pi,pis,pit->st", weight, by_unknowns, by_unknowns)
    chain.corner_gradient[:] -= np.einsum("pi,pis,pi->s", weight, by_unknowns, error)


def encoders_cost(values: Any, problem: Problem) -> float:
    """Compute the Huber cost of the positions."""
    distance = np.linalg.norm(encoder_residuals(values, problem) / encoder_sigmas(problem), axis=1)
    near = np.minimum(distance, HUBER_SIGMAS)
    return float((near * (distance - near / 2)).sum())


def encoder_residuals(values: Any, problem: Problem) -> Float64:
    """Compute the encoders' residuals (P, 3) m against the poses."""
    if not problem.placed:
        return np.empty((0, 3))
    reading, _ = _readings(problem, encoder_unknowns_of(values))
    off: Float64 = reading - poses_of(values)[_nodes(problem.placed), :3, 3]
    return off


def encoder_inliers(values: Any, problem: Problem) -> Bool:
    """Select the positions (P,) within 5 sigma of the poses."""
    sigma = encoder_sigmas(problem, MIN_AGREEING_SIGMA_M)
    kept: Bool = np.linalg.norm(encoder_residuals(values, problem) / sigma, axis=1) < FARTHEST_SIGMAS
    return kept


def with_unevenness(problem: Problem, values: Any) -> Problem:
    """Estimate the unevenness of each axis from the positions' residuals in excess of the readings' noise."""
    if not problem.placed:
        return problem
    square = np.minimum(encoder_residuals(values, problem) ** 2, MAX_UNEVEN_M**2)
    own = encoder_sigmas(replace(problem, uneven_m=np.zeros(3))) ** 2
    share = 1 / problem.alike
    seen = np.maximum(share @ (square - own), 0.0)
    variance = (PRIOR_STRETCHES * FIRST_UNEVEN_M**2 + seen) / (PRIOR_STRETCHES + share.sum())
    return replace(problem, uneven_m=np.sqrt(variance))


def encoder_sigmas(problem: Problem, min_m: float = MIN_SIGMA_M) -> Float64:
    """Compute the positions' sigmas (P, 3) m, including the unevenness that neighbours share. min_m: lower
    bound of the readings' part.
    """
    own = np.array([max(p.sigma_m, min_m) for p in problem.placed], np.float64)
    return np.hypot(own[:, None], problem.uneven_m * np.sqrt(problem.alike)[:, None])


def travel_m(problem: Problem) -> Float64:
    """Return the extent (3,) of the encoders' positions, at least `PLAY_M`."""
    travel = problem.travel
    return np.full(3, PLAY_M) if travel is None else np.maximum(travel.high_m - travel.low_m, PLAY_M)


def encoder_state(values: Any, problem: Problem, sigmas: Float64) -> EncoderState:
    """Extract the encoders' estimated latency, jumps and scales. sigmas: (S,) of these unknowns."""
    found, end = encoder_unknowns_of(values), 1 + len(problem.jumps)
    sizes = np.array([jump.size_m for jump in problem.jumps], np.float64)
    taken_s = 0.0 if problem.crane is None else problem.crane.late_ns / NS_PER_S
    at = problem.scale_places
    return EncoderState(
        taken_s + float(found[0]), float(sigmas[0]), sizes + found[1:end], sigmas[1:end],
        scale_excess(problem, Scales(found[at], np.diag(sigmas[at] ** 2))),
    )  # fmt: skip


def scale_excess(problem: Problem, scales: Scales) -> Scales:
    """Convert scales, which are shares of the readings' travel, to shares of the true one; their sigmas then
    hold an encoder's play.
    """
    play, share = PLAY_M / travel_m(problem)[list(problem.scaled)], scales.value
    by_share = np.diag((1 - share) ** -2.0)
    return Scales(share / (1 - share), by_share @ (scales.covariance + np.diag(play**2)) @ by_share)


def jump_sentences(
    jumps: Sequence[EncoderJump], begin_ns: int, state: EncoderState | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Describe certain and possible jumps, with the sizes that the whole estimate shows.

    begin_ns: stamp of the first reading, from which times are counted.
    """
    sure, maybe = [], []
    for k, jump in enumerate(jumps):
        at = f"at {(jump.stamp_ns - begin_ns) / NS_PER_S:.1f} s"
        encoder, size = f"the {AXES[jump.axis]}'s encoder", f"{1e3 * jump.size_m:.1f} mm"
        if state is not None:
            size = f"{1e3 * state.jump_m[k]:.1f} mm (1 sigma {1e3 * state.jump_sigma_m[k]:.1f} mm)"
        match jump.kind:
            case "sure":
                sure.append(f"{encoder} jumps by {size} {at}; the readings before are held to be right")
            case "freeze":
                sure.append(f"{encoder} goes on {at}, after the freeze, off by {size}")
            case "maybe":
                maybe.append(f"{encoder} may jump {at}, by {size}: sigma holds it")
    return tuple(sure), tuple(maybe)


def scale_sentences(
    scaled: Sequence[int], found: Scales | None, since: str = ""
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Describe the scales, of the encoders `scaled`, that are certainly or possibly wrong. found: (S,), as
    from `scale_excess`; since: from when on they were taken off.
    """
    sure, maybe = [], []
    for k, axis in enumerate(scaled if found is not None else ()):
        assert found is not None
        excess, sigma = 100 * found.value[k], 100 * found.sigma[k]
        size = f"{abs(excess):.2f} % too {'far' if excess > 0 else 'short'} (1 sigma {sigma:.2f} %)"
        encoder = f"the {AXES[axis]}'s encoder"
        if abs(excess) > SURE_SCALE_SIGMAS * sigma:
            sure.append(
                f"{encoder} travels {size} by cameras and IMU: a wrong scale; "
                f"this was taken off{since} (check wheel and gear, else the cameras' baseline and trigger)"
            )
        else:
            maybe.append(f"{encoder} may travel {size} by cameras and IMU: sigma holds it{since}")
    return tuple(sure), tuple(maybe)


def encoder_warnings(
    state: EncoderState | None,
    node_stamp_ns: Int64,
    placed: tuple[EncoderPosition, ...],
    off_m: Float64,
    kept: Bool,
) -> tuple[str, ...]:
    """Warn of a latency that matters, and of stretches where the encoders disagree with the other sensors.

    off_m: (P, 3) from `encoder_residuals`. Times are seconds since the first node.
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


def _readings(problem: Problem, unknowns: Float64) -> tuple[Float64, Float64]:
    """Extrapolate the encoders' positions (P, 3) by the latency along their parabolas, less the estimated
    excess of the jumps and of the travel since the first; also return the derivatives (P, 3, S) by these
    unknowns.
    """
    placed, latency_s = problem.placed, float(unknowns[0])
    place = np.array([p.position_m for p in placed])
    velocity = np.array([p.velocity_mps for p in placed])
    derivative = np.zeros((len(placed), 3, len(unknowns)))
    derivative[..., 0] = velocity + np.array([p.acceleration_mps2 for p in placed]) * latency_s
    stamps = problem.stamp_ns[_nodes(placed)]
    for k, jump in enumerate(problem.jumps, start=1):
        derivative[:, jump.axis, k] = -jump.share(stamps)
    assert problem.travel is not None
    for k, axis in enumerate(problem.scaled, start=1 + len(problem.jumps)):
        derivative[:, axis, k] = problem.travel.first_m[axis] - place[:, axis]
    reading = place + (velocity + derivative[..., 0]) / 2 * latency_s + derivative[..., 1:] @ unknowns[1:]
    return reading, derivative


def _nodes(placed: tuple[EncoderPosition, ...]) -> Int64:
    return np.array([p.node for p in placed], np.int64)
