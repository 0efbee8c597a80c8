"""Run `barsight live --replay RECORDING -o OUT`, `live --config crane.toml -o OUT`, `live check`, `soak`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from barsight.cli.arguments import call, config_path, load_settings
from barsight.cli.live import check, soak
from barsight.cli.measure import print_outcome
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError
from barsight.core.files import held_folder
from barsight.core.printing import printed_aside
from barsight.live.crane.run import measure_crane, measure_surveys, replay_surveys
from barsight.live.run import replay as replay_recording
from barsight.live.settings import LiveSettings, read_crane
from barsight.measure_settings import MeasureSettings


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and run."""
    if arguments[:1] in (["check"], ["soak"]):
        {"check": check, "soak": soak}[arguments[0]].run(arguments[1:])
        return
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
        surveys: bool = False,
    ) -> None:
        """Measure while pictures and readings arrive in real time: poses, a growing map, lifts at the end.

        Capture, tracking and mapping are separate processes, each restarted if it ends. During the run, OUT
        shows its state (state.json, health.json, health.prom, pose.json); at the end, it holds all files that
        measure writes, and latency.json. Ctrl-C ends the run in the same way as the end of the recording.

        Args:
            out: An empty or new folder.
            settings: Settings of the measurement.
            live: Settings of the run.
            replay: The recording to replay.
            speed: Replay speed as a multiple of real time; 0: as fast as possible, without losing frames.
            config: TOML file: measurement settings with --replay, else crane.toml; flags take precedence.
            magnet: TOML file of the magnet that lifts are chosen for; without it, no lift is offered.
            at: Time at which lifts are judged: now, or the recording's end for review, never for a crane.
            keyframes: keyframes.json of an earlier run; keep exactly the pairs that it kept.
            surveys: Run survey after survey, each in a folder of OUT: by the crane's stops, or per replay.
        """
        console = SafeConsole(stderr=True)
        if surveys and keyframes is not None:
            raise ConfigError("--keyframes is for one replay, without --surveys")
        if replay is None and (speed != 1 or at != "now" or keyframes is not None):
            raise ConfigError("--speed, --at and --keyframes are for --replay; a crane has its own pace")
        with printed_aside(console.print_line) as tell, stages(console) as advance, held_folder(out):
            common: dict[str, Any] = {"magnet": magnet, "tell": tell, "advance": advance}
            if replay is not None:
                run_replay = replay_surveys if surveys else partial(replay_recording, keyframes=keyframes)
                measured = run_replay(replay, out, settings, live, speed=speed, judged_at=at, **common)
            elif crane is None:
                raise ConfigError("live needs --replay RECORDING or --config crane.toml")
            else:
                measure = measure_surveys if surveys else measure_crane
                measured = measure(crane, out, settings, live, **common)
        if measured:
            print_outcome(measured, console, verbose=False)
            console.print_line(f"report: {out / 'report.html'}")

    call(command, "live", arguments)
