"""Run `barsight budget OUT [-o budget.json]`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.box import SIMPLE_HEAD
from rich.table import Table

from barsight.acceptance.budgets.budget import BudgetedFigure, budget
from barsight.acceptance.budgets.error_sources import MeasuredLoad, measured_load
from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError
from barsight.core.files import expect_output
from barsight.core.json_values import DIGITS, write_json
from barsight.yard.magnet.description import load_magnet


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, compute the budget and print it."""

    def command(
        measured: tyro.conf.Positional[Path],
        out: Annotated[Path | None, tyro.conf.arg(aliases=("-o",))] = None,
        bundle: int | None = None,
        certificate: Path | None = None,
        magnet: Path | None = None,
        temperature_k: float = 10.0,
    ) -> None:
        """Budget the uncertainty of a bundle's lift x, y, z, yaw, height, width and mass by GUM.

        Each part states its source, distribution, degrees of freedom and origin. The total is verified by
        sampling (JCGM 101). Unmeasured contributions are named, not guessed.

        Args:
            measured: A folder of results from barsight measure; its recording must still exist.
            out: JSON file to write all parts to.
            bundle: Id of the bundle; by default the most certain one with both ends visible.
            certificate: Certificate from barsight accept, whose touch-downs show how the magnet hangs.
            magnet: TOML file of the magnet. Its offset from touch-downs counts with its own sigma and
                replaces the certificate's touch-downs.
            temperature_k: Maximum temperature difference of the rig from its calibration, in kelvins.
        """
        if not 0 <= temperature_k <= 100:
            raise ConfigError(f"budget: --temperature-k must lie in 0...100, not {temperature_k:g}")
        if out is not None:
            expect_output(out, ".json")
        offset = None if magnet is None else load_magnet(magnet).offset
        found = measured_load(measured, bundle, certificate, temperature_k, offset)
        figures = budget(found.load, found.view, found.origin_m, found.sources, targets_m=found.targets_m)
        if out is not None:
            _write(found, figures, out)
        _print(found, figures)

    call(command, "budget", arguments)


def _write(found: MeasuredLoad, figures: Sequence[BudgetedFigure], out: Path) -> None:
    content = {
        "bundle": found.bundle,
        "figures": list(figures),
        "assumed": list(found.assumed),
    }
    write_json(out, content, DIGITS)


def _print(found: MeasuredLoad, figures: Sequence[BudgetedFigure]) -> None:
    table = Table(box=SIMPLE_HEAD, title=f"Bundle {found.bundle}: standard uncertainties, and U (k x sigma)")
    for head in ("figure", "part", "sigma", "", "distribution", "dof", "measured by"):
        table.add_column(head, overflow="fold")
    for one in figures:
        for part in one.parts:
            free = f"{part.degrees_of_freedom:.0f}"
            sigma = f"{part.sigma:.3g}"
            table.add_row(one.name, part.source, sigma, one.unit, part.distribution, free, part.measured_by)
        whole = one.combined
        total = f"{whole.expanded:.3g}" if whole.expanded == whole.expanded else "not known"
        check = "sampling agrees" if one.agree else f"by sampling {one.sampled_expanded:.3g}"
        table.add_row(
            f"[bold]{one.name}[/bold]", f"[bold]U, k = {whole.coverage:.2f}[/bold]", f"[bold]{total}[/bold]",
            one.unit, "", f"{whole.degrees_of_freedom:.0f}", check, end_section=True,
        )  # fmt: skip
    console = SafeConsole()
    console.print(table)
    for line in found.assumed:
        console.print(f"assumed: {line}", highlight=False, markup=False)
