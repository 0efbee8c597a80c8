"""Read the laser's profiles from a ROS point cloud."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.errors import InputError

NAMES = ("profile", "x", "y", "z")
KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def laser_rows(path: Path, cloud: Any) -> Float64:
    """Read profile, x, y, z (N, 4) (m, `yard`) of a decoded PointCloud2. Raises `InputError` about `path`."""
    order = ">" if cloud.is_bigendian else "<"
    fields = {field.name: field for field in cloud.fields}
    missing = [name for name in NAMES if name not in fields or fields[name].datatype not in KINDS]
    count = int(cloud.width) * int(cloud.height)
    if missing or cloud.data.size < count * cloud.point_step:
        problem = f"has no field {missing[0]}" if missing else "is cut short"
        raise InputError(path, f"the laser's point cloud {problem}", "write it with `barsight convert`")
    try:
        dtype = np.dtype(
            {
                "names": list(NAMES),
                "formats": [order + KINDS[fields[name].datatype] for name in NAMES],
                "offsets": [int(fields[name].offset) for name in NAMES],
                "itemsize": int(cloud.point_step),
            }
        )
    except ValueError as error:
        problem = f"has impossible fields ({error})"
        raise InputError(
            path, f"the laser's point cloud {problem}", "write it with `barsight convert`"
        ) from None
    points = np.frombuffer(cloud.data.tobytes(), dtype=dtype, count=count)
    return np.stack([points[name].astype(np.float64) for name in NAMES], axis=1)
