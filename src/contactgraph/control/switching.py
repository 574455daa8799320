"""iLQR with switches: components of the control that are on or off, by a search over schedules.

A switch acts on which edges hold, not on a force, so the linear dynamics have no column for it and
no derivative of the cost tells when to operate it. `SwitchingILQR` therefore compares schedules,
the values of a switch at every step of the plan: that of the previous plan, always on, always off,
and one change at some step. With its schedule given, a plan's forces are `ILQR`'s.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from contactgraph.control.box_qp import AffinePolicy, ControlLimits
from contactgraph.control.cost import Cost
from contactgraph.control.ilqr import ILQR, PlannedCost
from contactgraph.control.lqr import Improvement, improve_policy
from contactgraph.control.plan import Plan
from contactgraph.control.riccati import block_operator
from contactgraph.control.rollout import Rollout, SweptBounds
from contactgraph.data.errors import InvalidInputError
from contactgraph.model import ModelState, Nodes, StepModel


class SwitchingILQR(ILQR):
    """`ILQR` for a control of which some components are switches.

    A switch takes one of its two limits at every step. Schedules with one change are ranked by two
    rollouts each, from the guess's forces. The best of them, the guess's own schedule and the
    constant ones are then planned in full, side by side, and the plan of the lowest cost is taken:
    another schedule replaces the running one only if it costs less. Several switches are varied one
    at a time.

    **Rounding.** A guess's switch is rounded to the nearer limit before any rollout, and only
    limits are planned, because a switch has no values in between: what is rolled out, what is
    returned and what a task does are the same. The feedback of a switch is zero.

    Raises `InvalidInputError` where a switch is no component of the limits, or has no finite ones.
    """

    switches: tuple[int, ...] = eqx.field(static=True, default=())
    """Components of the control that are switches."""
    changes: int = eqx.field(static=True, default=3)
    """Steps at which a schedule may change, 1 or more, evenly spread over the horizon."""
    switching_cost: float = eqx.field(static=True, default=0.0)
    """Added to the cost of a schedule each time that it switches on: against chattering."""

    def __check_init__(self) -> None:
        if not self.switches or not 1 <= self.changes < self.horizon:
            raise InvalidInputError(
                "switches must name a component of the control at least, and changes be 1 to below "
                f"the horizon, found {self.switches} and {self.changes}"
            )
        if self.limits is None or not 0 <= min(self.switches) <= max(self.switches) < len(
            self.limits.lower
        ):
            raise InvalidInputError(
                f"limits must have an entry for each of the switches {self.switches}, found "
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
        """The plan of the lowest cost among the schedules; see `ILQR.solve`.

        ``iterations`` counts the rollouts of all schedules.
        """
        quadratic, guess = self.prepared(model, state, cost, guess)
        running = self.rounded(guess.k[:, self._index])
        guess = dataclasses.replace(guess, K=guess.K.at[:, self._index].set(0.0))

        def begun(schedule: Float[Array, "H S"]) -> AffinePolicy:
            return dataclasses.replace(guess, k=guess.k.at[:, self._index].set(schedule))

        def planned(begin: AffinePolicy, iterations: int, leaps: Bool[Array, ""]) -> Plan:
            planner = dataclasses.replace(self, iterations=iterations, leaps=leaps)
            return ILQR.solve(planner, model, state, nodes, quadratic, begin)

        constant, changing = self.schedules(running)
        stays = jnp.zeros((), bool)
        trials = jax.vmap(lambda each: planned(begun(each), min(2, self.iterations), stays))(
            changing
        )
        best = jax.tree.map(lambda leaf: leaf[self._lowest(trials, running)][None], trials.policy)
        finalists = jax.tree.map(
            lambda one, other: jnp.concatenate([one, other]), jax.vmap(begun)(constant), best
        )
        finalist = jnp.arange(len(constant) + 1)
        leaps = (finalist > 0) & (finalist < len(constant))
        made = jax.vmap(lambda each, leaps: planned(each, self.iterations, leaps))(finalists, leaps)
        chosen = jax.tree.map(lambda leaf: leaf[self._lowest(made, running)], made)
        rollouts = jnp.sum(trials.iterations) + jnp.sum(made.iterations)
        swept = None
        if made.swept is not None and trials.swept is not None:
            swept = _union(made.swept, trials.swept)
        return dataclasses.replace(chosen, iterations=rollouts, swept=swept)

    def rounded(self, schedule: Float[Array, "H S"]) -> Float[Array, "H S"]:
        """The nearer limit of each value; the last step is as the one before.

        A shifted plan ends in zero control, which would be a change of the switch.
        """
        lower, upper = self._bounds
        nearest = jnp.where(schedule > 0.5 * (lower + upper), upper, lower)
        nearest = nearest.astype(schedule.dtype)
        return nearest.at[-1].set(nearest[-2]) if self.horizon > 1 else nearest

    def schedules(
        self, running: Float[Array, "H S"]
    ) -> tuple[Float[Array, "C H S"], Float[Array, "c H S"]]:
        """The running one and, for each switch, always on and always off; those with one change."""
        lower, upper = self._bounds
        steps = np.linspace(0, self.horizon, self.changes + 2)[1:-1].round().astype(int)

        def varied(begin: np.ndarray) -> list[Array]:
            after = np.arange(self.horizon) >= begin[:, None]
            return [
                running.at[:, each].set(
                    jnp.where(on, upper[each], lower[each]).astype(running.dtype)
                )
                for each in range(len(self.switches))
                for on in (*after, *~after)
            ]

        return jnp.stack([running, *varied(np.zeros(1, int))]), jnp.stack(varied(steps))

    def _lowest(self, plans: Plan, running: Float[Array, "H S"]) -> Int[Array, ""]:
        """The first plan [C, …] of the lowest cost; one that is not finite is never chosen."""
        lower, upper = self._bounds
        schedules = plans.controls[:, :, self._index]
        before = jnp.broadcast_to(running[0], schedules[:, :1].shape)
        changes = jnp.diff(jnp.concatenate([before, schedules], axis=1), axis=1)
        rises = jnp.sum(changes > 0.5 * (upper - lower), axis=(1, 2))
        costs = plans.cost + self.switching_cost * rises
        return jnp.argmin(jnp.where(jnp.isfinite(costs), costs, jnp.inf))

    @property
    def _index(self) -> np.ndarray:
        return np.array(self.switches)

    @property
    def _bounds(self) -> tuple[Float[Array, " S"], Float[Array, " S"]]:
        """The limits of the switches."""
        assert self.limits is not None
        return self.limits.lower[self._index], self.limits.upper[self._index]

    def _improve(
        self, reference: Rollout, about: PlannedCost, damping: Float[Array, ""]
    ) -> Improvement:
        """As `ILQR`'s, about the other components; the switches stay as they are."""
        assert self.limits is not None
        whole = reference.problem(*about)
        fixed = self._index
        size = whole.R.shape[-1]
        free = np.setdiff1d(np.arange(size), fixed)
        given = reference.controls[:, fixed]
        problem = dataclasses.replace(
            whole,
            B=whole.B[..., free],
            offset=whole.offset + jnp.sum(whole.B[..., fixed] * given[:, None], axis=-1),
            R=whole.R[:, free[:, None], free],
            r=jnp.sum(whole.R[:, free[:, None], fixed] * given[:, None], axis=-1),
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


def _union(made: SweptBounds, trials: SweptBounds) -> SweptBounds:
    """Bounds [R, H, N, D] of all plans [C, R, H, N, D]; those of the trials are in the last."""
    united = made.united()
    return SweptBounds(
        united.lower.at[-1].min(jnp.min(trials.lower, axis=(0, 1))),
        united.upper.at[-1].max(jnp.max(trials.upper, axis=(0, 1))),
    )
