"""Run `barsight simulate OUT`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import tyro

from barsight.artefacts.plan import read_plan
from barsight.calibration.boards.board import parse_board
from barsight.cli.arguments import call, config_path, load_settings
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError
from barsight.core.settings.values import MAX_VALUE
from barsight.registration.surveyed_targets import read_tags
from barsight.simulation.boards.pictures import photograph_board
from barsight.simulation.passes import simulate_passes
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.simulate import laid_stock, simulate
from barsight.simulation.worlds.artefacts import lay_artefacts
from barsight.simulation.worlds.tags import lay_tags

MAX_VIEWS = 200


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and render."""
    default = load_settings(config_path(arguments), SimulationSettings)

    def command(
        out: tyro.conf.Positional[Path],
        settings: Annotated[SimulationSettings, tyro.conf.arg(name="")] = default,
        config: Path | None = None,
        draw: int | None = None,
        artefacts: Path | None = None,
        tags: Path | None = None,
        tag_m: float = 0.3,
        board: str | None = None,
        views: int = 30,
    ) -> None:
        """Render a recording of a bar yard, with exact truth, as an EuRoC folder.

        Args:
            out: The folder to write; it must not exist yet.
            settings: The yard, the cameras, the crane and its sensors.
            config: TOML file with settings; flags take precedence.
            draw: Seed of a whole world to draw: irregular bundles and heaps settled by physics, their
                surroundings, crane, light, picture faults. Only length, frames, pictures and laser are then
                taken from the settings; truth/world.json describes the world.
            artefacts: Plan of an acceptance (see barsight accept): its plates, spheres and dummy bundles
                replace the stock, at exactly the planned places.
            tags: A .csv as for calibrate yard --tags: its AprilTags (36h11) are added, face up on thin
                plates, at exactly the listed places.
            tag_m: Side of a tag's black square, or diameter of a coded circle's disc, in metres.
            board: A calibration board (see barsight calibrate stereo): render pictures of it, taken by the
                rig of all other recordings with these settings, instead of a recording.
            views: Number of picture pairs of the board.
        """
        console = SafeConsole(stderr=True)
        if (artefacts or tags) is not None and (draw is not None or settings.passes.trolley_y_m):
            raise ConfigError("simulate: --artefacts or --tags takes no drawn world and no passes")
        if settings.renderer != "barsight" and (draw is not None or board is not None):
            raise ConfigError("simulate: --draw and --board take no --renderer mitsuba")
        if not 0.01 <= tag_m <= 2:
            raise ConfigError(f"simulate: --tag-m {tag_m:g} must lie between 0.01 and 2")
        if board is not None:
            _photograph(out, board, views, settings, console)
            return
        laid = None if artefacts is None else lay_artefacts(read_plan(artefacts), settings)
        if tags is not None:
            laid = lay_tags(laid or laid_stock(settings), read_tags(tags), tag_m, settings)
        with stages(console) as advance:
            if draw is not None:
                _simulate_drawn(out, draw, settings, lambda done, total: advance("render", done, total))
            elif settings.passes.trolley_y_m:
                simulate_passes(out, settings, lambda done, total: advance("render", done, total))
            else:
                simulate(out, settings, lambda done, total: advance("render", done, total), laid)
        console.print_line(f"simulated recording: {out}")

    call(command, "simulate", arguments)


def _photograph(
    out: Path, board: str, views: int, settings: SimulationSettings, console: SafeConsole
) -> None:
    if not 1 <= views <= MAX_VIEWS:
        raise ConfigError(f"simulate: --views {views} must lie between 1 and {MAX_VIEWS}")
    with stages(console) as advance:
        photograph_board(
            out, parse_board(board), views, settings, lambda done, total: advance("board", done, total)
        )
    console.print_line(f"simulated board pictures: {out}")


def _simulate_drawn(
    out: Path, seed: int, settings: SimulationSettings, progress: Callable[[int, int], None]
) -> None:
    if not 0 <= seed < MAX_VALUE:
        raise ConfigError(f"simulate: --draw takes a seed of 0 or more, not {seed}")
    # The physics package is an extra that only drawing needs.
    from barsight.simulation.worlds.recording import draw_world, simulate_world

    simulate_world(out, draw_world(seed, settings), progress)
