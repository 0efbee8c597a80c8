"""Write the result files of formats.md, each whole or not at all; tiles stream, memory stays bounded."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile

import barsight
from barsight.core.arrays import Float32, Float64
from barsight.core.files import atomic_path
from barsight.core.json_values import json_value
from barsight.core.stamps import NS_PER_S, format_seconds
from barsight.core.types import Contour, LaserProfile, Trajectory
from barsight.mapping.free_space import UNPROVEN, FreeSpace
from barsight.mapping.passes.changes import PlaceHistory
from barsight.mapping.surface.laser_check import LaserCheck, LaserOffset
from barsight.mapping.surface.surface import Layers, Surface
from barsight.mapping.top_photo import TopPhoto
from barsight.measurement import Measurement, PassRecord, Preview
from barsight.report.orthophoto import georeference, write_orthophoto, write_passes, write_top_photo
from barsight.yard.identity import ID_DIGITS, MapIdentity
from barsight.yard.inventory.bundle_file import write_bundles
from barsight.yard.lifting.lift_file import write_lifts

SCHEMA_VERSION = 1
RESULT_FILES = (
    "trajectory.tum", "cloud.ply", "height.tif", "free.tif", "tops.tif", "passes.tif", "contour.csv",
    "laser.csv", "bundles.json", "lifts.json", "events.csv", "ortho.tif", "ortho.png", "preview.png",
    "result.json", "report.html",
)  # fmt: skip
"""Everything that a run may leave in its folder."""
BANDS = ("z_m", "sigma_m", "views", "source")
_TILE = 256
_DEFLATE_LEVEL = 1
"""Of heights, which hardly compress: at the usual 6 they take 3 % less room and twice the time."""
_CLOUD_POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "u1"), ("sigma_z", "<f4"), ("views", "<u2")]
)


def write_surface(
    surface: Surface, free: FreeSpace, tops: TopPhoto, folder: Path, frame_id: str,
    history: PlaceHistory | None = None,
) -> None:  # fmt: skip
    """Write what the map alone fills into an existing folder: cloud, heights, free space, photos, and of
    several passes which saw each cell last; each with the frame that its places are in.
    """
    write_height(surface, folder / "height.tif", frame_id)
    write_free(surface, free, folder / "free.tif", frame_id)
    write_orthophoto(surface, folder, frame_id)
    write_top_photo(surface, tops, folder / "tops.tif", frame_id)
    write_cloud(surface, folder / "cloud.ply", frame_id)
    if history is not None:
        write_passes(surface, history, folder / "passes.tif", frame_id)


def write_tables(measurement: Measurement, folder: Path) -> None:
    """Write trajectory, contours and the laser's profiles into an existing folder."""
    frame_id = measurement.frame_id
    write_trajectory(measurement.trajectory, folder / "trajectory.tum", frame_id)
    write_contours(measurement.contours, folder / "contour.csv")
    if measurement.laser:
        write_laser_csv(measurement.laser, folder / "laser.csv")


def write_results(measurement: Measurement, identity: MapIdentity, folder: Path) -> None:
    """Write all other files that a measurement fills but result.json, into an existing folder."""
    reference = measurement.trajectory.reference
    path = folder / "bundles.json"
    digest = write_bundles(measurement.bundles, measurement.stock, reference, identity, path)
    write_lifts(measurement.lifts, reference, identity, digest, folder / "lifts.json")
    if measurement.preview is not None:
        write_preview(measurement.preview, folder / "preview.png")


def write_trajectory(trajectory: Trajectory, target: Path, frame_id: str) -> None:
    """Write TUM: seconds with nine decimals, x y z qx qy qz qw of `yard_from_body` (or `world_from_body`).
    The frame stands in a comment.
    """
    with atomic_path(target) as path, path.open("w", encoding="ascii") as file:
        file.write(f"# {trajectory.reference}_from_body: timestamp_s x y z qx qy qz qw\n")
        file.write(f"# frame {frame_id}\n")
        for frame in trajectory.frames:
            pose = frame.reference_from_body
            numbers = (*pose.translation, *pose.quaternion_xyzw)
            file.write(f"{format_seconds(frame.stamp_ns)} {' '.join(f'{n:.9f}' for n in numbers)}\n")


