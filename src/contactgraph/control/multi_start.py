"""iLQR from several starts side by side, of which the cheapest plan is taken."""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from contactgraph.control.box_qp import AffinePolicy, ControlLimits
from contactgraph.control.cost import Cost
from contactgraph.control.ilqr import ILQR, PlannedCost, PlanningProblem, Progress
from contactgraph.control.lanes import in_lanes
from contactgraph.control.lqr import Improvement, improve_policy
from contactgraph.control.plan import Plan
from contactgraph.control.riccati import block_operator
from contactgraph.control.rollout import Rollout
from contactgraph.data.errors import InvalidInputError
from contactgraph.model import ModelState, Nodes, StepModel

_TRIED = 2
"""Rollouts of each start, after which the best one of a proposal is known well enough."""
_LANES = 8
"""Of a vector; of more starts than these the best after their first rollouts go on."""


class Starts(NamedTuple):
    """Policies from which iLQR may begin, the proposal of one function."""

    policies: AffinePolicy
    """K [H, U, N, 2, G, S] and k [H, U, S]."""
    leap: bool = False
    """Whether the first trial is accepted whatever it costs: it may leave a local minimum, such as
    to hover before a touch that costs first and pays later."""
    improved: bool = True
    """Whether iLQR improves plans from here, the running one among them; otherwise each is taken as
    it is rolled out."""


Proposal = Callable[[PlanningProblem], Starts]
"""Is compiled; a pytree such as an `equinox.Module`, or a function."""


class Leap(eqx.Module):
    """The guess, whose first improvement is accepted whatever it costs (`Starts.leap`).

    A grasp may cost first and pay later: the body is pushed away from the next one before both are
    taken there. A search that only descends may hover before it, the sooner the longer the plan.
    """

    def __call__(self, problem: PlanningProblem) -> Starts:
        """One start."""
        return Starts(jax.tree.map(lambda leaf: leaf[..., None], problem.guess), leap=True)


