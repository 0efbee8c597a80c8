"""Serve `barsight view`: surface, cloud, camera path and contours in the browser of this computer."""

from __future__ import annotations

import contextlib
import errno
import http
import io
import socket
import threading
import webbrowser
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import viser
from viser.infra import _infra

from barsight.core.arrays import Float32, Float64, UInt8
from barsight.core.errors import OutputError
from barsight.core.records.heights import Contour
from barsight.core.records.sensor_samples import LaserProfile
from barsight.result_folder import (
    CameraPath,
    Cloud,
    open_folder,
    read_cloud,
    read_contours,
    read_heights,
    read_laser,
    read_path,
)
from barsight.viewer.cloud import Layer, colour_layer, seen_layer, surface_layer
from barsight.viewer.yard_lines import yard_lines

HOST = "127.0.0.1"
MAX_POINTS = 2_000_000
MAX_AXES = 200
MAX_LINE_POINTS = 20_000
YARD_RGB = {
    "free": (57, 211, 83),
    "covered": (242, 177, 52),
    "axes": (255, 255, 255),
    "poles": (255, 47, 179),
}
LASER_RGB, CONTOUR_RGB, PATH_RGB = (230, 40, 40), (255, 140, 0), (30, 110, 200)


def view(out_dir: Path, port: int = 8080, open_browser: bool = True, max_points: int = MAX_POINTS) -> None:
    """Serve the folder until Ctrl-C and print the URL. Port 0 chooses a free one.

    Raises InputError for a folder without a readable result.json and cloud.ply, OutputError if the port is
    taken or may not be used.
    """
    with serving(out_dir, port, max_points) as url:
        print(f"{out_dir}: {url} (Ctrl-C ends it)", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            if open_browser:
                webbrowser.open(url)
            threading.Event().wait()


@contextlib.contextmanager
def serving(out_dir: Path, port: int, max_points: int = MAX_POINTS) -> Iterator[str]:
    """Serve the folder to this computer's browsers while the context is open; yield the URL."""
    summary, _ = open_folder(out_dir, cloud=True)
    cloud = read_cloud(out_dir / "cloud.ply", max_points)
    path, laser, contours = read_path(out_dir), read_laser(out_dir), read_contours(out_dir)
    yard = yard_lines(out_dir)
    layers = {
        "surface": surface_layer(read_heights(out_dir), max_points),
        "everything seen": seen_layer(cloud),
    }
    layers = {name: layer for name, layer in layers.items() if layer.total}  # a map may know no height
    _expect_free(port)
    with _quiet(), _own_pages_only():
        server = viser.ViserServer(host=HOST, port=port, label="barsight", verbose=False)
    try:
        if port not in (0, server.get_port()):
            raise OutputError(f"port {port} was taken at this moment; name another port")
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.scene.set_up_direction("+z")
        _aim(server, cloud, path)
        _show_points(server, layers)
        _show_lines(server, path, laser, contours)
        _show_yard(server, yard)
        where = str(summary.get("reference", "world"))
        simulated = " **SIMULATED.**" if summary.get("is_simulated") else ""
        counts = (f"{name}: {len(layer.xyz_m):,} of {layer.total:,} points" for name, layer in layers.items())
        server.gui.add_markdown(f"{'; '.join(counts)}. {where} frame.{simulated}")
        yield f"http://{HOST}:{server.get_port()}"
    finally:
        with _quiet():
            server.stop()


def _quiet() -> contextlib.redirect_stdout[io.StringIO]:
    """Suppress viser's own announcement; the command prints its own line."""
    return contextlib.redirect_stdout(io.StringIO())


@contextlib.contextmanager
def _own_pages_only() -> Iterator[None]:
    """Make the server that is started here refuse requests from other pages in the same browser, with a
    foreign Host or Origin. viser has no setting for it, so its websockets server gets the check.
    """
    library: Any = _infra
    module = library.websockets.asyncio.server
    serve = module.serve

    def guarded(*places: Any, process_request: Any, **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            hosts = {f"{name}:{connection.local_address[1]}" for name in (HOST, "localhost")}
            origins = request.headers.get_all("Origin")
            own = {f"http://{host}" for host in hosts}
            named = request.headers.get_all("Host")
            if len(named) != 1 or named[0] not in hosts or not set(origins) <= own:
                return connection.respond(http.HTTPStatus.FORBIDDEN, "another page's request is refused\n")
            return process_request(connection, request)

        return serve(*places, process_request=check, **options)

    module.serve = guarded
    try:
        yield
    finally:
        module.serve = serve


def _expect_free(port: int) -> None:
    """Raise an error if the port is taken, as viser silently takes the next one."""
    if not 0 <= port <= 65535:
        raise OutputError(f"port {port} does not exist; name a port from 1024 to 65535")
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            reason = "is taken" if error.errno == errno.EADDRINUSE else "may not be used"
            raise OutputError(f"port {port} {reason}; name another port") from error


def _aim(server: viser.ViserServer, cloud: Cloud, path: CameraPath | None) -> None:
    """Aim at most of the points and the camera path, obliquely from above on the low-y side."""
    low, high = np.percentile(cloud.xyz_m, (2, 98), axis=0).astype(np.float64)
    if path is not None and path.stamp_ns.size:
        low, high = (
            np.minimum(low, path.position_m.min(axis=0)),
            np.maximum(high, path.position_m.max(axis=0)),
        )
    middle = (low + high) / 2
    reach = max(float(np.linalg.norm(high - low)), 0.5)
    server.initial_camera.look_at = middle
    server.initial_camera.position = middle + reach * np.array([-0.12, -0.75, 0.6])
    server.initial_camera.fov = np.radians(50.0)
    server.initial_camera.far = max(1000.0, 50 * reach)


def _show_points(server: viser.ViserServer, layers: dict[str, Layer]) -> None:
    """Show one of the layers at a time, with a choice of its colouring."""
    shown = server.gui.add_dropdown("Show", tuple(layers))
    by = server.gui.add_dropdown("Colour by", tuple(layers[shown.value].properties))
    scale = server.gui.add_image(_legend(np.zeros((256, 3), np.uint8)))
    caption = server.gui.add_markdown("")
    size_mm = _spacing_m(layers[shown.value].xyz_m) * 1e3
    size = server.gui.add_slider("Point size / mm", 1.0, 200.0, 0.5, round(size_mm * 2) / 2)

    def place() -> viser.PointCloudHandle:
        layer = layers[shown.value]
        painted = colour_layer(layer, by.value)
        scale.image, caption.content = _legend(painted.ramp), painted.caption
        return server.scene.add_point_cloud(
            "/points", layer.xyz_m, painted.rgb,
            point_size=size.value / 1e3, point_shape="square", precision="float32",
        )  # fmt: skip

    node = place()

    @shown.on_update
    def _exchange(_: object) -> None:
        nonlocal node
        by.options = tuple(layers[shown.value].properties)
        node = place()

    @by.on_update
    def _recolour(_: object) -> None:
        painted = colour_layer(layers[shown.value], by.value)
        node.colors = painted.rgb
        scale.image, caption.content = _legend(painted.ramp), painted.caption

    @size.on_update
    def _resize(_: object) -> None:
        node.point_size = size.value / 1e3


def _legend(ramp: UInt8) -> UInt8:
    """Draw the colour scale as a picture (12, 256, 3), low at the left."""
    return np.tile(ramp, (12, 1, 1))


def _spacing_m(xyz_m: Float32) -> float:
    """Estimate the distance between neighbouring points from the area of most points: 2 mm to 100 mm."""
    low, high = np.percentile(xyz_m[:, :2], (2, 98), axis=0)
    area = float(np.prod(np.maximum(high - low, 0.01)))
    return float(np.clip(np.sqrt(area / len(xyz_m)), 0.002, 0.1))


def _show_lines(
    server: viser.ViserServer,
    path: CameraPath | None,
    laser: tuple[LaserProfile, ...],
    contours: tuple[Contour, ...],
) -> None:
    """Show each kind of line under one name, with a checkbox that hides it."""
    if path is not None and path.stamp_ns.size:
        _checkbox(server, "Camera path", "/path", True)
        _line(server, "/path/line", path.position_m, PATH_RGB)
        step = -(-path.stamp_ns.size // MAX_AXES)
        server.scene.add_batched_axes(
            "/path/frames",
            batched_wxyzs=path.quaternion_xyzw[::step][:, [3, 0, 1, 2]],
            batched_positions=path.position_m[::step],
            axes_length=0.25,
            axes_radius=0.01,
        )
    if laser:
        _checkbox(server, "Laser profiles", "/laser", True)
        for profile in laser:
            points = np.stack([profile.x_m, profile.y_m, profile.z_m], axis=1)
            _line(server, f"/laser/{profile.profile}", points, LASER_RGB)
    if contours:
        _checkbox(server, "Contours", "/contours", not laser)
        for contour in contours:
            points = np.stack([contour.x_m, contour.y_m, contour.z_m], axis=1)
            _line(server, f"/contours/{contour.profile}", points, CONTOUR_RGB)
    _checkbox(server, "Axes (1 m)", "/axes", True)
    server.scene.add_frame("/axes/origin", axes_length=1.0, axes_radius=0.015)


def _show_yard(server: viser.ViserServer, yard: dict[str, Float32]) -> None:
    """Show boxes and axes of the bundles, and the magnet's poles at offered lifts."""
    if {"free", "covered"} & set(yard):
        _checkbox(server, "Bundles", "/bundles", True)
    if "poles" in yard:
        _checkbox(server, "Lifts", "/lifts", True)
    for name, segments in yard.items():
        where = "/lifts/poles" if name == "poles" else f"/bundles/{name}"
        server.scene.add_line_segments(
            where, segments, YARD_RGB[name], thickness=2.0, thickness_units="screen"
        )


def _checkbox(server: viser.ViserServer, label: str, name: str, visible: bool) -> None:
    node = server.scene.add_frame(name, show_axes=False, visible=visible)
    box = server.gui.add_checkbox(label, visible)

    @box.on_update
    def _toggle(_: object) -> None:
        node.visible = box.value


def _line(server: viser.ViserServer, name: str, points_m: Float64, rgb: tuple[int, int, int]) -> None:
    segments = line_segments(points_m)
    if len(segments):
        server.scene.add_line_segments(name, segments, rgb, thickness=3.0, thickness_units="screen")


def line_segments(points_m: Float64) -> Float32:
    """Join consecutive points of (N, 3) to segments (M, 2, 3), with gaps at unknown points.

    A line of more than MAX_LINE_POINTS points is thinned.
    """
    thinned = points_m[:: max(1, -(-len(points_m) // MAX_LINE_POINTS))]
    joints = np.stack([thinned[:-1], thinned[1:]], axis=1)
    return joints[np.isfinite(joints).all(axis=(1, 2))].astype(np.float32)
