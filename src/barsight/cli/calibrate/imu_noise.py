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
    """Parse the arguments and fit the noise model."""

    def command(
        log: tyro.conf.Positional[Path],
        out: Annotated[Path, tyro.conf.arg(aliases=("-o",))],
        gyro_unit: tyro.conf.EnumChoicesFromValues[GyroUnit] = GyroUnit.AUTO,
        accel_unit: tyro.conf.EnumChoicesFromValues[AccelUnit] = AccelUnit.AUTO,
        time_unit: tyro.conf.EnumChoicesFromValues[TimeUnit] = TimeUnit.AUTO,
        topic: str = "/imu0",
    ) -> None:
        """Fit the noise model of an IMU at rest: noise densities, random walks and bias instability.

        The result is written as Kalibr's imu.yaml.

        Args:
            log: Columns of time, gyroscope and accelerometer, separated by commas or spaces (with more
                columns if the header names them); an EuRoC folder with imu0/data.csv; or a bag with one IMU.
                Record an hour or more, on a base that does not vibrate.
            out: The file to write (.yaml); its report goes next to it (.html and .json).
            gyro_unit: Unit of the gyroscope; auto assumes degrees if the header says so.
            accel_unit: Unit of the accelerometer; auto decides by gravity.
            time_unit: Unit of the stamps, from any epoch; auto decides by the header, or else by the rate.
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
