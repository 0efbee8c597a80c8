"""Define the format of the readings that IMU and encoders send.

A reading is little-endian: four bytes of kind (`BSI1` for the IMU, `BSC1` for the crane), a sequence number
(uint32), the stamp of the measurement on the sender's clock (int64, ns), and float64 values: gyro x, y, z
(rad/s) and accelerometer x, y, z (m/s2), or bridge x, trolley y and hoist z (m). A datagram holds one or more
of them. On a serial line, which has no checksum of its own, each is followed by its CRC-32.
"""

from __future__ import annotations

import struct

FORMS = {"imu": (b"BSI1", struct.Struct("<4sIq6d")), "crane": (b"BSC1", struct.Struct("<4sIq3d"))}
LIMITS = {"imu": (1e4, 1e4, 1e4, 1e5, 1e5, 1e5), "crane": (1e7, 1e7, 1e7)}
"""Largest magnitudes of values; beyond them a reading is garbage, not one in another unit."""
CRC_BYTES = 4
