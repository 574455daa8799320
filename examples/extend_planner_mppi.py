"""A planner of one's own in the place of iLQR: MPPI (Williams et al. 2017), which only samples.

Usage: python examples/extend_planner_mppi.py
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from contactgraph.control import MPC, AffinePolicy, ControlLimits, Plan, PlanStatus, chain_cost
from contactgraph.envs import PickupTask
from contactgraph.model import load_model, scene_nodes, shipped_model
from contactgraph.model.step import rollout


class MPPI(eqx.Module):
    """Averages random controls, weighted by ``exp(-cost / temperature)``."""

    limits: ControlLimits
    horizon: int = eqx.field(static=True, default=15)
    samples: int = eqx.field(static=True, default=128)
    noise: float = eqx.field(static=True, default=3.0)  # N
    temperature: float = eqx.field(static=True, default=1.0)

    def solve(self, model, state, nodes, cost, guess=None):
        """See `contactgraph.control.Planner`."""
        U, start = cost.control_size, jnp.stack([state.position, state.velocity], axis=1)
        mean = jnp.zeros((self.horizon, U)) if guess is None else guess.k

        def predicted(controls):
            after = rollout(model, state, controls, nodes)
            moved = jnp.stack([after.position, after.velocity], axis=2)
            states = jnp.concatenate([start[None], moved])
            return states, after.belief, cost(states, controls)

        shape = (self.samples, self.horizon, U)
        tried = self.limits(mean + self.noise * jax.random.normal(jax.random.key(0), shape))
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


model, task = load_model(shipped_model("pickup")).model, PickupTask()
observation, _ = task.reset(seed=7)
count, goal = task.scene.node_count, observation["goal"]
cost = chain_cost([0, 1], [3, 3, 0.2, 0.2], [50, 50, 1, 1], 0.01, goal, count)
mpc = MPC(model, MPPI(ControlLimits(jnp.full(2, -10.0), jnp.full(2, 10.0))))
state = mpc.reset(observation, scene_nodes(task.scene), cost)
first = np.linalg.norm(np.subtract(*observation["position"][:2]))
for _ in range(15):
    plan, state = mpc.step(observation, observation["contact"], state)
    observation, *_ = task.step(np.asarray(plan.controls)[0])
last = np.linalg.norm(np.subtract(*observation["position"][:2]))
print(f"gripper to target: {first:.2f} m, after {15 * model.dt:.2f} s with MPPI {last:.2f} m")
print("nearer" if last < 0.7 * first else "not nearer")
