"""iLQR from several first guesses side by side, of which the cheapest plan is taken."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from contactgraph.control.box_qp import AffinePolicy
from contactgraph.control.cost import QuadraticCost
from contactgraph.control.ilqr import ILQR
from contactgraph.control.lanes import in_lanes
from contactgraph.control.plan import Plan
from contactgraph.model import ModelState, Nodes, StepModel


def all_plans(
    planner: ILQR,
    model: StepModel,
    state: ModelState,
    nodes: Nodes,
    cost: QuadraticCost,
    guesses: AffinePolicy,
) -> Plan:
    """Those that `ILQR.solve` makes from each of ``S`` guesses, along the first axis.

    ``guesses`` have them along the last.
    """

    def planned(guess: AffinePolicy) -> Plan:
        return ILQR.solve(planner, model, state, nodes, cost, guess)

    plans = in_lanes(planned, guesses.k.shape[-1])(guesses)
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), plans)


def best_plan(
    plans: Plan, added: Callable[[Plan], Float[Array, " S"]] = lambda plans: jnp.zeros(())
) -> Plan:
    """The one of the lowest cost of several along the first axis.

    ``added``: further costs of each. ``iterations`` and the swept bounds are those of all.
    """
    costs = plans.cost + added(plans)
    chosen = jnp.argmin(jnp.where(jnp.isfinite(costs), costs, jnp.inf))
    plan = jax.tree.map(lambda leaf: leaf[chosen], plans)
    swept = None if plans.swept is None else plans.swept.united()
    return dataclasses.replace(plan, iterations=jnp.sum(plans.iterations), swept=swept)


def side_by_side(guess: AffinePolicy, others: AffinePolicy) -> AffinePolicy:
    """A guess before others, which have a last axis [S] already."""
    return jax.tree.map(
        lambda one, rest: jnp.concatenate([one[..., None], rest.astype(one.dtype)], axis=-1),
        guess,
        others,
    )
