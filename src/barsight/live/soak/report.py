"""Judge a soak test by its bounds, and write the results: soak.json and soak.md."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from barsight.core.files import atomic_path
from barsight.core.json_values import write_json
from barsight.core.settings.values import POSITIVE, expect_ranges, expect_values
from barsight.live.soak.faults import Killed
from barsight.live.soak.trend import S_PER_H, Trend
from barsight.live.soak.watch import LASTING, RunWatch, Watched

UNSURE = "unsure"
DIGITS = 5


@dataclass(frozen=True)
class SoakBounds:
    """Bounds that a soak test must stay within."""

    slope_mib_per_h: float = 1.0
    """Largest growth of each process's memory after the warm-up, in MiB per hour, confirmed within two
    sigma.
    """
    total_mib: float = 2048.0
    """Largest memory of all processes together in MiB, with shared pages counted once."""
    descriptors: int = 2
    """Largest number of open descriptors that a process gains after the warm-up."""
    told_s: float = 1.0
    """Longest time in seconds from a kill until state.json reports it, and until lifts are revoked."""
    back_s: float = 10.0
    """Longest time in seconds from a kill until the run has recovered."""

    def __post_init__(self) -> None:
        expect_values(self, "bounds.")
        expect_ranges(
            self, "bounds.", slope_mib_per_h=POSITIVE, total_mib=POSITIVE, descriptors=(0, 1000),
            told_s=POSITIVE, back_s=POSITIVE,
        )  # fmt: skip


def soak_content(
    watch: RunWatch, killed: Mapping[str, Killed], warm_up_h: float, bounds: SoakBounds
) -> dict[str, Any]:
    """Build the content of soak.json."""
    warm_s = warm_up_h * S_PER_H
    processes = {role: _figures(role, one, watch, warm_s) for role, one in sorted(watch.processes.items())}
    content: dict[str, Any] = {
        "schema_version": 1,
        "hours": watch.seconds / S_PER_H,
        "warm_up_h": warm_up_h,
        "bounds": vars(bounds).copy(),
        "surveys": dict(watch.surveys),
        "total_mib": {"last": watch.total_mib.last, "max": watch.total_mib.peak},
        "processes": processes,
        "faults": {role: _times(one) for role, one in sorted(killed.items())},
    }
    found = [*_broken(content, bounds)]
    content["broken"] = [text for is_sure, text in found if is_sure]
    content[UNSURE] = [text for is_sure, text in found if not is_sure]
    return content


def _figures(role: str, usage: Watched, watch: RunWatch, warm_s: float) -> dict[str, Any]:
    memory = usage.rss_mib.trend(warm_s, watch.survey_s, of_peaks=role not in LASTING)
    # Between two surveys the command briefly has fewer; a sample may happen to fall there.
    descriptors = usage.descriptors.trend(warm_s, watch.survey_s, of_peaks=True)
    return {
        "memory_mib": {"first": usage.rss_mib.first, "last": usage.rss_mib.last, "max": usage.rss_mib.peak},
        "slope_mib_per_h": None if memory is None else memory.per_h,
        "slope_sigma_mib_per_h": None if memory is None else memory.sigma_per_h,
        "descriptors": {
            "first": usage.descriptors.first, "last": usage.descriptors.last, "max": usage.descriptors.peak,
            "more_since_warm_up": None if descriptors is None else _growth(descriptors),
        },
        "begun": usage.new + 1,
        "restarts": watch.restarts.get(role, 0),
        "cores": usage.cpu_s / max(watch.seconds, 1e-9),
    }  # fmt: skip


def _growth(trend: Trend) -> int:
    return round(trend.last - trend.first)


def _times(kill: Killed) -> dict[str, Any]:
    return {
        "times": kill.times, "survey_ended": kill.over,
        "told_s": _spread(kill.told_s), "revoked_s": _spread(kill.revoked_s), "back_s": _spread(kill.back_s),
        "not_told": kill.not_told, "not_revoked": kill.not_revoked, "not_back": kill.not_back,
    }  # fmt: skip


def _spread(seconds: Sequence[float]) -> dict[str, Any]:
    if not seconds:
        return {"n": 0, "p50": None, "max": None}
    return {"n": len(seconds), "p50": float(np.median(seconds)), "max": max(seconds)}


def _broken(content: dict[str, Any], bounds: SoakBounds) -> Iterator[tuple[bool, str]]:
    """List what exceeds the bounds (True), or can't be judged yet (False)."""
    if not content["processes"]:
        yield False, "no process was seen"
    for role, figures in content["processes"].items():
        slope, sigma = figures["slope_mib_per_h"], figures["slope_sigma_mib_per_h"]
        bound, kills = bounds.slope_mib_per_h, content["faults"].get(role, {"times": 0})["times"]
        if slope is None:
            yield False, f"{role}: too short to tell whether its memory grows"
        elif slope + 2 * sigma > bound:
            grows = f"{role}: memory grows by {slope:.2f} MiB/h, sigma {sigma:.2f} (bound {bound:g})"
            yield slope - 2 * sigma > bound, grows
        more = figures["descriptors"]["more_since_warm_up"]
        if more is not None and more > bounds.descriptors:
            yield True, f"{role}: {more} descriptors more (bound {bounds.descriptors})"
        if role in LASTING and figures["begun"] > 1:
            yield True, f"{role}: begun anew {figures['begun'] - 1} times"
        if figures["restarts"] > kills:
            yield True, f"{role}: restarted {figures['restarts']} times, killed {kills} times"
    peak = content["total_mib"]["max"]
    if peak > bounds.total_mib:
        yield True, f"all together: {peak:.0f} MiB (bound {bounds.total_mib:g})"
    if failed := content["surveys"]["failed"]:
        yield True, f"{failed} surveys failed"
    for role, figures in content["faults"].items():
        for name, bound, missed in (
            ("told", bounds.told_s, figures["not_told"]), ("revoked", bounds.told_s, figures["not_revoked"]),
            ("back", bounds.back_s, figures["not_back"]),
        ):  # fmt: skip
            longest_s = figures[f"{name}_s"]["max"]
            if missed:
                yield True, f"{role} killed: {missed} times never {name}"
            elif longest_s is not None and longest_s > bound:
                yield True, f"{role} killed: {name} after {longest_s:.1f} s (bound {bound:g})"


