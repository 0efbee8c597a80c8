"""Count wrong stamps after a device's clock is set back: `python benchmarks/clocks_set_back.py`.

First table: set back by S seconds after a minute; stamps used in the minute after that are off by more than
10 ms, per rate; the median of nine runs. Second table: the clock runs true for ten minutes, but the network
delays packets or lets one or two overtake the one before; how often it is taken for a jump, without and with
the receiver's `Sequence`, and the share of readings used.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from barsight.core.stamps import NS_PER_S
from barsight.sensors.clock import DeviceClock
from barsight.sensors.receiver import Sequence

RATES_HZ = (5, 10, 50, 200)
BACKS_S = (0.02, 0.05, 0.1, 0.3, 0.6, 0.9)
RUNS, MINUTE = 9, 60
WRONG_S, OVERTAKEN = 0.01, 0.01
Packets = list[tuple[int, float, int, int]]
"""Number, true time (s), stamp and arrival (ns), in order of arrival."""


def main() -> None:
    """Print both tables."""
    print("| set back by | " + " | ".join(f"{rate} Hz" for rate in RATES_HZ) + " |\n|---|---|---|---|---|")
    for back_s in BACKS_S:
        counts = [median_wrong(rate, back_s) for rate in RATES_HZ]
        print(f"| {back_s} s | " + " | ".join(f"{count:.0f}" for count in counts) + " |")
    print("\n| 200 Hz, true clock | jumps, used: clock alone | behind the receiver |\n|---|---|---|")
    for name, jitter_ms, behind in (
        ("delays 1 + 1 ms", 1, 0), ("delays 1 + 5 ms", 5, 0), ("delays 1 + 20 ms", 20, 0),
        ("one in 100 after the next one", 0.1, 1), ("one in 100 after the next two", 0.1, 2),
        ("two in 100 after the next one", 0.1, -2),
    ):  # fmt: skip
        packets = sent(np.random.default_rng(0), 200, 10 * MINUTE, 1e-3 * jitter_ms, 0.0, behind)
        print(f"| {name} | {judged(packets, 200, sorts=False)} | {judged(packets, 200, sorts=True)} |")


def sent(
    rng: np.random.Generator, rate_hz: int, seconds: int, jitter_s: float, back_s: float, behind: int = 0
) -> Packets:
    """Draw packets with exponential delays, and set the clock back at half time.

    behind: k: one packet arrives after the next k; -k: k packets arrive after the next one.
    """
    true_s = np.arange(seconds * rate_hz) / rate_hz + rng.uniform(0, 1 / rate_hz)
    stamps = 1000 + true_s - back_s * (true_s > seconds / 2)
    arrivals = true_s + 1e-3 + rng.exponential(jitter_s, len(true_s))
    for k in np.flatnonzero(rng.uniform(size=len(true_s)) < OVERTAKEN * bool(behind)):
        last = k + max(behind, 1 - behind)
        if last < len(true_s):
            late = slice(k, k + max(-behind, 1))
            arrivals[late] = arrivals[last] + 1e-6 * (1 + np.arange(late.stop - k))
    return [
        (int(k), float(true_s[k]), round(stamps[k] * NS_PER_S), round(arrivals[k] * NS_PER_S))
        for k in np.argsort(arrivals, kind="stable")
    ]


def used(clock: DeviceClock, packets: Packets) -> Iterator[tuple[float, float]]:
    """Yield the true time and the error (s) of each stamp that `CraneSource` would use."""
    newest_ns = 0
    for _, true_s, stamp_ns, arrival_ns in packets:
        if clock.add(stamp_ns, arrival_ns) and (host_ns := clock.host_ns(stamp_ns)) > newest_ns:
            newest_ns = host_ns
            yield true_s, host_ns / NS_PER_S - true_s


def median_wrong(rate_hz: int, back_s: float) -> float:
    """Count wrong stamps in the minute after the clock was set back, the median of `RUNS` runs."""
    counts = []
    for seed in range(RUNS):
        packets = sent(np.random.default_rng(seed), rate_hz, 2 * MINUTE, 1e-3, back_s)
        counts.append(sum(abs(error_s) > WRONG_S for _, error_s in used(DeviceClock(), packets)))
    return float(np.median(counts))


def judged(packets: Packets, rate_hz: int, *, sorts: bool) -> str:
    """Count false jumps and the readings used; sorts: the receiver leaves out what was overtaken."""
    sequence, clock = Sequence(rate_hz, keeps_order=False), DeviceClock()
    kept = [p for p in packets if not sorts or sequence.lost_before(p[0], p[2], p[3]) is not None]
    count = sum(1 for _ in used(clock, kept))
    return f"{clock.jumps}, {100 * count / len(packets):.1f} %"


if __name__ == "__main__":
    main()
