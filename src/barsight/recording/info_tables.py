"""Print `RecordingInfo` as tables in a terminal."""

from __future__ import annotations

from datetime import UTC, datetime

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from barsight.calibration.geometry.camera import Camera
from barsight.core.stamps import NS_PER_S, format_seconds
from barsight.recording.info import RecordingInfo

DROPPED_SHOWN = 10
EPOCH_LIKELY_S = 1_000_000_000


def print_info(info: RecordingInfo, console: Console) -> None:
    """Print the result of `describe_recording`."""
    simulated = ", simulated" if info.is_simulated else ""
    console.print(
        f"[bold]{escape(str(info.path))}[/bold]: {info.format}{simulated}, {_begin(info)}", highlight=False
    )
    console.print(_streams(info))
    console.print(f"{info.pairs} pairs, {len(info.dropped)} pictures without partner", highlight=False)
    for frame in info.dropped[:DROPPED_SHOWN]:
        console.print(f"  {frame.stamp_ns}: {escape(frame.reason)}", highlight=False)
    if len(info.dropped) > DROPPED_SHOWN:
        console.print(f"  and {len(info.dropped) - DROPPED_SHOWN} more", highlight=False)
    if info.first_refused:
        console.print(f"[yellow]the first pair can't be used:[/yellow] {escape(info.first_refused)}")
    console.print(_cameras(info))
    if info.crane:
        console.print(_crane(info))
    if info.laser:
        console.print(_laser(info))
    for note in info.notes:
        console.print(f"[yellow]note:[/yellow] {escape(note)}", highlight=False)


def _begin(info: RecordingInfo) -> str:
    cam0 = info.streams[0]
    text = f"{cam0.duration_s:.2f} s from {format_seconds(cam0.first_ns)}"
    if cam0.first_ns > EPOCH_LIKELY_S * NS_PER_S:
        text += f" ({datetime.fromtimestamp(cam0.first_ns // NS_PER_S, UTC):%Y-%m-%d %H:%M:%S} UTC)"
    return text


def _streams(info: RecordingInfo) -> Table:
    table = Table(title="Sensors", title_justify="left")
    table.add_column("sensor")
    for name in ("samples", "duration (s)", "rate (Hz)", "gaps", "longest gap (s)"):
        table.add_column(name, justify="right")
    for stream in info.streams:
        gap = f"{stream.longest_gap_s:.3f}" if stream.gaps else "-"
        rate = f"{stream.rate_hz:.2f}" if stream.count > 1 else "-"
        table.add_row(stream.name, str(stream.count), f"{stream.duration_s:.2f}", rate, str(stream.gaps), gap)
    return table


def _cameras(info: RecordingInfo) -> Table:
    calibration = info.calibration
    title = (
        f"Calibration: baseline {calibration.baseline_m * 1e3:.2f} mm, cameras {calibration.angle_deg:.2f} "
        f"degrees apart, t_imu = t_cam {calibration.timeshift_cam_imu_ms:+.3f} ms"
    )
    table = Table(title=title, title_justify="left")
    for name in ("camera", "size", "fx, fy (px)", "cx, cy (px)", "distortion"):
        table.add_column(name)
    for name, camera in (("cam0", calibration.cam0), ("cam1", calibration.cam1)):
        table.add_row(
            name,
            f"{camera.width}x{camera.height}",
            f"{camera.fx_px:.3f}, {camera.fy_px:.3f}",
            f"{camera.cx_px:.3f}, {camera.cy_px:.3f}",
            _distortion(camera),
        )
    return table


def _distortion(camera: Camera) -> str:
    if camera.is_ideal:
        return "none"
    return f"{camera.distortion}: " + ", ".join(f"{value:.5g}" for value in camera.coefficients)


def _crane(info: RecordingInfo) -> Table:
    assert info.crane is not None
    table = Table(title=f"Crane: sigma {info.crane.position_std_m * 1e3:g} mm", title_justify="left")
    for name in ("axis", "from (m)", "to (m)"):
        table.add_column(name)
    rows = zip(("bridge x", "trolley y", "hoist z"), info.crane.lowest_m, info.crane.highest_m, strict=True)
    for axis, low, high in rows:
        table.add_row(axis, f"{low:.3f}", f"{high:.3f}")
    return table


def _laser(info: RecordingInfo) -> Table:
    table = Table(title="Laser profiles", title_justify="left")
    for name in ("profile", "points", "y (m)", "x from (m)", "x to (m)"):
        table.add_column(name)
    for profile in info.laser:
        table.add_row(
            str(profile.profile), str(profile.count), f"{profile.y_m:.3f}", f"{profile.x_first_m:.3f}",
            f"{profile.x_last_m:.3f}",
        )  # fmt: skip
    return table