class MultiStartILQR(ILQR):
    """`ILQR` from the guess and from what ``proposals`` propose; the plan of the lowest cost.

    Where a proposal has several starts, each of them makes two rollouts, of more than eight in all
    one, before the best make the second, and the best start goes on. The guess and one start of
    each proposal are then planned in full, side by side. The guess is always among them, so the
    plan's cost is never above the guess's.

    Components of the control whose effect A and B do not tell, a gripper's command or a switch, are
    ``held``: they stay as a start has them, and only starts differ in them.

    >>> from contactgraph.control import Routes
    >>> MultiStartILQR(horizon=20, proposals=(Routes(7),)).proposals
    (Routes(count=7),)
    """

    proposals: tuple[Proposal, ...] = ()
    held: tuple[int, ...] = eqx.field(static=True, default=())
    """Components of the control."""
    switching_cost: float = eqx.field(static=True, default=0.0)
    """Added each time that a plan changes a held component, first against the running plan."""

    def __check_init__(self) -> None:
        size = None if self.limits is None else len(self.limits.lower)
        if self.held and (size is None or not 0 <= min(self.held) <= max(self.held) < size):
            raise InvalidInputError(
                f"limits must have an entry for each of the held components {self.held}, found "
                f"{self.limits}"
            )

    def solve(
        self,
        model: StepModel,
        state: ModelState,
        nodes: Nodes,
        cost: Cost,
        guess: AffinePolicy | None = None,
    ) -> Plan:
        """The plan of the lowest cost; see `ILQR.solve`. ``iterations`` counts all rollouts.

        Raises `InvalidInputError` where a proposal does not know the model.
        """
        problem = self.prepared(model, state, nodes, cost, guess)
        held, guess = np.array(self.held, int), problem.guess
        # A shifted plan ends without control, which would let go of what it holds.
        kept = guess.k[max(-2, -self.horizon), held]
        guess = AffinePolicy(guess.K.at[:, held].set(0.0), guess.k.at[-1, held].set(kept))
        problem = dataclasses.replace(problem, guess=guess)
        proposed = [each(problem) for each in self.proposals]
        iterations = self.iterations if all(each.improved for each in proposed) else 1

        def searched(progress: Progress, rollouts: int) -> Progress:
            search = partial(self.search, problem, iterations=rollouts)
            return in_lanes(search, progress.cost.size)(progress)

        running = Starts(jax.tree.map(lambda leaf: leaf[..., None], guess))
        progress, counts = _side_by_side([running, *proposed], partial(self.begun, problem))
        tried = jnp.zeros((), jnp.int32)
        if max(counts) > 1:
            rounds = [(1, _LANES)] if sum(counts[1:]) > _LANES else []
            for rollouts, most in (*rounds, (min(_TRIED, iterations), 1)):
                progress = searched(progress, rollouts)
                tried += jnp.sum(progress.iteration)
                progress, counts = _best(progress, counts, most)
                tried -= jnp.sum(progress.iteration)
        progress = searched(progress, iterations)
        plans = in_lanes(partial(self.plan_of, problem), sum(counts))(progress)
        plans = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), plans)
        costs = plans.cost + self.switching(guess, plans.controls)
        best = jnp.argmin(jnp.where(jnp.isfinite(costs), costs, jnp.inf))
        plan = jax.tree.map(lambda leaf: leaf[best], plans)
        return dataclasses.replace(plan, iterations=tried + jnp.sum(plans.iterations))

    def switching(
        self, running: AffinePolicy, controls: Float[Array, "*S H U"]
    ) -> Float[Array, "*S"]:
        """The cost of changes of held components in plans that follow a running one."""
        held = np.array(self.held, int)
        values = controls[..., held]
        before = jnp.broadcast_to(running.k[0, held], values[..., :1, :].shape)
        changes = jnp.diff(values, axis=-2, prepend=before)
        return self.switching_cost * jnp.sum(changes != 0.0, axis=(-2, -1))

    def improved(
        self, reference: Rollout, about: PlannedCost, damping: Float[Array, ""]
    ) -> Improvement:
        """As `ILQR`'s, about the other components; the held ones stay as they are."""
        if not self.held:
            return super().improved(reference, about, damping)
        assert self.limits is not None
        whole, size = reference.problem(*about), reference.controls.shape[-1]
        held = np.array(self.held, int)
        free = np.setdiff1d(np.arange(size), held)
        given = reference.controls[:, held]
        problem = dataclasses.replace(
            whole,
            B=whole.B[..., free],
            offset=whole.offset + jnp.sum(whole.B[..., held] * given[:, None], axis=-1),
            R=whole.R[:, free[:, None], free],
            r=jnp.sum(whole.R[:, free[:, None], held] * given[:, None], axis=-1),
        )
        found = improve_policy(
            problem,
            reference.x[:-1],
            reference.controls[:, free],
            damping,
            ControlLimits(self.limits.lower[free], self.limits.upper[free]),
            block_operator,
        )

        def among_all(values: Array) -> Array:
            shape = values.shape[0], size, *values.shape[2:]
            return jnp.zeros(shape, values.dtype).at[:, free].set(values)

        policy = AffinePolicy(among_all(found.policy.K), among_all(found.policy.k))
        return Improvement(policy, among_all(found.step), found.expected_decrease)


def _side_by_side(
    proposed: Sequence[Starts], begun: Callable[[AffinePolicy, Array], Progress]
) -> tuple[Progress, list[int]]:
    """All starts along the last axis, and how many there are of each proposal."""
    counts = [each.policies.k.shape[-1] for each in proposed]
    dtype = proposed[0].policies.k.dtype
    policies = jax.tree.map(
        lambda *leaves: jnp.concatenate([leaf.astype(dtype) for leaf in leaves], axis=-1),
        *[each.policies for each in proposed],
    )
    leaps = jnp.array(np.repeat([each.leap for each in proposed], counts))
    return in_lanes(begun, sum(counts))(policies, leaps), counts


def _best(progress: Progress, counts: Sequence[int], most: int) -> tuple[Progress, list[int]]:
    """The ``most`` cheapest starts of each proposal, fewer where the others need their lanes."""
    cost = jnp.where(jnp.isfinite(progress.cost), progress.cost, jnp.inf)
    single = sum(count == 1 for count in counts)
    several = len(counts) - single
    most = max(1, min(most, (_LANES - single) // several))
    kept = [min(each, most) for each in counts]
    first = np.cumsum([0, *counts])
    lanes = [
        begin + jnp.argsort(cost[begin:end])[:count]
        for begin, end, count in zip(first[:-1], first[1:], kept, strict=True)
    ]
    return jax.tree.map(lambda leaf: leaf[..., jnp.concatenate(lanes)], progress), kept