def write_soak(content: dict[str, Any], out: Path) -> None:
    """Write soak.json and soak.md."""
    write_json(out / "soak.json", content, digits=DIGITS)
    with atomic_path(out / "soak.md") as path:
        path.write_text(soak_table(content), encoding="utf-8")


def soak_table(content: dict[str, Any]) -> str:
    """Write the results of a soak test as Markdown."""
    surveys, total = content["surveys"], content["total_mib"]
    lines = [
        "# Soak", "",
        f"{content['hours']:.2f} h, the first {content['warm_up_h']:g} h to warm up. Surveys: "
        f"{surveys['done']} "
        f"done, {surveys['failed']} failed. Memory of all processes: {total['last']:.0f} MiB, "
        f"{total['max']:.0f} MiB at most.", "",
        "| process | memory first, last, most, MiB | slope, MiB/h | 1 sigma | descriptors first, last, most "
        "| begun | restarts | cores |",
        "|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for role, one in content["processes"].items():
        memory, descriptors = one["memory_mib"], one["descriptors"]
        slopes = (one["slope_mib_per_h"], one["slope_sigma_mib_per_h"])
        cells = [
            role, ", ".join(f"{memory[name]:.1f}" for name in ("first", "last", "max")),
            *("-" if slope is None else f"{slope:.2f}" for slope in slopes),
            ", ".join(f"{descriptors[name]:.0f}" for name in ("first", "last", "max")),
            str(one["begun"]), str(one["restarts"]), f"{one['cores']:.3f}",
        ]  # fmt: skip
        lines.append(f"| {' | '.join(cells)} |")
    if content["faults"]:
        lines += [
            "", "Median, most, seconds:", "",
            "| killed | times | survey ended | told | lifts revoked | well again | not told | not revoked "
            "| not back |",
            "|---|---|---|---|---|---|---|---|---|",
        ]  # fmt: skip
    for role, one in content["faults"].items():
        spreads = [
            f"{one[name]['p50']:.2f}, {one[name]['max']:.2f}" if one[name]["n"] else "-"
            for name in ("told_s", "revoked_s", "back_s")
        ]
        counts = [str(one[name]) for name in ("not_told", "not_revoked", "not_back")]
        cells = [role, str(one["times"]), str(one["survey_ended"]), *spreads, *counts]
        lines.append(f"| {' | '.join(cells)} |")
    for name, title in (("broken", "Broken"), (UNSURE, "Not sure yet")):
        if content[name]:
            lines += ["", f"{title}:", "", *(f"- {text}" for text in content[name])]
    if not content["broken"] and not content[UNSURE]:
        lines += ["", "All bounds hold."]
    return "\n".join(lines) + "\n"
