"""Cranes' motion and encoders drawn from a seed, apart from anything that judges them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from barsight.core.types import CraneSamples


@dataclass(frozen=True, eq=False)
class DrawnCrane:
    """readings: as given. true_m: (N, 3) where the crane was. fault: index of the first wrong reading."""

    readings: CraneSamples
    true_m: NDArray[np.float64]
    rate_hz: float
    fault: int | None


def drawn_crane(seed: int, jump_m: float = 0.0, frozen_s: float = 0.0) -> DrawnCrane:
    """20 to 40 s of bridge, trolley and hoist; with a slip of jump_m or a freeze while it moves."""
    rng = np.random.default_rng([20261123, seed])
    rate = float(rng.choice([20, 25, 50, 100, 200]))
    time = np.arange(0, rng.uniform(20, 40), 1 / rate)
    true = np.column_stack([_travel(rng, time), _travel(rng, time), np.full(time.size, 8.0)])
    for axis in (0, 1):
        true[:, axis] += sum(_oscillation(rng, time) for _ in range(rng.integers(1, 4)))
    read = np.column_stack([_backlash(true[:, axis], rng.uniform(0, 0.002)) for axis in range(3)])
    fault = int(rng.uniform(0.2, 0.8) * time.size)
    read[fault:, rng.integers(2)] += jump_m * rng.choice([-1, 1])
    sigma = float(np.exp(rng.uniform(np.log(3e-4), np.log(3e-3))))
    quantum = float(rng.choice([1e-4, 5e-4, 1e-3, 2e-3]))
    read = np.round((read + rng.normal(0, sigma, read.shape)) / quantum) * quantum
    wild = rng.random(time.size) < rng.choice([0, 0.005, 0.02])
    read[wild] += rng.normal(0, 0.05, (int(wild.sum()), 3))
    found = fault if jump_m else None
    if frozen_s:
        found, length = _moving(true, rate, frozen_s, rng), round(frozen_s * rate)
        if found is not None:
            read[found : found + length] = read[found]
    stamped = time + rng.normal(0, rng.choice([0, 5e-4, 1e-3]), time.size).clip(-0.2 / rate, 0.2 / rate)
    kept = rng.random(time.size) > rng.choice([0, 0.02, 0.05])
    if found is not None:
        found = int(kept[:found].sum())
    stamps = (1e9 * (stamped + 1)).astype(np.int64)
    stated = float(np.hypot(sigma, quantum / 12**0.5))
    readings = CraneSamples(stamps[kept], read[kept], np.zeros(3), np.eye(3), stated)
    return DrawnCrane(readings, true[kept], rate, found)


def _travel(rng: np.random.Generator, time: NDArray[np.float64]) -> NDArray[np.float64]:
    """Speeds held, stops and returns, with ramps of 0.15 to 0.5 m/s2."""
    changes = np.sort(rng.uniform(0, time[-1], rng.integers(2, 7)))
    wanted = rng.choice([0, 0.3, 0.6, 0.9, -0.3, -0.6], changes.size + 1)[np.searchsorted(changes, time)]
    step = time[1] - time[0]
    most, speed = rng.uniform(0.15, 0.5) * step, np.zeros(time.size)
    for k in range(1, time.size):
        speed[k] = speed[k - 1] + np.clip(wanted[k] - speed[k - 1], -most, most)
    return np.asarray(np.cumsum(speed) * step)


def _oscillation(rng: np.random.Generator, time: NDArray[np.float64]) -> NDArray[np.float64]:
    """0.3 to 3 Hz, up to 15 mm and 0.6 m/s2; lasting, or rung by something and dying away."""
    hz = float(np.exp(rng.uniform(np.log(0.3), np.log(3.0))))
    amplitude = rng.uniform(0.2, 1) * min(0.015, 0.6 / (2 * np.pi * hz) ** 2)
    wave = amplitude * np.sin(2 * np.pi * hz * time + rng.uniform(0, 2 * np.pi))
    if rng.random() < 0.4:
        since = np.maximum(time - rng.uniform(0, time[-1]), 0)
        wave = wave * (1 - np.exp(-((since / 0.4) ** 2))) * np.exp(-since * rng.uniform(0.1, 0.6))
    return np.asarray(wave)


def _backlash(way: NDArray[np.float64], play_m: float) -> NDArray[np.float64]:
    """The encoder's wheel follows the crane once the play is taken up."""
    out = way.copy()
    for k in range(1, way.size):
        out[k] = min(max(out[k - 1], way[k] - play_m / 2), way[k] + play_m / 2)
    return out


def _moving(true: NDArray[np.float64], rate: float, frozen_s: float, rng: np.random.Generator) -> int | None:
    """A reading from which on the crane travels 50 mm or more within frozen_s; None where there is none."""
    length = round(frozen_s * rate)
    way = np.linalg.norm(true[length:] - true[:-length], axis=1)
    way[: round(2 * rate)] = way[-round(2 * rate) :] = 0
    moving = np.flatnonzero(way > 0.05)
    return int(rng.choice(moving)) if moving.size else None
