"""Run `barsight live --replay RECORDING -o OUT` and `barsight live --config crane.toml -o OUT`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro

from barsight.cli.arguments import call, config_path, load_settings
from barsight.cli.measure import print_outcome
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError
from barsight.live.crane.run import measure_crane
from barsight.live.run import replay as replay_recording
from barsight.live.settings import LiveSettings, read_crane
from barsight.measure_settings import MeasureSettings


def run(arguments: Sequence[str]) -> None:
    """Parse and run."""
    at_config, is_replay = config_path(arguments), any(a.split("=")[0] == "--replay" for a in arguments)
    crane = None if is_replay or at_config is None else read_crane(at_config)
    default = load_settings(at_config, MeasureSettings) if crane is None else crane.measure
    default_live = LiveSettings() if crane is None else crane.live

    def command(
        out: Annotated[Path, tyro.conf.arg(aliases=("-o",))],
        settings: Annotated[MeasureSettings, tyro.conf.arg(name="")] = default,
        live: LiveSettings = default_live,
        replay: Path | None = None,
        speed: float = 1.0,
        config: Path | None = None,
        magnet: Path | None = None,
        at: Literal["now", "end"] = "now",
        keyframes: Path | None = None,
    ) -> None:
        """Measure while pictures and readings come, each at its time: poses, a growing map, lifts at the end.

        Capture, tracking and mapping are processes of their own; each is started anew if it ends. OUT tells
        at any time how the run stands (state.json, health.json, health.prom, pose.json) and has at the end
        all that measure writes, and latency.json. Ctrl-C ends the run as the recording's end does. Pictures
        and readings come from the sensors of crane.toml, or from a recording with --replay.

        Args:
            out: An empty or new folder.
            settings: Settings of measuring.
            live: Settings of the run.
            replay: The recording to replay.
            speed: Recorded seconds a second; 0: as fast as possible, and nothing is lost.
            config: With --replay a TOML file with settings of measuring, else crane.toml; flags go before it.
            magnet: TOML file of the magnet that lifts are chosen for; without it nothing is offered.
            at: When lifts are judged: now, or at the end of the recording, to look back; never for a crane.
            keyframes: keyframes.json of an earlier run: keep just the pairs that it kept.
        """
        console = SafeConsole(stderr=True)

        def tell(line: str) -> None:
            console.print(line, soft_wrap=True, highlight=False, markup=False)

        with stages(console) as advance:
            if replay is not None:
                measured = replay_recording(
                    replay, out, settings, live, speed=speed, magnet=magnet, judged_at=at,
                    keyframes=keyframes, tell=tell, advance=advance,
                )  # fmt: skip
            elif crane is None:
                raise ConfigError("live needs --replay RECORDING or --config crane.toml")
            elif speed != 1 or at != "now" or keyframes is not None:
                raise ConfigError("--speed, --at and --keyframes are for --replay; a crane has its own pace")
            else:
                measured = measure_crane(
                    crane, out, settings, live, magnet=magnet, tell=tell, advance=advance
                )  # fmt: skip
        print_outcome(measured, console, verbose=False)
        console.print(f"report: {out / 'report.html'}", soft_wrap=True, highlight=False, markup=False)

    call(command, "live", arguments)
