"""A planner of one's own in the place of iLQR: the cross-entropy method (Rubinstein 1999).

Usage: python examples/extend_planner_cem.py
In this folder also: contactgraph control pickup pickup --planner extend_planner_cem:CEM
"""

import equinox as eqx
import jax
import jax.numpy as jnp

import contactgraph
from contactgraph.control import AffinePolicy, ControlLimits, Plan, PlanStatus
from contactgraph.evaluate import control_task
from contactgraph.model.step import rollout
from contactgraph.policies import Planning, task_policy


class CEM(eqx.Module):
    """Draws controls, and draws again about the mean of the best with their spread."""

    horizon: int = eqx.field(static=True)
    limits: ControlLimits
    samples: int = eqx.field(static=True, default=64)
    best: int = eqx.field(static=True, default=8)
    rounds: int = eqx.field(static=True, default=3)
    noise: float = eqx.field(static=True, default=0.15)  # of the range of each control, at first

    def solve(self, model, state, nodes, cost, guess=None):
        """See `contactgraph.control.Planner`."""
        U, start = cost.control_size, jnp.stack([state.position, state.velocity], axis=1)
        mean = jnp.zeros((self.horizon, U)) if guess is None else guess.k

        def predicted(controls):
            after = rollout(model, state, controls, nodes)
            moved = jnp.stack([after.position, after.velocity], axis=2)
            states = jnp.concatenate([start[None], moved])
            return states, after.belief, cost(states, controls, after.belief)

        spread = jnp.broadcast_to(self.noise * (self.limits.upper - self.limits.lower), mean.shape)
        for key in jax.random.split(jax.random.key(0), self.rounds):
            drawn = jax.random.normal(key, (self.samples, *mean.shape))
            tried = self.limits(mean + spread * drawn)
            costs = jax.vmap(lambda controls: predicted(controls)[2])(tried)
            chosen = tried[jnp.argsort(costs)[: self.best]]
            mean, spread = jnp.mean(chosen, axis=0), jnp.std(chosen, axis=0)
        controls = mean
        states, beliefs, total = predicted(controls)
        finite = jnp.isfinite(total)
        return Plan(
            states=states,
            controls=controls,
            policy=AffinePolicy(jnp.zeros((self.horizon, U, *start.shape)), controls),
            beliefs=beliefs,
            cost=total,
            status=jnp.where(finite, PlanStatus.ITERATION_LIMIT, PlanStatus.NOT_FINITE),
            iterations=jnp.asarray(self.rounds * self.samples + 1, jnp.int32),
            node_ids=jnp.arange(len(start), dtype=jnp.int32),
        )


if __name__ == "__main__":
    model, task = contactgraph.load("pickup"), contactgraph.make("pickup")
    policy = task_policy(model, task, Planning(planner=CEM, horizon=15))
    metrics = control_task(policy, task, 3, seed=7).metrics
    print(f"{100 * metrics.success_rate:.0f} % of 3 episodes, {metrics.plan_ms_p50:.1f} ms a step")