def write_relative(trajectory: Trajectory, target: Path) -> None:
    """Write CSV, a row for each frame but the first: its pose in the body's axes of the frame before, x y z
    (m) and quaternion, and the upper triangle of its covariance row by row (rotation in rad, then translation
    in m, of a small motion that follows it); nan where it isn't known.
    """
    detail = trajectory.detail
    if detail is None or detail.relative is None:
        return
    upper = np.triu_indices(6)
    names = ",".join(f"c{i}{j}" for i, j in zip(*upper, strict=True))
    with atomic_path(target) as path, path.open("w", encoding="ascii") as file:
        file.write(f"#from [ns],to [ns],x [m],y [m],z [m],qx,qy,qz,qw,{names}\n")
        pairs = zip(trajectory.frames, trajectory.frames[1:], detail.relative.covariance, strict=False)
        for old, new, covariance in pairs:
            moved = old.reference_from_body.inverse() @ new.reference_from_body
            pose = ",".join(f"{n:.9f}" for n in (*moved.translation, *moved.quaternion_xyzw))
            spread = ",".join(f"{n:.6e}" for n in covariance[upper])
            file.write(f"{old.stamp_ns},{new.stamp_ns},{pose},{spread}\n")


def write_cloud(surface: Surface, target: Path, frame_id: str) -> None:
    """Write binary little-endian PLY of every height that enough views support, the frame in a comment."""
    count = sum(len(part.views) for part in surface.cloud())
    fields = "".join(
        f"property {kind} {name}\n"
        for name, kind in zip(
            _CLOUD_POINT.names or (), ("float", "float", "float", "uchar", "float", "ushort"), strict=True
        )
    )
    header = (
        f"ply\nformat binary_little_endian 1.0\ncomment barsight {barsight.__version__}\n"
        f"comment frame {frame_id}\nelement vertex {count}\n{fields}end_header\n"
    )
    with atomic_path(target) as path, path.open("wb") as file:
        file.write(header.encode("ascii"))
        for part in surface.cloud():
            points = np.empty(len(part.views), _CLOUD_POINT)
            points["x"], points["y"], points["z"] = part.xyz_m.T
            points["intensity"] = part.intensity
            points["sigma_z"] = part.sigma_z_m
            points["views"] = np.minimum(part.views, 65535)
            file.write(points.tobytes())


def write_height(surface: Surface, target: Path, frame_id: str) -> None:
    """Write a tiled GeoTIFF of four float32 bands; row 0 at the highest y; pixels are areas, NaN is
    no data.
    """
    rows, columns = surface.shape
    bands = "".join(
        f'<Item name="DESCRIPTION" sample="{i}" role="description">{name}</Item>'
        for i, name in enumerate(BANDS)
    )
    with atomic_path(target) as path:
        tifffile.imwrite(
            path,
            _height_tiles(surface),
            shape=(len(BANDS), rows, columns),
            dtype=np.float32,
            photometric="minisblack",
            planarconfig="separate",
            tile=(_TILE, _TILE),
            compression="zlib",
            compressionargs={"level": _DEFLATE_LEVEL},
            metadata=None,
            software=f"barsight {barsight.__version__}",
            extratags=[
                *georeference(surface, frame_id),
                (42112, "s", 0, f"<GDALMetadata>{bands}</GDALMetadata>", True),
                (42113, "s", 0, "nan", True),
            ],
        )


def write_free(surface: Surface, free: FreeSpace, target: Path, frame_id: str) -> None:
    """Write the upper bounds of what may stand in each cell (m) as a GeoTIFF on height.tif's grid."""

    def tiles() -> Iterator[Float32]:
        for row, column, height, width in _tiles_of(surface):
            tile = np.full((_TILE, _TILE), UNPROVEN)
            lowest = surface.rows[1] - row - height
            part = free.window(surface.columns[0] + column, lowest, width, height)
            tile[:height, :width] = np.round(part, 3)[::-1]
            yield tile

    with atomic_path(target) as path:
        tifffile.imwrite(
            path,
            tiles(),
            shape=surface.shape,
            dtype=np.float32,
            photometric="minisblack",
            tile=(_TILE, _TILE),
            compression="zlib",
            metadata=None,
            software=f"barsight {barsight.__version__}",
            extratags=[*georeference(surface, frame_id), (42113, "s", 0, "inf", True)],
        )


def _tiles_of(surface: Surface) -> Iterator[tuple[int, int, int, int]]:
    """First row from the highest y, first column, height and width of each tile of a raster."""
    rows, columns = surface.shape
    for row in range(0, rows, _TILE):
        for column in range(0, columns, _TILE):
            yield row, column, min(_TILE, rows - row), min(_TILE, columns - column)


