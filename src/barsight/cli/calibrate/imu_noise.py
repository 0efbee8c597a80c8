"""Run `barsight calibrate imu-noise LOG -o imu.yaml`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape

from barsight.calibration.camera_imu.allan_deviation import fit_imu_noise
from barsight.calibration.files.kalibr import write_imu_file
from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import Failed, InputError
from barsight.core.files import atomic_paths, expect_output
from barsight.recording.formats.imu_log import AccelUnit, GyroUnit, TimeUnit, read_imu_log
from barsight.report.calibration.imu_noise_page import write_imu_noise_report

SHORT_S = 1800.0


def run(arguments: Sequence[str]) -> None:
    """Parse and fit."""

    def command(
        log: tyro.conf.Positional[Path],
        out: Annotated[Path, tyro.conf.arg(aliases=("-o",))],
        gyro_unit: tyro.conf.EnumChoicesFromValues[GyroUnit] = GyroUnit.AUTO,
        accel_unit: tyro.conf.EnumChoicesFromValues[AccelUnit] = AccelUnit.AUTO,
        time_unit: tyro.conf.EnumChoicesFromValues[TimeUnit] = TimeUnit.AUTO,
        topic: str = "/imu0",
    ) -> None:
        """Noise densities, random walks and bias instability of an IMU at rest, in Kalibr's imu.yaml.

        Args:
            log: Columns of time, gyroscope and accelerometer, with commas or spaces (more columns where the
                header names them); an EuRoC folder with imu0/data.csv; or a bag with one IMU.
                An hour or more, on something that doesn't shake.
            out: The file to write (.yaml); its report goes beside it (.html and .json).
            gyro_unit: The gyroscope's unit; auto takes degrees where the header says so.
            accel_unit: The accelerometer's unit; auto goes by gravity.
            time_unit: The stamps' unit, from any epoch; auto goes by the header, else by the rate.
            topic: The rostopic to state in the file.
        """
        expect_output(out, ".yaml", ".yml")
        console = SafeConsole(stderr=True)
        read = read_imu_log(log, gyro_unit, accel_unit, time_unit)
        fit = fit_imu_noise(read.samples)
        if isinstance(fit, Failed):
            raise InputError(log, fit.reason, "log an hour or more with the IMU at rest")
        html = out.with_suffix(".html")
        with atomic_paths(out, html, out.with_suffix(".json")) as (path, page, data):
            write_imu_file(path, fit.noise, topic)
            write_imu_noise_report(fit, log.name, read.notes, page, data)
        for axis in fit.axes:
            console.print(
                f"{axis.name}: density {axis.density:.3e} ± {axis.density_sigma:.0e}, walk {axis.walk:.2e} ± "
                f"{axis.walk_sigma:.0e}, instability {axis.instability:.2e} ± {axis.instability_sigma:.0e}",
                soft_wrap=True, highlight=False,
            )  # fmt: skip
        if fit.duration_s < SHORT_S:
            console.print(f"[yellow]{fit.duration_s:.0f} s are short: walks need an hour or more[/yellow]")
        names = f"{escape(str(out))}; report {escape(str(html))}"
        console.print(f"{'; '.join(read.notes)}; {names}", soft_wrap=True, highlight=False)

    call(command, "calibrate imu-noise", arguments)
