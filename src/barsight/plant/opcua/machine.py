"""Step the vision state machine of OPC 40100-1: states, transitions, and the methods that cause them.

Source: OPC 40100-1 (Machine Vision, part 1), VisionStateMachineType and VisionAutomaticModeStateMachineType.
Numbers are those of the specification's NodeSet.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from barsight.core.errors import Failed

MAIN_STATES = {"Preoperational": 1, "Halted": 2, "Error": 3, "Operational": 4}
AUTOMATIC_STATES = {"Initialized": 5, "Ready": 6, "SingleExecution": 7, "ContinuousExecution": 8}
"""State names and their StateNumbers."""
EXECUTING = ("SingleExecution", "ContinuousExecution")

_MAIN: dict[str, dict[str, str]] = {
    "Halt": {"Preoperational": "Halted", "Operational": "Halted", "Error": "Halted"},
    "Reset": {"Halted": "Preoperational", "Operational": "Preoperational", "Error": "Preoperational"},
    "SelectModeAutomatic": {"Preoperational": "Operational"},
}
_AUTOMATIC: dict[str, dict[str, str]] = {
    "PrepareRecipe": {"Initialized": "Ready"},
    "PrepareProduct": {"Initialized": "Ready"},
    "UnprepareRecipe": {"Ready": "Initialized"},
    "UnprepareProduct": {"Ready": "Initialized"},
    "StartSingleJob": {"Ready": "SingleExecution"},
    "StartContinuous": {"Ready": "ContinuousExecution"},
    "Stop": dict.fromkeys(EXECUTING, "Ready"),
    "Abort": dict.fromkeys(EXECUTING, "Ready"),
}
_AUTO: dict[str, dict[str, str]] = {
    "job done": {"SingleExecution": "Ready"},
}
_SUFFIX = {
    "PrepareRecipe": "Recipe", "PrepareProduct": "Product", "UnprepareRecipe": "Recipe",
    "UnprepareProduct": "Product", "Stop": "Stop", "Abort": "Abort", "job done": "Auto", "error": "Auto",
    "error resolved": "Auto",
}  # fmt: skip


@dataclass(frozen=True)
class VisionMode:
    """State of both state machines. automatic: substate of Operational, None in all other states."""

    main: str = "Preoperational"
    automatic: str | None = None

    @property
    def is_executing(self) -> bool:
        """Return True while a job runs."""
        return self.automatic in EXECUTING


@dataclass(frozen=True)
class Step:
    """Completed transition: the resulting mode, and the transition's name in the NodeSet."""

    mode: VisionMode
    transition: str


def step_by_method(mode: VisionMode, method: str) -> Step | Failed:
    """Apply a client's method; return Failed if the mode doesn't allow it."""
    if method in _MAIN:
        return _step_main(mode, _MAIN[method].get(mode.main), method)
    return _step_automatic(mode, _AUTOMATIC.get(method, {}), method)


def step_by_itself(mode: VisionMode, cause: str) -> Step | Failed:
    """Apply an internal cause: `job done`, `error` or `error resolved`."""
    if cause == "error":
        return _step_main(mode, "Error" if mode.main in ("Preoperational", "Operational") else None, cause)
    if cause == "error resolved":
        return _step_main(mode, "Preoperational" if mode.main == "Error" else None, cause)
    return _step_automatic(mode, _AUTO[cause], cause)


def _step_main(mode: VisionMode, target: str | None, cause: str) -> Step | Failed:
    if target is None:
        return Failed("illegal-transition", f"{cause} isn't allowed in {mode.main}")
    after = VisionMode(target, "Initialized" if target == "Operational" else None)
    return Step(after, f"{mode.main}To{target}{_SUFFIX.get(cause, '')}")


def _step_automatic(mode: VisionMode, targets: dict[str, str], cause: str) -> Step | Failed:
    target = targets.get(mode.automatic) if mode.automatic is not None else None
    if target is None:
        return Failed("illegal-transition", f"{cause} isn't allowed in {mode.automatic or mode.main}")
    return Step(replace(mode, automatic=target), f"{mode.automatic}To{target}{_SUFFIX.get(cause, '')}")
