"""Write the comparison of two versions as a page, with pictures of the worst cases beside it."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from statistics import mean

from barsight.fleet.comparison.comparing import FIGURES, RecordingComparison
from barsight.fleet.comparison.findings import LEVEL, MIN_RECORDINGS, ArchiveShift, Findings
from barsight.fleet.objects import Objects

MAX_LISTED = 100
"""Maximum number of bundles and of recordings listed on the page; the JSON has all."""
_STYLE = (
    "body{font:15px/1.45 system-ui,sans-serif;margin:2rem auto;max-width:70rem;padding:0 1rem;color:#1c2733}"
    "table{border-collapse:collapse;margin:1rem 0}td,th{padding:.25rem .8rem;border-bottom:1px solid #d5dce3;"
    "text-align:right}td:first-child,th:first-child{text-align:left}.found{background:#fde8d8}"
)


def copy_pictures(results: Objects, findings: Findings, folder: Path) -> dict[str, tuple[str, str]]:
    """Copy the pictures of the recordings that the page lists into `folder`.

    Returns their paths in it by recording, before and after; empty for a picture that a result lacks.
    """
    worst = [c.recording for c in findings.beyond[:MAX_LISTED]]
    worst += [one.recording for one in _other(findings)]
    pictures = {one.recording: one.pictures for one in findings.recordings}
    (folder / "pictures").mkdir()
    copied = {}
    for number, recording in enumerate(dict.fromkeys(worst)):
        names = [f"pictures/{number:03d}-{word}.png" for word in ("before", "after")]
        for place, (name, source) in enumerate(zip(names, pictures[recording], strict=True)):
            data = results.read(source)
            if data is None:
                names[place] = ""
            else:
                (folder / name).write_bytes(data)
        copied[recording] = (names[0], names[1])
    return copied


def _other(findings: Findings) -> list[RecordingComparison]:
    """List the recordings with other vetoes of the map, other numbers of lifts offered, or bundles of only
    one version, those with most vetoes and bundles first.
    """
    listed = [
        one for one in findings.recordings
        if one.vetoes or len(set(one.lifts.get("offered", ()))) > 1 or one.only_before or one.only_after
    ]  # fmt: skip
    listed.sort(key=lambda one: -len(one.vetoes) - len(one.only_before) - len(one.only_after))
    return listed[:MAX_LISTED]


def comparison_page(findings: Findings, pictures: dict[str, tuple[str, str]]) -> str:
    """Format the page: shifts of the archive, bundles beyond sigma, vetoes, unmatched bundles, times.

    pictures: from `copy_pictures`.
    """
    parts = [
        f"<h1>Version {escape(findings.before)} and version {escape(findings.after)}</h1>",
        f"<p>{len(findings.recordings)} recordings, {findings.tests} figures of bundles compared. Told is "
        f"what Holm's rule leaves at {100 * LEVEL:g} % for any false one among all; sigma is that of "
        "two independent measurements, which is more than two looks at the same pictures differ by.</p>",
        "<h2>Shifts of the whole archive</h2>",
        _table(("figure", "recordings", "mean shift", "chance", ""), _shift_rows(findings.shifts)),
        "<h2>Lifts that a veto forbids, and lifts offered: more or fewer in each recording</h2>",
        _table(("code", "recordings", "mean change", "chance", ""), _shift_rows(findings.lifts)),
        f"<h2>Bundles beyond sigma: {len(findings.beyond)}</h2>",
        _table(
            ("recording", "bundle", "figure", "before", "after", "sigma", "chance", "pictures"),
            [
                (c.recording, str(c.bundle), c.figure, f"{c.before:.4f}", f"{c.after:.4f}", f"{c.sigma:.4f}",
                 f"{c.p:.2g}", pictures[c.recording])
                for c in findings.beyond[:MAX_LISTED]
            ],
        ),
        "<h2>Vetoes and bundles of one version only</h2>",
        _table(
            ("recording", "vetoes of the map", "lifts offered", "bundles gone", "bundles new", "pictures"),
            [
                (one.recording, ", ".join(one.vetoes), _offered(one), _numbers(one.only_before),
                 _numbers(one.only_after), pictures[one.recording])
                for one in _other(findings)
            ],
        ),
        "<h2>Half widths of the 95 % intervals, mean over the recordings that have both</h2>",
        _table(("figure", "before", "after", "recordings"), _intervals(findings)),
        f"<h2>Times</h2><p>Median seconds: {findings.seconds[0]:.2f} and {findings.seconds[1]:.2f}.</p>",
    ]  # fmt: skip
    if findings.untold:
        parts.append(f"<p>Not compared: {escape(', '.join(findings.untold[:MAX_LISTED]))}</p>")
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>Two versions</title>'
        f"<style>{_STYLE}</style>{''.join(parts)}</html>\n"
    )


def _shift_rows(shifts: Sequence[ArchiveShift]) -> list[tuple[str, ...]]:
    return [
        (s.figure, str(s.recordings), f"{s.shift:+.5f}",
         f"{s.p:.2g}" if s.recordings >= MIN_RECORDINGS else "too few", "found" if s.is_found else "")
        for s in shifts
    ]  # fmt: skip


def _offered(one: RecordingComparison) -> str:
    before, after = one.lifts.get("offered", (0, 0))
    return str(before) if before == after else f"{before} to {after}"


def _intervals(findings: Findings) -> list[tuple[str, ...]]:
    rows = list[tuple[str, ...]]()
    for figure in FIGURES:
        intervals = [one.intervals[figure] for one in findings.recordings if one.intervals]
        known = [(before, after) for before, after in intervals if before is not None and after is not None]
        means = (f"{mean(one[side] for one in known):.4f}" if known else "not known" for side in (0, 1))
        rows.append((figure, *means, str(len(known))))
    return rows


def _numbers(numbers: tuple[int, ...]) -> str:
    return " ".join(map(str, numbers))


def _table(heads: tuple[str, ...], rows: Sequence[Sequence[object]]) -> str:
    if not rows:
        return "<p>None.</p>"
    head = "".join(f"<th>{escape(name)}</th>" for name in heads)
    lines = "".join(
        f"<tr{' class=found' if row[-1] == 'found' else ''}>"
        f"{''.join(f'<td>{_cell(cell)}</td>' for cell in row)}</tr>"
        for row in rows
    )
    return f"<table><tr>{head}</tr>{lines}</table>"


def _cell(cell: object) -> str:
    if isinstance(cell, tuple):
        links = zip(("before", "after"), cell, strict=True)
        return " ".join(f'<a href="{escape(str(path))}">{word}</a>' for word, path in links if path)
    return escape(str(cell))
