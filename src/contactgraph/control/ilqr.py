"""Iterative LQR with a model that gives its own linearisation."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from contactgraph.control.box_qp import AffinePolicy, ControlLimits
from contactgraph.control.contact_cost import ContactCost
from contactgraph.control.cost import Cost, QuadraticCost
from contactgraph.control.lqr import (
    Improvement,
    block_cost,
    block_gains,
    improve_policy,
    node_gains,
)
from contactgraph.control.plan import Plan, PlanStatus
from contactgraph.control.riccati import block_operator
from contactgraph.control.rollout import Rollout, roll_out
from contactgraph.data.errors import InvalidInputError
from contactgraph.model import ModelState, Nodes, StepModel

PlannedCost = tuple[QuadraticCost, Int[Array, " M"], tuple[ContactCost, ...]]
"""The quadratic part of a cost, on the M nodes that have one; these nodes; and its contacts."""

_RUNNING = -1
_ARMIJO = 1e-4
_FIRST_DAMPING = 0.1
_DAMPING_FACTOR = 10.0
_LAST_DAMPING = 1e6
_SURELY = 1.001
"""Costs that differ by less may compare differently when summed in another order."""


class ILQR(eqx.Module):
    """Plans ``horizon`` steps with a model whose step is linear given the state.

    One iteration rolls the model out once under a trial policy. That rollout is the true cost of
    the trial and the linearisation for the next one, so no other pass through the model is made.
    A trial is accepted only if it lowers the cost: the plan's cost never rises, and the first
    guess, where it is finite, is an upper bound. Otherwise a smaller step is tried, and after the
    smallest the damping grows (see `improve_policy`).

    With contacts that switch hard the model's A and B belong to the states rolled out, not to
    those planned; that is why nothing but a rollout decides.

    Raises `InvalidInputError` where the horizon or the iterations are less than 1.

    >>> largest = jnp.array([10.0, 10.0])  # N
    >>> ILQR(horizon=20, limits=ControlLimits(-largest, largest))
    ILQR(horizon=20, limits=ControlLimits(lower=f32[2], upper=f32[2]))
    """

    horizon: int = eqx.field(static=True)
    """H, steps."""
    iterations: int = eqx.field(static=True, default=10)
    """Most rollouts of the model in one solve, including rejected ones; this bounds the time."""
    limits: ControlLimits | None = None
    """Bounds on every control, N. None: unbounded."""
    tolerance: float = eqx.field(static=True, default=1e-4)
    """Converged when the expected decrease is below this part of the cost, …"""
    absolute_tolerance: float = eqx.field(static=True, default=1e-6)
    """… plus this, in the cost's own unit."""
    step_sizes: tuple[float, ...] = eqx.field(static=True, default=(1.0, 0.5, 0.2))
    """Parts of the full step, tried in this order."""

    def __check_init__(self) -> None:
        for name, value in (("horizon", self.horizon), ("iterations", self.iterations)):
            if not isinstance(value, int) or isinstance(value, bool) or value < 1:
                raise InvalidInputError(
                    f"{name} must be a whole number of at least 1, found {value!r}"
                )

    def solve(
        self,
        model: StepModel,
        state: ModelState,
        nodes: Nodes,
        cost: Cost,
        guess: AffinePolicy | None = None,
    ) -> Plan:
        """The best plan from a state, starting from a guessed policy (None: no force).

        Not compiled by itself: call it inside `jax.jit`, or use `MPC`. The status is CONVERGED,
        ITERATION_LIMIT, NO_DESCENT or NOT_FINITE; with NOT_FINITE neither the guess nor zero
        control could be rolled out, and the controls are zero (or the nearest within limits).
        """
        problem = self.prepared(model, state, nodes, cost, guess)
        begun = self.begun(problem, problem.guess)
        return self.plan_of(problem, self.search(problem, begun, self.iterations))

    def begun(
        self, problem: "PlanningProblem", guess: AffinePolicy, leap: bool | Bool[Array, ""] = False
    ) -> "Progress":
        """A search before its first rollout, from a guess.

        ``leap``: whether its first trial is accepted whatever it costs.
        """
        ids, state = problem.node_ids, problem.state
        trial = AffinePolicy(block_gains(guess.K, ids), guess.k)
        follow = eqx.filter_jit(roll_out)  # as in `search`, so that both are traced once
        shape = eqx.filter_eval_shape(
            follow, problem.model, state, problem.nodes, trial, self.limits, ids
        )
        zero, none = jnp.zeros((), problem.cost.R.dtype), jnp.zeros((), jnp.int32)
        return Progress(
            reference=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape),
            cost=zero + jnp.inf,
            improvement=Improvement(trial, trial.k, zero),
            trial=trial,
            damping=zero,
            attempt=none,
            iteration=none,
            status=none + _RUNNING,
            leap=jnp.asarray(leap),
        )

    def search(self, problem: "PlanningProblem", begin: "Progress", iterations: int) -> "Progress":
        """What ``iterations`` rollouts in all find, of which a search may have made some."""
        model, state, nodes, ids = problem.model, problem.state, problem.nodes, problem.node_ids
        contacts = problem.cost.contacts
        part = block_cost(problem.cost, ids, state.position.shape[1], self.horizon)
        follow = eqx.filter_jit(roll_out)

        def advance(search: Progress) -> Progress:
            rollout = follow(model, state, nodes, search.trial, self.limits, ids)
            total = jnp.sum(part.by_step(rollout.x, rollout.controls))
            for each in contacts:
                total += jnp.sum(each.by_step(rollout.states, rollout.beliefs))
            return self._judge(search, rollout, total, (part, ids, contacts))

        def running(search: Progress) -> Bool[Array, ""]:
            return (search.status == _RUNNING) & (search.iteration < iterations)

        return jax.lax.while_loop(running, advance, begin)

    def _judge(
        self, search: "Progress", rollout: Rollout, total: Float[Array, ""], about: PlannedCost
    ) -> "Progress":
        """Accept or reject the trial's rollout of this cost, and choose the next trial."""
        total = jnp.where(rollout.finite(), total, jnp.inf)
        sizes = jnp.asarray(self.step_sizes, total.dtype)
        promised = _ARMIJO * sizes[search.attempt] * search.improvement.expected_decrease
        promised = jnp.maximum(promised, 0.0)
        most = search.cost - jnp.where(jnp.isfinite(search.cost), promised, 0.0)
        leaps = search.leap & (search.iteration == 1)
        accepted = total < jnp.where(leaps, jnp.inf, most)
        reference = jax.tree.map(
            lambda new, old: jnp.where(accepted, new, old), rollout, search.reference
        )
        lowest = jnp.where(accepted, total, search.cost)

        attempt = jnp.where(accepted, 0, search.attempt + 1)
        exhausted = attempt == len(self.step_sizes)
        attempt = jnp.where(exhausted, 0, attempt)
        damping = _adapted(search.damping, accepted, exhausted)

        improvement = self.improved(reference, about, damping)
        enough = self.tolerance * jnp.abs(lowest) + self.absolute_tolerance
        # A damped step always predicts a small decrease, so only an undamped one can converge.
        # A decrease below 0 is that of a problem without a minimum.
        converged = (damping == 0) & (jnp.abs(improvement.expected_decrease) <= enough)
        nothing_rolls = ~jnp.isfinite(lowest)
        status = jnp.where(damping > _LAST_DAMPING, PlanStatus.NO_DESCENT, _RUNNING)
        status = jnp.where(converged, PlanStatus.CONVERGED, status)
        status = jnp.where(
            nothing_rolls,
            jnp.where(search.iteration > 0, PlanStatus.NOT_FINITE, _RUNNING),
            status,
        )
        trial = _trial_policy(reference, improvement, sizes[attempt])
        # If the guess could not be rolled out, zero control is the second and last.
        trial = jax.tree.map(lambda value: jnp.where(nothing_rolls, 0.0, value), trial)
        return Progress(
            reference=reference,
            cost=lowest,
            improvement=improvement,
            trial=trial,
            damping=jnp.where(nothing_rolls, 0.0, damping),
            attempt=jnp.where(nothing_rolls, 0, attempt),
            iteration=search.iteration + 1,
            status=status.astype(jnp.int32),
            leap=search.leap,
        )

    def improved(
        self, reference: Rollout, about: PlannedCost, damping: Float[Array, ""]
    ) -> Improvement:
        """A better policy around a rollout, by its linearisation."""
        problem = reference.problem(*about)
        return improve_policy(
            problem, reference.x[:-1], reference.controls, damping, self.limits, block_operator
        )

    def plan_of(self, problem: "PlanningProblem", search: "Progress") -> Plan:
        """The best plan of a search."""
        reference = search.reference
        known = jnp.isfinite(search.cost)
        gains = search.improvement.policy.K
        gains = jnp.where(known & jnp.all(jnp.isfinite(gains)), gains, 0.0)
        controls = jnp.where(known, reference.controls, self._idle(gains.shape[1], gains.dtype))
        policy = AffinePolicy.around(gains, reference.x[:-1], controls)
        K = node_gains(gains, problem.node_ids, reference.position[0])
        out_of_time = search.status == _RUNNING
        return Plan(
            states=reference.states,
            controls=controls,
            policy=AffinePolicy(K, policy.k),
            beliefs=reference.beliefs,
            cost=search.cost,
            status=jnp.where(out_of_time, PlanStatus.ITERATION_LIMIT, search.status),
            iterations=search.iteration,
            node_ids=jnp.arange(reference.position.shape[1], dtype=jnp.int32),
        )

    def prepared(
        self,
        model: StepModel,
        state: ModelState,
        nodes: Nodes,
        cost: Cost,
        guess: AffinePolicy | None,
    ) -> "PlanningProblem":
        """With the cost in the model's coordinates, and no force where there is no guess.

        Raises `InvalidInputError` where shapes do not fit.
        """
        count, dimension = state.position.shape
        quadratic = cost.quadratic(count).fitted(model, count)
        size = quadratic.control_size
        if self.limits is not None and self.limits.lower.shape != (size,):
            raise InvalidInputError(
                f"limits must be of {size} controls, found {self.limits.lower.size}"
            )
        if guess is None:
            idle = self._idle(quadratic.control_size, quadratic.R.dtype)
            guess = AffinePolicy(jnp.zeros((*idle.shape, count, 2, dimension), idle.dtype), idle)
        return PlanningProblem(self, model, state, nodes, quadratic, guess)

    def _idle(self, control_size: int, dtype: jnp.dtype) -> Float[Array, "H U"]:
        """No force, or the nearest that the limits allow."""
        zero = jnp.zeros((self.horizon, control_size), dtype)
        return zero if self.limits is None else self.limits(zero).astype(dtype)


