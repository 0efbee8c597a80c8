"""Run `barsight plan --range 8 --width 12`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from rich.box import SIMPLE_HEAD
from rich.table import Table

from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.sensors.rig_plan import CAMERAS, Wish, plan_rig


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, plan the rig and print it."""

    def command(
        range: float,
        width: float,
        stack: float = 2.0,
        bar_diameter: float = 0.09,
        sigma: float = 0.01,
        speed: float = 0.5,
        camera: Literal["1.3MP", "1.6MP", "5MP", "12MP"] = "1.3MP",
    ) -> None:
        """Plan a rig: lens, baseline, exposure, rate and data with their calculations, and a parts list.

        All values are in metres and seconds. The baseline is along the travel, the picture's short side
        along the bars. The exit code is 5 if no rig meets the demands; the message says what would help.

        Args:
            range: Distance from the cameras to the floor.
            width: Width of the yard along the bars; it is covered in as many lanes as needed.
            stack: Height of the highest pile.
            bar_diameter: Diameter of the thinnest bar that must be resolved.
            sigma: Required sigma of a single depth on the floor.
            speed: Speed of the crane while it measures.
            camera: Class of camera, by its size in megapixels.
        """
        wish = Wish(range, width, stack, bar_diameter, sigma, speed)
        plan, console = plan_rig(wish, CAMERAS[camera]), SafeConsole()
        figures = Table(title="Figures", box=SIMPLE_HEAD)
        for head in ("figure", "value", "formula"):
            figures.add_column(head)
        for row in plan.figures():
            figures.add_row(*row)
        parts = Table(title="Parts", box=SIMPLE_HEAD)
        for head in ("part", "requirements"):
            parts.add_column(head)
        for part in plan.parts():
            parts.add_row(*part)
        console.print(figures)
        console.print(parts)

    call(command, "plan", arguments)
