"""Write the map's heights as a point cloud."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import barsight
from barsight.core.files import atomic_path
from barsight.mapping.surface.surface import Surface

_CLOUD_POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "u1"), ("sigma_z", "<f4"), ("views", "<u2")]
)


def write_cloud(surface: Surface, target: Path, frame_id: str) -> None:
    """Write binary little-endian PLY with every height supported by enough views, the frame in a comment."""
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
