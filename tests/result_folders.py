"""A small measured folder as `barsight measure` would write it: bars on a floor, a hole, filled cells."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

CELL_M = 0.01
LEFT_M, TOP_M = -0.5, 1.0
ROWS, COLUMNS = 150, 300
BIAS_MM = (3.0, -2.0)
PROFILE_Y_M = (0.45, -0.2)
CLOUD_POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "u1"), ("sigma_z", "<f4"), ("views", "<u2")]
)


def surface_m(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bars of 180 mm along Y from x = 0.3 m to 2.1 m."""
    across = np.mod(x - 0.3, 0.18) - 0.09
    bar = 0.4 + np.sqrt(np.clip(0.09**2 - across**2, 0, None))
    return np.where((x > 0.3) & (x < 2.1), bar, 0.0)


def bands() -> NDArray[np.float32]:
    """(4, ROWS, COLUMNS) of height.tif: unknown cells at the right, a block of filled ones."""
    x = LEFT_M + (np.arange(COLUMNS) + 0.5) * CELL_M
    z = np.tile(surface_m(x), (ROWS, 1))
    sigma = np.tile(0.004 + 0.002 * np.abs(x), (ROWS, 1))
    views = np.full(z.shape, 5.0)
    source = np.ones(z.shape)
    source[60:70, 100:110] = 3
    source[:, 280:] = 0
    z[source == 0] = np.nan
    sigma[source == 0] = np.nan
    views[source != 1] = 0
    return np.stack([z, sigma, views, source]).astype(np.float32)


def write_folder(folder: Path, *, laser: bool = True, **changes: Any) -> Path:
    """Fabricate the folder; `changes` replace keys of result.json."""
    folder.mkdir(parents=True, exist_ok=True)
    write_height(folder / "height.tif", bands())
    _write_profiles(folder, laser)
    _write_cloud(folder / "cloud.ply")
    with (folder / "trajectory.tum").open("w") as file:
        for k in range(12):
            angle = np.radians(0.1) * np.sin(k)
            numbers = (0.25 * k, 0.15, 8.0, np.cos(angle), np.sin(angle), 0.0, 0.0)
            file.write(f"{1700000000 + k}.500000000 {' '.join(f'{n:.9f}' for n in numbers)}\n")
    preview = np.zeros((20, 60, 3), np.uint8)
    (folder / "preview.png").write_bytes(cv2.imencode(".png", preview)[1].tobytes())
    result = summary() | changes
    if not laser:
        result["agreement"] = []
    (folder / "result.json").write_text(json.dumps(result), encoding="utf-8")
    return folder


def write_height(path: Path, layers: NDArray[np.float32], *, tile: int = 64) -> None:
    """Planar, tiled, compressed, with the two tags that place it."""
    tags = [
        (33550, "d", 3, (CELL_M, CELL_M, 0.0), True),
        (33922, "d", 6, (0.0, 0.0, 0.0, LEFT_M, TOP_M, 0.0), True),
    ]
    tifffile.imwrite(
        path,
        layers,
        photometric="minisblack",
        planarconfig="separate",
        tile=(tile, tile),
        compression="zlib",
        compressionargs={"level": 1},
        metadata=None,
        extratags=tags,
    )


def _write_profiles(folder: Path, laser: bool) -> None:
    x = np.round(np.arange(-0.4, 2.4, CELL_M), 4)
    lines, reference = ["profile,x_m,y_m,z_m,sigma_m,source"], ["profile,x_m,y_m,z_m"]
    for profile, (y, bias) in enumerate(zip(PROFILE_Y_M, BIAS_MM, strict=True)):
        for k, (place, z) in enumerate(zip(x, surface_m(x), strict=True)):
            if 100 <= k < 110:
                lines.append(f"{profile},{place:.4f},{y:.4f},,,0")
            else:
                source = 3 if 110 <= k < 114 else 1
                lines.append(f"{profile},{place:.4f},{y:.4f},{z + bias / 1e3:.5f},0.00500,{source}")
            reference.append(f"{profile},{place:.4f},{y:.4f},{z:.5f}")
    (folder / "contour.csv").write_text("\n".join(lines) + "\n")
    if laser:
        (folder / "laser.csv").write_text("\n".join(reference) + "\n")


