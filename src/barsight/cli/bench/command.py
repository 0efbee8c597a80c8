"""Run `barsight bench NAME`: print tables that compare methods side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from inspect import getdoc
from pathlib import Path
from typing import Annotated

import tyro

from barsight.benchmarks.stereo.ablation import without_one_part
from barsight.benchmarks.stereo.middlebury import bench_stereo, scene_table, stereo_table
from barsight.benchmarks.stereo.speed import bench_speed, speed_table, time_chain
from barsight.benchmarks.stereo.steps import write_steps
from barsight.benchmarks.stereo.subpixel import bench_subpixel, subpixel_table
from barsight.benchmarks.stereo.target_size import bench_target_size, target_size_table
from barsight.cli.arguments import call, print_kinds
from barsight.cli.bench import matching
from barsight.cli.bench.bundles import bench_found_bundles
from barsight.cli.bench.length import bench_length
from barsight.cli.bench.lifts import bench_lift_targets
from barsight.cli.bench.live import bench_live_estimate, bench_step
from barsight.cli.bench.renderers import bench_renderers
from barsight.cli.bench.seeds import expect_counts
from barsight.cli.bench.worlds import bench_worlds
from barsight.cli.bench.yard import bench_yard
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError
from barsight.core.json_values import write_json
from barsight.stereo.direct.pipeline import BarsightSettings
from barsight.stereo.method import StereoMethod
from barsight.stereo.settings import METHODS, MethodName, StereoSettings, make_method

Json = Annotated[Path | None, tyro.conf.arg(name="json")]


def run(arguments: Sequence[str]) -> None:
    """Parse `bench NAME ...` and run that benchmark."""
    benches: dict[str, Callable[..., None]] = {
        "stereo": _stereo,
        "stereo-speed": _stereo_speed,
        "stereo-steps": _stereo_steps,
        "ablation": _ablation,
        "subpixel": _subpixel,
        "target-size": _target_size,
        "yard": bench_yard,
        "bundles": bench_found_bundles,
        "lifts": bench_lift_targets,
        "worlds": bench_worlds,
        "renderers": bench_renderers,
        "features": matching.features,
        "matching": matching.matching,
        "front-end": matching.front_end,
        "live": bench_live_estimate,
        "live-step": bench_step,
        "length": bench_length,
    }
    names = ", ".join(benches)
    if not arguments:
        raise ConfigError(f"bench needs a benchmark: {names}; --help says what each does")
    if arguments[0] in ("-h", "--help"):
        print_kinds("bench", {name: (getdoc(bench) or "").split("\n")[0] for name, bench in benches.items()})
        return
    if arguments[0] not in benches:
        raise ConfigError(f"there is no benchmark {arguments[0]!r}; choose {names}")
    call(benches[arguments[0]], f"bench {arguments[0]}", arguments[1:])


def _stereo(
    data: tyro.conf.Positional[Path],
    methods: tuple[MethodName, ...] = METHODS,
    repeats: int = 5,
    save: Json = None,
) -> None:
    """Measure accuracy and time of stereo methods on Middlebury-style folders with true disparity.

    Args:
        data: A folder of scenes, each with left.png, right.png, disp.pfm and optionally nonocc.png.
        methods: The methods to compare.
        repeats: Runs per method and scene; times are given as medians and ranges.
        save: JSON file for all figures, with commit and machine.
    """
    expect_counts(repeats=repeats)
    bench = bench_stereo(data, _made(methods), repeats)
    console = SafeConsole()
    console.print(scene_table(bench))
    console.print(stereo_table(bench))
    if save is not None:
        write_json(save, bench)


def _stereo_speed(
    methods: tuple[MethodName, ...] = METHODS,
    recording: Path | None = None,
    repeats: int = 5,
    save: Json = None,
) -> None:
    """Time stereo methods on a 1280x1024 pair with 96 candidates, against OpenCV's 5-path SGBM.

    Barsight's method is timed in both presets, with occlusions filled as for `disparity` and without as
    for a map.

    Args:
        methods: The methods to compare.
        recording: A recording with crane encoders, whose first pairs are also timed as its map uses them:
            the first matched from scratch, the next five each predicted from the pair before.
        repeats: Number of rounds; every method runs once in each round.
        save: JSON file for all figures, with commit and machine.
    """
    expect_counts(repeats=repeats)
    made = _made(methods)
    if "barsight" in methods:
        for name, settings in {
            "barsight, no guesses": BarsightSettings(fill_occlusions=False),
            "barsight fast": BarsightSettings(preset="fast"),
            "barsight fast, no guesses": BarsightSettings(preset="fast", fill_occlusions=False),
        }.items():
            made[name] = make_method(StereoSettings(barsight=settings))
    in_chain = () if recording is None else time_chain(recording, repeats)
    bench = bench_speed(made, repeats)
    bench = replace(bench, methods=(*bench.methods, *in_chain))
    SafeConsole().print(speed_table(bench))
    if save is not None:
        write_json(save, bench)


def _stereo_steps(out: Annotated[Path, tyro.conf.arg(aliases=("-o",))]) -> None:
    """Draw the effect of each step of Barsight's stereo method on a rendered bar.

    Args:
        out: PNG to write.
    """
    write_steps(out)


def _ablation(data: tyro.conf.Positional[Path], scenes: int = 2, save: Json = None) -> None:
    """Measure Barsight's stereo method with one part left out at a time: accuracy, bias and sigma.

    Args:
        data: A folder of scenes, each with left.png, right.png, disp.pfm and optionally nonocc.png.
        scenes: Number of rendered scenes of each kind.
        save: JSON file for all figures of the folder of scenes, with commit and machine.
    """
    expect_counts(scenes=scenes)
    variants = without_one_part()
    bench = bench_stereo(data, variants, repeats=1)
    console = SafeConsole()
    console.print(stereo_table(bench))
    console.print(subpixel_table(bench_subpixel(variants, None, scenes)))
    if save is not None:
        write_json(save, bench)


def _subpixel(
    data: Path | None = None, methods: tuple[MethodName, ...] = METHODS, scenes: int = 6, save: Json = None
) -> None:
    """Measure the bias as a function of the true disparity's fraction (pixel locking), and check sigma.

    Args:
        data: Middlebury folder; its motorcycle scene is used too, beside the rendered plane and bar.
        methods: The methods to compare.
        scenes: Number of rendered scenes of each kind.
        save: JSON file for all figures, with commit and machine.
    """
    expect_counts(scenes=scenes)
    bench = bench_subpixel(_made(methods), data, scenes)
    SafeConsole().print(subpixel_table(bench))
    if save is not None:
        write_json(save, bench)


def _target_size(methods: tuple[MethodName, ...] = METHODS, poses: int = 10, save: Json = None) -> None:
    """Reproduce the paper's Table 1: a bar of 90 mm measured from 1.8 to 8.5 m.

    Args:
        methods: The methods to compare.
        poses: Number of poses at each range.
        save: JSON file for all figures, with commit and machine.
    """
    expect_counts(poses=poses)
    bench = bench_target_size(_made(methods), poses)
    SafeConsole().print(target_size_table(bench))
    if save is not None:
        write_json(save, bench)


def _made(names: tuple[MethodName, ...]) -> dict[str, StereoMethod]:
    return {name: make_method(StereoSettings(method=name)) for name in names}