def _height_tiles(surface: Surface) -> Iterator[Float32]:
    for band in BANDS:
        for row, column, height, width in _tiles_of(surface):
            lowest = surface.rows[1] - row - height
            window = surface.window(surface.columns[0] + column, lowest, width, height)
            tile = np.full((_TILE, _TILE), np.nan, np.float32)
            tile[:height, :width] = _band(window, band)[::-1]
            yield tile


def _band(window: Layers, band: str) -> Float32:
    values: Float32 = getattr(window, band).astype(np.float32)
    return values


def write_contours(contours: tuple[Contour, ...], target: Path) -> None:
    """Write `profile,x_m,y_m,z_m,sigma_m,source`; z and sigma are empty where nothing is known."""
    with atomic_path(target) as path, path.open("w", encoding="ascii") as file:
        file.write("profile,x_m,y_m,z_m,sigma_m,source\n")
        for contour in contours:
            for x, y, z, sigma, source in zip(
                contour.x_m, contour.y_m, contour.z_m, contour.sigma_m, contour.source, strict=True
            ):
                height = f"{z:.5f},{sigma:.5f}" if np.isfinite(z) else ","
                file.write(f"{contour.profile},{x:.4f},{y:.4f},{height},{source}\n")


def write_laser_csv(laser: tuple[LaserProfile, ...], target: Path) -> None:
    """Write the reference profiles as they were read: `profile,x_m,y_m,z_m,sigma_m`."""
    with atomic_path(target) as path, path.open("w", encoding="ascii") as file:
        file.write("profile,x_m,y_m,z_m,sigma_m\n")
        for profile in laser:
            sigma = f"{profile.range_std_m:.5f}" if np.isfinite(profile.range_std_m) else ""
            for x, y, z in zip(profile.x_m, profile.y_m, profile.z_m, strict=True):
                file.write(f"{profile.profile},{x:.4f},{y:.4f},{z:.5f},{sigma}\n")


def write_preview(preview: Preview, target: Path) -> None:
    """Write the rectified left picture beside its disparity in colours; black where there is none."""
    known = np.isfinite(preview.disparity_px)
    low, high = np.percentile(preview.disparity_px[known], (1, 99)) if known.any() else (0.0, 1.0)
    scaled = (preview.disparity_px - low) / max(high - low, 1e-6) * 255
    levels = np.where(known, np.nan_to_num(scaled).clip(0, 255), 0).astype(np.uint8)
    colours = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)
    colours[~known] = 0
    picture = np.hstack([cv2.cvtColor(preview.left, cv2.COLOR_GRAY2BGR), colours])
    scale = min(1.0, 1600 / picture.shape[1])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    encoded = cv2.imencode(".png", small)[1]
    with atomic_path(target) as path:
        path.write_bytes(encoded.tobytes())


def summary(measurement: Measurement) -> dict[str, Any]:
    """Build the content of result.json; rounded for people, NaN as null."""
    trajectory, surface = measurement.trajectory, measurement.surface
    stamps, captured = trajectory.stamp_ns, measurement.travel.captured_ns
    rows, columns = surface.shape
    cell = surface.cell_m
    content = {
        "schema_version": SCHEMA_VERSION,
        "software": {"name": "barsight", "version": barsight.__version__},
        "measured_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "captured_from_ns": captured[0] if captured else None,
        "captured_to_ns": captured[1] if captured else None,
        "is_simulated": measurement.is_simulated,
        **_ids(measurement),
        "recording": {"path": str(measurement.recording_path), "format": measurement.recording_format},
        "reference": trajectory.reference,
        "hashes": {
            "calibration": measurement.calibration_hash,
            "configuration": measurement.configuration_hash,
            "inputs": measurement.input_hashes,
        },
        "configuration": measurement.configuration,
        "sensors_used": list(measurement.sensors_used),
        "frames": {
            "total": measurement.frames_total,
            "used": measurement.frames_used,
            "refused": [
                {"stamp_ns": r.frame.stamp_ns, "stage": r.stage, "reason": r.frame.reason}
                for r in measurement.refusals
            ],
        },
        "trajectory": {
            "length_m": sum(one.length_m for one in measurement.passes) or trajectory.length_m,
            "duration_s": float(stamps[-1] - stamps[0]) / NS_PER_S if stamps.size else 0.0,
        },
        "travel": measurement.travel.content(),
        "rig_uncertainty": _rig_content(measurement.rig_covariance),
        "stages": [asdict(stage) for stage in measurement.stages],
        "seconds": measurement.seconds,
        "peak_memory_mib": measurement.peak_memory_mib,
        "map": {
            "cell_m": cell,
            "x_min_m": (surface.columns[0] - 0.5) * cell,
            "x_max_m": (surface.columns[1] - 0.5) * cell,
            "y_min_m": (surface.rows[0] - 0.5) * cell,
            "y_max_m": (surface.rows[1] - 0.5) * cell,
            "cells_seen": surface.seen,
            "cells_filled": surface.filled,
            "cells_unknown": rows * columns - surface.seen - surface.filled,
            "median_sigma_m": surface.median_sigma_m,
        },
        **_laser_content(measurement),
        "truth": None,
        "warnings": [asdict(warning) for warning in measurement.warnings],
        "vetoes": [{"code": v.code, "message": v.reason} for v in measurement.lifts.vetoes],
    }
    if measurement.passes:
        content["passes"] = [_pass_content(number, one) for number, one in enumerate(measurement.passes, 1)]
    rounded: dict[str, Any] = json_value(content, decimals=6)
    return rounded


