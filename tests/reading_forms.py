"""Readings as IMU and encoders send them."""

import struct

FORMS = {"imu": (b"BSI1", "<4sIq6d"), "crane": (b"BSC1", "<4sIq3d")}


def pack(sensor: str, number: int, stamp_ns: int, values: tuple[float, ...]) -> bytes:
    mark, form = FORMS[sensor]
    return struct.pack(form, mark, number % (1 << 32), stamp_ns, *values)
