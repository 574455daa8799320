"""iLQR over a whole task, from a start that short plans made one after the other."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from contactgraph.control.box_qp import AffinePolicy
from contactgraph.control.candidates import all_plans, best_plan, side_by_side
from contactgraph.control.cost import Cost, QuadraticCost
from contactgraph.control.ilqr import ILQR
from contactgraph.control.plan import Plan, shift_plan
from contactgraph.control.rollout import SweptBounds
from contactgraph.data.errors import InvalidInputError
from contactgraph.model import ModelState, Nodes, StepModel


class RecedingILQR(ILQR):
    """`ILQR` from the guess and from a closed loop of short plans; the cheaper of both plans.

    Over many steps iLQR finds no contact that its guess does not make, and a guess without force
    makes none. So all ``horizon`` steps are first controlled in the model itself, as `MPC` controls
    a task: by plans ``segment`` steps ahead, each followed for ``stride`` steps.
    """

    segment: int = eqx.field(static=True, default=20)
    """Steps of a short plan."""
    stride: int = eqx.field(static=True, default=5)
    """Steps for which each is followed."""

    def __check_init__(self) -> None:
        if not 1 <= self.stride <= self.segment <= self.horizon or self.horizon % self.stride:
            raise InvalidInputError(
                "stride must be 1 to segment, segment at most the horizon, and the horizon a "
                f"multiple of the stride, found {self.stride}, {self.segment} and {self.horizon}"
            )

    def solve(
        self,
        model: StepModel,
        state: ModelState,
        nodes: Nodes,
        cost: Cost,
        guess: AffinePolicy | None = None,
    ) -> Plan:
        """The cheaper plan; see `ILQR.solve`. ``iterations`` leaves out the short plans'."""
        quadratic, guess = self.prepared(model, state, cost, guess)
        begin, swept = self._receding(model, state, nodes, quadratic, guess)
        guesses = side_by_side(guess, jax.tree.map(lambda leaf: leaf[..., None], begin))
        plan = best_plan(all_plans(self, model, state, nodes, quadratic, guesses))
        if plan.swept is None:
            return plan
        step = self.stride * jnp.arange(len(swept.lower))[:, None] + jnp.arange(self.segment)
        lower, upper = (jnp.moveaxis(each, 0, 1) for each in (swept.lower, swept.upper))
        both = SweptBounds(
            plan.swept.lower.at[:, step].min(lower, mode="drop"),
            plan.swept.upper.at[:, step].max(upper, mode="drop"),
        )
        return dataclasses.replace(plan, swept=both)

    def _receding(
        self,
        model: StepModel,
        state: ModelState,
        nodes: Nodes,
        cost: QuadraticCost,
        guess: AffinePolicy,
    ) -> tuple[AffinePolicy, Any]:
        """The policy of all steps, and the bounds [S, R, segment, N, D] of the short plans."""
        given = {each.name: getattr(self, each.name) for each in dataclasses.fields(ILQR)}
        short = ILQR(**{**given, "horizon": self.segment})

        def follow(carry: tuple[ModelState, AffinePolicy], _: None) -> tuple[Any, Any]:
            now, running = carry
            plan = ILQR.solve(short, model, now, nodes, cost, running)
            made = jax.tree.map(lambda leaf: leaf[: self.stride], plan.policy)
            at = plan.states[self.stride].astype(now.position.dtype)
            belief = jax.tree.map(lambda leaf: leaf[self.stride - 1], plan.beliefs)
            swept = plan.swept
            for _step in range(self.stride):
                plan = shift_plan(plan)
            return (ModelState(at[:, 0], at[:, 1], belief), plan.policy), (made, swept)

        running = jax.tree.map(lambda leaf: leaf[: self.segment], guess)
        strides = self.horizon // self.stride
        begin = ModelState(state.position, state.velocity, state.belief), running
        _, (made, swept) = jax.lax.scan(follow, begin, None, length=strides)
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), made), swept
