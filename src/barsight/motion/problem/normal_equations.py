"""Solve bordered normal equations: a skyline matrix of the nodes, and a border of shared unknowns."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from barsight.core.arrays import Bool, Float64, Int64
from barsight.core.linalg import skyline
from barsight.core.linalg.dense import solve_positive
from barsight.core.linalg.skyline import Skyline
from barsight.motion.linear.chain_elimination import EliminatedNodes, back_substitute_nodes
from barsight.motion.linear.ordering import Ordering
from barsight.motion.problem.rig_drift import LOOSE


@dataclass(frozen=True, eq=False)
class System:
    """Normal equations at a state. rows: n unknowns, in the order of `layout`; gradient (n,). side: (b, n)
    with the border; corner (b, b) and corner_gradient (b,): of the border, which holds the encoders' unknowns
    if there are any, the pieces' common slide if there are any, then the rig's drift. retained: (K,) nodes of
    the band; gaps: those eliminated between them. nodes: their total number.
    """

    rows: Skyline
    gradient: Float64
    side: Float64
    corner: Float64
    corner_gradient: Float64
    layout: Ordering
    retained: Int64
    gaps: tuple[EliminatedNodes, ...]
    nodes: int
    encoder_unknowns: int

    @cached_property
    def factor(self) -> Skyline:
        """Factorise the band. Raises LinAlgError where the measurements leave it undetermined."""
        return self._factor(0.0)

    def _factor(self, damping: float) -> Skyline:
        factor = self.rows._replace(values=self.rows.values.copy())
        factor.values[factor.offset + np.arange(len(factor.offset))] *= 1 + damping
        if not skyline.factorise_skyline(factor):
            raise np.linalg.LinAlgError("the measurements leave an unknown undetermined")
        return factor

    @cached_property
    def forward(self) -> Float64:
        """Forward-substitute (n, 1 + b): the factor's inverse times gradient and side."""
        return self._forward(self.factor)

    def _forward(self, factor: Skyline) -> Float64:
        result = np.column_stack([self.gradient, self.side.T])
        skyline.solve_forward(factor, result)
        return result

    def schur(self, forward: Float64) -> tuple[Float64, Float64]:
        """Form the Schur complement (b, b) of the border and its gradient (b,)."""
        taken = forward.T @ forward
        loose = np.zeros(len(self.corner))
        loose[-2:] = 1 / np.array(LOOSE) ** 2
        return self.corner - taken[1:, 1:] + np.diag(loose), self.corner_gradient - taken[1:, 0]

    def step(
        self, free: Bool, damping: float = 0.0, fixed: Float64 | None = None
    ) -> tuple[Float64, Float64, Float64]:
        """Solve for the step (M n,) of all nodes, (2 S,) of the pieces' slides and disparities, and (b,) of
        the border, whose `free` (b,) unknowns are solved for; the others step as given by `fixed` (b,).
        """
        factor = self._factor(damping) if damping else self.factor
        forward = self._forward(factor) if damping else self.forward
        border = np.zeros(len(free)) if fixed is None else np.where(free, 0.0, fixed)
        if free.any():
            left, right = self.schur(forward)
            left = left + damping * np.diag(np.diag(left))
            right = right + left @ border
            border[free] = -solve_positive(left[np.ix_(free, free)], right[free])
        step = -(forward[:, :1] + forward[:, 1:] @ border[:, None])
        skyline.solve_back_dense(factor, step)
        by_node = step[self.layout.nodes].reshape(-1, self.layout.size)
        shared = border[: self.encoder_unknowns]
        by_node = back_substitute_nodes(by_node, shared, self.retained, self.gaps, self.nodes)
        return by_node.ravel(), step[self.layout.pieces, 0], border
