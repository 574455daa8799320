"""A planner of one's own in the place of iLQR: MPPI (Williams et al. 2017), which only samples.

Usage: python examples/extend_planner_mppi.py
In this folder also: contactgraph control pickup pickup --planner extend_planner_mppi:MPPI
"""

import equinox as eqx
import jax
import jax.numpy as jnp

import contactgraph
from contactgraph.control import AffinePolicy, ControlLimits, Plan, PlanStatus
from contactgraph.evaluate import control_task
from contactgraph.model.step import rollout
from contactgraph.policies import Planning, task_policy


class MPPI(eqx.Module):
    """Averages random controls, weighted by ``exp(-cost / temperature)``."""

    horizon: int = eqx.field(static=True)
    limits: ControlLimits
    samples: int = eqx.field(static=True, default=128)
    noise: float = eqx.field(static=True, default=0.15)  # of the range of each control
    temperature: float = eqx.field(static=True, default=1.0)

    def solve(self, model, state, nodes, cost, guess=None):
        """See `contactgraph.control.Planner`."""
        U, start = cost.control_size, jnp.stack([state.position, state.velocity], axis=1)
        mean = jnp.zeros((self.horizon, U)) if guess is None else guess.k

        def predicted(controls):
            after = rollout(model, state, controls, nodes)
            moved = jnp.stack([after.position, after.velocity], axis=2)
            states = jnp.concatenate([start[None], moved])
            return states, after.belief, cost(states, controls, after.belief)

        shape = (self.samples, self.horizon, U)
        spread = self.noise * (self.limits.upper - self.limits.lower)
        tried = self.limits(mean + spread * jax.random.normal(jax.random.key(0), shape))
        costs = jax.vmap(lambda controls: predicted(controls)[2])(tried)
        weights = jax.nn.softmax(-costs / self.temperature)  # [samples], sum 1
        controls = jnp.sum(weights[:, None, None] * tried, axis=0)
        states, beliefs, total = predicted(controls)
        finite = jnp.isfinite(total)
        return Plan(
            states=states,
            controls=controls,
            policy=AffinePolicy(jnp.zeros((self.horizon, U, *start.shape)), controls),
            beliefs=beliefs,
            cost=total,
            status=jnp.where(finite, PlanStatus.ITERATION_LIMIT, PlanStatus.NOT_FINITE),
            iterations=jnp.asarray(self.samples + 1, jnp.int32),
            node_ids=jnp.arange(len(start), dtype=jnp.int32),
        )


if __name__ == "__main__":
    model, task = contactgraph.load("pickup"), contactgraph.make("pickup")
    policy = task_policy(model, task, Planning(planner=MPPI, horizon=15))
    metrics = control_task(policy, task, 3, seed=7).metrics
    print(f"{100 * metrics.success_rate:.0f} % of 3 episodes, {metrics.plan_ms_p50:.1f} ms a step")
