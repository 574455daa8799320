"""A start over a whole task, which short plans made one after the other."""

import dataclasses

import equinox as eqx
import jax

from contactgraph.control.box_qp import AffinePolicy
from contactgraph.control.ilqr import ILQR, PlanningProblem
from contactgraph.control.multi_start import Starts
from contactgraph.control.plan import shift_plan
from contactgraph.data.errors import InvalidInputError
from contactgraph.model import ModelState


class ShortPlans(eqx.Module):
    """A closed loop of short plans in the model, as `MPC` controls a task.

    Over many steps iLQR finds no contact that its guess does not make, and a guess without force
    makes none. So all steps of the horizon are first controlled in the model itself: by plans
    ``segment`` steps ahead, each followed for ``stride`` steps.
    """

    segment: int = eqx.field(static=True, default=20)
    """Steps of a short plan."""
    stride: int | None = eqx.field(static=True, default=None)
    """Steps for which each is followed, a divisor of the horizon; None: the largest up to 5."""

    def __call__(self, problem: PlanningProblem) -> Starts:
        """One start; its ``iterations`` leave out the short plans'.

        Raises `InvalidInputError` where segment, stride and horizon do not fit.
        """
        planner = problem.planner
        horizon, stride = planner.horizon, self.stride
        if stride is None:
            divisors = (each for each in range(min(5, self.segment), 0, -1) if horizon % each == 0)
            stride = next(divisors, 1)
        if not 1 <= stride <= self.segment <= horizon or horizon % stride:
            raise InvalidInputError(
                "stride must be 1 to segment, segment at most the horizon, and the horizon a "
                f"multiple of the stride, found {stride}, {self.segment} and {horizon}"
            )
        short = dataclasses.replace(planner, horizon=self.segment, proposals=())

        def follow(
            carry: tuple[ModelState, AffinePolicy], _: None
        ) -> tuple[tuple[ModelState, AffinePolicy], AffinePolicy]:
            now, running = carry
            plan = ILQR.solve(short, problem.model, now, problem.nodes, problem.cost, running)
            made = jax.tree.map(lambda leaf: leaf[:stride], plan.policy)
            at = plan.states[stride].astype(now.position.dtype)
            belief = jax.tree.map(lambda leaf: leaf[stride - 1], plan.beliefs)
            for _step in range(stride):
                plan = shift_plan(plan)
            return (ModelState(at[:, 0], at[:, 1], belief), plan.policy), made

        running = jax.tree.map(lambda leaf: leaf[: self.segment], problem.guess)
        _, made = jax.lax.scan(follow, (problem.state, running), None, length=horizon // stride)
        return Starts(jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:], 1), made))