def _ids(measurement: Measurement) -> dict[str, Any]:
    """Name the rig, and the frame of all places."""
    return {
        "calibration_id": measurement.calibration_hash[:ID_DIGITS],
        "yard_frame_id": measurement.yard_frame_id, "frame_id": measurement.frame_id,
    }  # fmt: skip


def _rig_content(covariance: Float64 | None) -> dict[str, Any] | None:
    """Describe what the cameras' calibration and the travel leave open of the rig."""
    if covariance is None:
        return None
    sigma = np.sqrt(np.diag(covariance))
    return {
        "yaw_deg": float(np.degrees(sigma[0])),
        "baseline_ratio": float(sigma[1]),
        "focal_ratio": float(sigma[2]),
        "correlation": (covariance / np.outer(sigma, sigma)).tolist(),
    }


def _laser_content(measurement: Measurement) -> dict[str, Any]:
    """Describe the laser's agreement, and its profiles' checks where they were to be fused."""
    checks = measurement.laser_checks
    return {
        "agreement": [asdict(agreement) for agreement in measurement.agreements],
        "laser": None if checks is None else [_check_content(check) for check in checks],
    }


def _check_content(check: LaserCheck) -> dict[str, Any]:
    """Describe a profile's check; offsets in mm, null where they can't be told."""
    offset = {field.name: getattr(check.offset, field.name, None) for field in fields(LaserOffset)}
    ratio = offset.pop("alike_ratio")
    told = {name.replace("_m", "_mm"): None if m is None else 1e3 * m for name, m in offset.items()}
    return {
        "profile": check.profile, "fused": check.is_believed, "samples": check.samples, **told,
        "alike_ratio": ratio, "reason": check.reason,
    }  # fmt: skip


def _pass_content(number: int, one: PassRecord) -> dict[str, Any]:
    """Describe one of several passes; turns in degrees, the scale as a share."""
    unknowns, sigma = one.correction.unknowns, np.sqrt(np.diag(one.correction.covariance))
    return {
        "number": number,
        "recording": {"path": str(one.recording_path), "format": one.recording_format},
        "inputs": one.input_hashes,
        "captured_from_ns": one.captured_ns[0] if one.captured_ns else None,
        "captured_to_ns": one.captured_ns[1] if one.captured_ns else None,
        "frames": {"used": one.frames_used, "total": one.frames_total},
        "trajectory": {"first_ns": one.first_ns, "last_ns": one.last_ns, "length_m": one.length_m},
        "moved": {
            "about_m": one.correction.about_m, "shift_m": unknowns[3:6], "shift_sigma_m": sigma[3:6],
            "turn_deg": np.degrees(unknowns[:3]), "turn_sigma_deg": np.degrees(sigma[:3]),
            "scale": unknowns[6], "scale_sigma": sigma[6],
        },
        "ties": [
            {
                "with_pass": tie.first + 1, "blocks": tie.blocks, "shift_m": tie.shift_m,
                "sigma_m": tie.sigma_m, "expected_sigma_m": tie.expected_sigma_m,
                "off_sigmas": tie.off_sigmas, "contradicts": tie.contradicts,
            }
            for tie in one.ties
        ],
        "changes": [
            {"low_m": c.low_m, "high_m": c.high_m, "area_m2": c.area_m2, "rise_m": c.rise_m}
            for c in one.changes
        ],
        "moves": [{"ends_m": m.ends_m, "width_m": m.width_m, "along_m": m.along_m} for m in one.moves],
    }  # fmt: skip
