"""Answer the handshake of a lift: Claim, Executing, Executed and Failed, and where the magnet touches
something, for operators and above.
"""

from __future__ import annotations

import math
from typing import Any

from barsight.core.errors import Failed
from barsight.plant.opcua.calls import MAX_TEXT
from barsight.plant.opcua.security.access import caller, has_role
from barsight.plant.opcua.security.binding import Node, Server, ua
from barsight.plant.opcua.surveys import PlantSource

STEPS: dict[str, dict[str, ua.VariantType]] = {
    "claim": {"lift": ua.VariantType.String},
    "executing": {"token": ua.VariantType.String},
    "executed": {
        "token": ua.VariantType.String, "mass_kg": ua.VariantType.Double,
        "slack_rope": ua.VariantType.Boolean, "position_reached": ua.VariantType.Boolean,
    },
    "failed": {"token": ua.VariantType.String, "reason": ua.VariantType.String},
    "touched": {
        "kind": ua.VariantType.String, "x_m": ua.VariantType.Double, "y_m": ua.VariantType.Double,
        "z_m": ua.VariantType.Double,
    },
}  # fmt: skip
"""Steps of the handshake with their arguments and types. A crane need not call `touched`."""
_KINDS = {
    ua.VariantType.String: str, ua.VariantType.Double: float, ua.VariantType.Boolean: bool,
}  # fmt: skip


class LiftMethods:
    """The object `Handshake`: each method returns the token, whether the step was taken, and if not, why;
    `touched`, which needs no lift, returns no token.
    """

    def __init__(self, server: Server, source: PlantSource) -> None:
        self._server = server
        self._source = source

    async def add(self, parent: Node, index: int) -> None:
        """Add the object and its methods."""
        node = await parent.add_object(ua.NodeId("Handshake", index), ua.QualifiedName("Handshake", index))
        outputs = [
            _argument("token", ua.VariantType.String), _argument("is_taken", ua.VariantType.Boolean),
            _argument("reason", ua.VariantType.String),
        ]  # fmt: skip
        for step, arguments in STEPS.items():
            await node.add_method(
                ua.NodeId(f"Handshake.{step}", index), ua.QualifiedName(step, index), self._taker(step),
                [_argument(name, kind) for name, kind in arguments.items()], outputs[step == "touched" :],
            )  # fmt: skip

    def _taker(self, step: str) -> Any:
        async def take(parent: ua.NodeId, *given: ua.Variant) -> Any:
            if not has_role("operator"):
                return ua.StatusCode(ua.StatusCodes.BadUserAccessDenied)
            declared = STEPS[step]
            if len(given) != len(declared):
                too_few = len(given) < len(declared)
                wrong = ua.StatusCodes.BadArgumentsMissing if too_few else ua.StatusCodes.BadTooManyArguments
                return ua.StatusCode(wrong)
            arguments = dict(zip(declared, (one.Value for one in given), strict=True))
            if not all(_fits(arguments[name], kind) for name, kind in declared.items()):
                return ua.StatusCode(ua.StatusCodes.BadInvalidArgument)
            answer = await self._source.handshake(step, str(caller().name), arguments)
            if answer is None:
                return ua.StatusCode(ua.StatusCodes.BadNoCommunication)
            is_taken = not isinstance(answer, Failed)
            told = [
                ua.Variant(answer if is_taken else "", ua.VariantType.String), ua.Variant(is_taken),
                ua.Variant("" if is_taken else str(answer), ua.VariantType.String),
            ]  # fmt: skip
            return told[step == "touched" :]

        return take


def _argument(name: str, kind: ua.VariantType) -> ua.Argument:
    return ua.Argument(Name=name, DataType=ua.NodeId(kind.value), ValueRank=-1)


def _fits(value: Any, kind: ua.VariantType) -> bool:
    if not isinstance(value, _KINDS[kind]):
        return False
    if isinstance(value, float):
        return math.isfinite(value)
    return not isinstance(value, str) or len(value) <= MAX_TEXT
