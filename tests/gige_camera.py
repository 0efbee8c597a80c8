"""Play pictures as a GigE Vision camera, through Debian's libaravis, in a network namespace.

Usage: gige_camera.py INTERFACE SERIAL PICTURES.npy TIMES OFFSET_NS DRIFT_PPM [FEATURE PTP].

PICTURES is (N, H, W). TIMES is either a period in ns: the camera runs free, its block numbers and the first
eight bytes of each picture are its tick, a whole number of periods of the host's time, and PICTURES.SERIAL
has the ticks of all that it made (uint64); or a file (N,) of the host's times in ns, at each of which one
picture is triggered.
The camera's clock is OFFSET_NS off and runs DRIFT_PPM fast. With FEATURE (PtpStatus, or GevIEEE1588Status as
older cameras name it) the camera tells what the file PTP has as PTP's state, read again all the time.
"""

import ctypes as c
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

WIDTH, HEIGHT, PERIOD_US, TRIGGER = 0x100, 0x104, 0x138, 0x30C
"""Registers of Aravis' fake camera."""
POLL_NS = 5_000_000
WRAP = 65535
STATE = 0x8000
STATES = (
    "Initializing",
    "Faulty",
    "Disabled",
    "Listening",
    "PreMaster",
    "Master",
    "Passive",
    "Uncalibrated",
    "Slave",
)
FILL = c.CFUNCTYPE(None, c.c_void_p, c.c_void_p, c.c_uint32, c.c_uint32, c.c_uint32)


def library() -> Any:
    """Load libaravis. Raises OSError where there is none."""
    lib = c.CDLL("libaravis-0.8.so.0")
    lib.arv_gv_fake_camera_new_full.restype = lib.arv_fake_camera_new.restype = c.c_void_p
    lib.arv_gv_fake_camera_new_full.argtypes = [c.c_char_p, c.c_char_p, c.c_char_p]
    lib.arv_fake_camera_new.argtypes = [c.c_char_p]
    lib.arv_fake_camera_get_genicam_xml.restype = c.c_void_p
    lib.arv_fake_camera_get_genicam_xml.argtypes = [c.c_void_p, c.POINTER(c.c_size_t)]
    lib.arv_gv_fake_camera_get_fake_camera.restype = c.c_void_p
    lib.arv_gv_fake_camera_get_fake_camera.argtypes = [c.c_void_p]
    lib.arv_gv_fake_camera_is_running.argtypes = [c.c_void_p]
    lib.arv_buffer_get_data.restype = c.c_void_p
    lib.arv_buffer_get_data.argtypes = [c.c_void_p, c.POINTER(c.c_size_t)]
    lib.arv_buffer_set_frame_id.argtypes = [c.c_void_p, c.c_uint64]
    lib.arv_buffer_set_timestamp.argtypes = [c.c_void_p, c.c_uint64]
    lib.arv_fake_camera_set_fill_pattern.argtypes = [c.c_void_p, FILL, c.c_void_p]
    lib.arv_fake_camera_write_register.argtypes = [c.c_void_p, c.c_uint32, c.c_uint32]
    return lib


def describe_ptp(lib: Any, feature: str) -> bytes:
    """Write Aravis' description of its camera with PTP's state added; its path."""
    size = c.c_size_t()
    own = lib.arv_fake_camera_get_genicam_xml(lib.arv_fake_camera_new(b"any"), c.byref(size))
    entries = "".join(
        f'<EnumEntry Name="{name}"><Value>{k}</Value></EnumEntry>' for k, name in enumerate(STATES)
    )
    added = f"""<Enumeration Name="{feature}">{entries}<pValue>PtpRegister</pValue></Enumeration>
        <IntReg Name="PtpRegister"><Address>{STATE:#x}</Address><Length>4</Length><AccessMode>RO</AccessMode>
        <pPort>Device</pPort><Cachable>NoCache</Cachable><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess>
        </IntReg>"""
    text = c.string_at(own, size.value).decode()
    before, mark, after = text.partition('<Category Name="TransportLayerControl" NameSpace="Standard">')
    listed = f"{before}{added}{mark}<pFeature>{feature}</pFeature>{after}"
    with tempfile.NamedTemporaryFile("w", suffix=".xml", delete=False) as file:
        file.write(listed)
    return file.name.encode()


def main() -> None:
    interface, serial, path, times, offset_ns, drift_ppm, *ptp = sys.argv[1:]
    pictures, lib, begun_ns = np.load(path), library(), time.time_ns()
    is_free = times.isdigit()
    period_ns = int(times) if is_free else POLL_NS
    due: list[int] = [] if is_free else np.load(times).tolist()
    shown = [0]
    made = os.open(f"{path}.{serial}", os.O_WRONLY | os.O_CREAT | os.O_APPEND)

    def fill(buffer: Any, *_: Any) -> None:
        tick = time.time_ns() // period_ns
        at_ns = tick * period_ns if is_free else due[shown[0]]
        picture = pictures[(tick if is_free else shown[0]) % len(pictures)]
        place = lib.arv_buffer_get_data(buffer, None)
        c.memmove(place, picture.ctypes.data, picture.nbytes)
        if is_free:
            c.memmove(place, c.byref(c.c_uint64(tick)), 8)
            lib.arv_buffer_set_frame_id(buffer, tick % WRAP + 1)
            os.write(made, c.c_uint64(tick))
        drift_ns = round((at_ns - begun_ns) * float(drift_ppm) * 1e-6)
        lib.arv_buffer_set_timestamp(buffer, at_ns + int(offset_ns) + drift_ns)

    kept = FILL(fill)
    described = describe_ptp(lib, ptp[0]) if ptp else None
    camera = lib.arv_gv_fake_camera_new_full(interface.encode(), serial.encode(), described)
    inner = lib.arv_gv_fake_camera_get_fake_camera(camera)
    size = {WIDTH: pictures.shape[2], HEIGHT: pictures.shape[1], PERIOD_US: period_ns // 1000}
    for register, value in size.items():
        lib.arv_fake_camera_write_register(inner, register, value)
    lib.arv_fake_camera_set_fill_pattern(inner, kept, None)
    sys.stdout.write(f"running {lib.arv_gv_fake_camera_is_running(camera)}\n")
    sys.stdout.flush()
    for number, at_ns in enumerate(due):
        if at_ns < begun_ns:
            continue  # what a camera that begins later misses
        time.sleep(max(at_ns - time.time_ns(), 0) / 1e9)
        shown[0] = number
        lib.arv_fake_camera_write_register(inner, TRIGGER, 1)
    while True:
        if ptp:
            lib.arv_fake_camera_write_register(inner, STATE, STATES.index(Path(ptp[1]).read_text()))
        time.sleep(0.1)


if __name__ == "__main__":
    main()