class PlanningProblem(eqx.Module):
    """What is to be planned, and from which guess."""

    planner: Any
    """The `ILQR`; for a `contactgraph.control.Proposal` a `MultiStartILQR`."""
    model: StepModel
    state: ModelState
    nodes: Nodes
    cost: QuadraticCost
    guess: AffinePolicy
    """The running plan's, shifted."""

    @property
    def node_ids(self) -> Int[Array, " M"]:
        """The nodes with a cost."""
        ids = self.cost.cost_node_ids
        return jnp.arange(len(self.state.position)) if ids is None else ids


class Progress(eqx.Module):
    """State of the search: the best rollout so far and the next trial."""

    reference: Rollout
    cost: Float[Array, ""]
    """Of the reference; infinite as long as there is none."""
    improvement: Improvement
    """Around the reference, at the present damping."""
    trial: AffinePolicy
    damping: Float[Array, ""]
    attempt: Int[Array, ""]
    """Index of the trial's step size."""
    iteration: Int[Array, ""]
    status: Int[Array, ""]
    leap: Bool[Array, ""]
    """Whether the first trial is accepted whatever it costs."""


def _adapted(
    damping: Float[Array, ""], accepted: Bool[Array, ""], exhausted: Bool[Array, ""]
) -> Float[Array, ""]:
    """Damping falls after an accepted trial, down to 0; it grows when no step size helped."""
    lower = jnp.where(damping > _FIRST_DAMPING, damping / _DAMPING_FACTOR, 0.0)
    higher = jnp.maximum(damping * _DAMPING_FACTOR, _FIRST_DAMPING)
    return jnp.where(accepted, lower, jnp.where(exhausted, higher, damping))


def _trial_policy(
    reference: Rollout, improvement: Improvement, step_size: Float[Array, ""]
) -> AffinePolicy:
    """A part of the step, with full feedback on deviations of the states."""
    control = reference.controls + step_size * improvement.step
    return AffinePolicy.around(improvement.policy.K, reference.x[:-1], control)