def _write_cloud(path: Path) -> None:
    points = np.zeros(5000, CLOUD_POINT)
    draw = np.random.default_rng(1)
    points["x"], points["y"] = draw.uniform(-0.5, 2.5, 5000), draw.uniform(-0.5, 1.0, 5000)
    points["z"] = surface_m(points["x"].astype(np.float64))
    points["intensity"] = draw.integers(0, 255, 5000)
    points["sigma_z"], points["views"] = 0.005, 4
    write_points(path, points)


def write_points(path: Path, points: NDArray[np.void]) -> None:
    """A PLY of CLOUD_POINT's properties, as formats.md says."""
    names = {"f4": "float", "u1": "uchar", "u2": "ushort"}
    kinds = [(name, names[CLOUD_POINT[name].str[1:]]) for name in CLOUD_POINT.names or ()]
    fields = "".join(f"property {kind} {name}\n" for name, kind in kinds)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {points.size}\n{fields}end_header\n"
    path.write_bytes(header.encode("ascii") + points.tobytes())


def agreement_row(profile: int, y_m: float, bias_mm: float) -> dict[str, Any]:
    """One profile of a laser beside the map, which lies bias_mm off everywhere."""
    off = dict.fromkeys(("median_mm", "mae_mm", "smooth_mae_mm", "rmse_mm", "p95_mm", "max_mm"), abs(bias_mm))
    between = {"loa_low_mm": bias_mm - 1.0, "loa_high_mm": bias_mm + 1.0}
    seen = {"profile": profile, "y_m": y_m, "samples": 266, "coverage_pct": 95.0}
    return {**seen, "bias_mm": bias_mm, **off, **between}


def summary() -> dict[str, Any]:
    """result.json as a dictionary."""
    return {
        "schema_version": 1,
        "software": {"name": "barsight", "version": "0.1.0"},
        "is_simulated": True,
        "recording": {"path": "yards/<north> & south", "format": "euroc"},
        "reference": "yard",
        "calibration_id": "ca1b",
        "yard_frame_id": "f00d",
        "hashes": {"calibration": "ca1b", "configuration": "c0f1", "inputs": {"cam0/data.csv": "1a2b"}},
        "configuration": {"stereo": {"method": "sgbm", "min_disparity_px": None}},
        "sensors_used": ["stereo", "crane"],
        "frames": {
            "total": 14,
            "used": 12,
            "refused": [
                {"stamp_ns": 1700000012500000000, "stage": "recording", "reason": "cam1: <png> is cut short"},
                {"stamp_ns": 1700000013500000000, "stage": "stereo", "reason": "too few matches"},
            ],
        },
        "trajectory": {"length_m": 2.75, "duration_s": 11.0},
        "stages": [
            {"name": "stereo", "seconds": 6.0, "frames": 12},
            {"name": "surface", "seconds": 0.5, "frames": 0},
        ],
        "peak_memory_mib": 1512.3,
        "map": {
            "cell_m": CELL_M,
            "x_min_m": LEFT_M,
            "x_max_m": LEFT_M + COLUMNS * CELL_M,
            "y_min_m": TOP_M - ROWS * CELL_M,
            "y_max_m": TOP_M,
            "cells_seen": 41900,
            "cells_filled": 100,
            "cells_unknown": 3000,
            "median_sigma_m": 0.006,
        },
        "agreement": [
            agreement_row(profile, y, bias)
            for profile, (y, bias) in enumerate(zip(PROFILE_Y_M, BIAS_MM, strict=True))
        ],
        "seconds": 12.5,
        "truth": {"smooth": {"median_mm": 6.25, "coverage_pct": 97.0}},
        "warnings": [{"code": "frames-refused", "message": "2 of 14 frames were refused"}],
        "vetoes": [],
    }
