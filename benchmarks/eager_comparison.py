"""Rollouts, training steps and plans with the learned model, beside the same in eager PyTorch.

Usage: python benchmarks/eager_comparison.py [--quick] [--json FILE]

The shipped pickup model and a re-implementation of its equations with the same weights (`eager`),
on recorded pickup runs, on one core in float32: predicted positions over 200 steps with 2 and 12
bodies; loss and gradients of a training step (2 bodies: 64 runs of 200 steps; 12 bodies: 8 runs);
and a whole iLQR plan, 20 steps ahead with 2 bodies, by the same rules.
"""

import one_core  # noqa: F401, I001  before JAX and torch

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from measuring import Missing, Row, Method, arguments, compare, report
from contactgraph.control import ILQR, QuadraticCost, chain_cost
from contactgraph.data import Dataset, Trajectory
from contactgraph.evaluate import collect
from contactgraph.model import (
    ContactDynamics,
    ReallocatingModel,
    ModelState,
    Nodes,
    load_model,
    shipped_model,
)
from contactgraph.model import scene_nodes
from contactgraph.model.serialization import module_arrays
from contactgraph.envs import PickupExpert, PickupTask
from contactgraph.train import LossTerms
from contactgraph.train.batch import Window
from contactgraph.train.loss import window_loss

HORIZON, ITERATIONS = 20, 20
NAME = "eager PyTorch"
Sample = tuple[ContactDynamics, list[Trajectory], Nodes]


def sample(bodies: int, runs: int) -> Sample:
    """The model, and trajectories of 200 steps with ``bodies`` bodies."""
    recorded = collect([lambda: PickupTask(bodies - 2)], [PickupExpert()], runs, seed=0)
    # Neighbour lists are used as in training and evaluation.
    model = load_model(shipped_model("pickup")).model
    model = ReallocatingModel(model, Dataset(tuple(recorded))).model
    return model, recorded, scene_nodes(recorded[0].scene)


def arrays(runs: list[Trajectory]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, velocities and controls [runs, ...], float32."""
    return tuple(
        np.stack([getattr(run, name) for run in runs]).astype(np.float32)
        for name in ("position", "velocity", "control")
    )


def rollout(given: Sample) -> tuple[Method, Method | Missing]:
    """Ours, and eager; positions [200, N, 2]."""
    model, runs, nodes = given
    position, velocity, control = (array[0] for array in arrays(runs[:1]))

    weights, static = eqx.partition(model, eqx.is_array)

    @jax.jit
    def predict(weights: tuple, x: jax.Array, v: jax.Array, u: jax.Array) -> jax.Array:
        model = eqx.combine(weights, static)
        start = ModelState(x, v, model.initial_belief(x, v, nodes))
        return model.rollout(start, u, nodes).position

    placed = tuple(map(jnp.asarray, (position[0], velocity[0], control)))
    ours = Method("ours", lambda: jax.block_until_ready(predict(weights, *placed)))
    try:
        import torch
        from eager.model import EagerModel
    except ImportError as missing:
        return ours, Missing(NAME, str(missing))
    eager = EagerModel(model, np.asarray(nodes.actuated))
    start = tuple(map(torch.tensor, (position[0], velocity[0], control)))
    return ours, Method(NAME, lambda: eager.rollout(*start), lambda found: found.numpy())


def training(given: Sample) -> tuple[Method, Method | Missing]:
    """Ours, and eager; the loss and its gradients.

    The weights are perturbed: at the trained ones gradients nearly cancel, with few digits left
    in float32.
    """
    trained, runs, nodes = given
    model = _disturbed(trained)
    position, velocity, control = arrays(runs)
    each = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(runs), *leaf.shape)), nodes)
    window = Window(*map(jnp.asarray, (position, velocity, control)), each)
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(3e-3))
    params, static = eqx.partition(model, eqx.is_inexact_array)
    key = jax.random.key(0)

    def loss(params: ContactDynamics, window: Window) -> jax.Array:
        terms = window_loss(eqx.combine(params, static), window, key, with_rollout=False)
        return terms.total(LossTerms())

    @jax.jit
    def step(params: ContactDynamics, state: optax.OptState, window: Window) -> tuple:
        value, slope = jax.value_and_grad(loss)(params, window)
        updates, state = optimiser.update(slope, state, params)
        return value, slope, optax.apply_updates(params, updates), state

    state = optimiser.init(params)
    ours = Method(
        "ours",
        lambda: jax.block_until_ready(step(params, state, window)),
        lambda found: (np.asarray(found[0]), module_arrays(found[1])),
    )
    try:
        import torch
        from eager.model import EagerModel
        from eager.training import Training
    except ImportError as missing:
        return ours, Missing(NAME, str(missing))
    eager = Training(
        EagerModel(model, np.asarray(nodes.actuated)),
        *map(torch.tensor, (position, velocity, control)),
    )
    return ours, Method(
        NAME,
        eager.step,
        lambda found: (found[0].numpy(), {name: g.numpy() for name, g in found[1].items()}),
    )


def _disturbed(model: ContactDynamics) -> ContactDynamics:
    """Every weight perturbed by about a tenth."""
    rng = np.random.default_rng(0)
    weights, static = eqx.partition(model, eqx.is_inexact_array)

    def moved(leaf: jax.Array) -> jax.Array:
        return leaf * (1.0 + 0.1 * rng.normal(size=leaf.shape)).astype(leaf.dtype)

    return eqx.combine(jax.tree.map(moved, weights), static)


def plan(given: Sample) -> tuple[Method, Method | Missing]:
    """Ours, and eager; controls [H, 2] and their cost."""
    model, runs, nodes = given
    position, velocity, _ = (array[0] for array in arrays(runs[:1]))
    terms, count = PickupTask().cost_terms(), position.shape[1]
    quadratic = chain_cost(
        terms.chain,
        terms.pick_weights,
        terms.goal_weights,
        terms.control_weight,
        runs[0].scene.goal,
        count,
    )
    ilqr = ILQR(horizon=HORIZON, iterations=ITERATIONS)
    weights, static = eqx.partition(model, eqx.is_array)

    @jax.jit
    def solve(weights: tuple, x: jax.Array, v: jax.Array, cost: QuadraticCost) -> tuple:
        model = eqx.combine(weights, static)
        state = ModelState(x, v, model.initial_belief(x, v, nodes))
        found = ilqr.solve(model, state, nodes, cost)
        return found.controls, found.cost, found.iterations

    placed = jnp.asarray(position[0]), jnp.asarray(velocity[0]), quadratic
    ours = Method(
        "ours",
        lambda: jax.block_until_ready(solve(weights, *placed)),
        lambda found: tuple(np.asarray(part) for part in found),
    )
    try:
        import torch
        from eager.model import EagerModel
        from eager.plan import Cost
        from eager.plan import plan as eager_plan
    except ImportError as missing:
        return ours, Missing(NAME, str(missing))
    eager = EagerModel(model, np.asarray(nodes.actuated))
    index = np.arange(4 * count).reshape(count, 2, 2).swapaxes(1, 2).reshape(-1)
    Q, R, goal = (np.asarray(part, float) for part in (quadratic.Q, quadratic.R, quadratic.goal))
    cost = Cost(Q[index[:, None], index], R, goal[index])
    x, v = torch.tensor(position[0]), torch.tensor(velocity[0])

    def run() -> tuple:
        with torch.no_grad():
            belief = eager.prior_belief(eager.encode(x, v))
        return eager_plan(eager, (x, v, belief), cost, HORIZON, ITERATIONS)

    return ours, Method(NAME, run, lambda found: tuple(np.asarray(part, float) for part in found))


def main() -> None:
    """Measure and print."""
    options = arguments("The learned model, beside eager PyTorch.")
    rows: list[Row] = []

    def measure(what: str, pair: tuple[Method, Method | Missing]) -> None:
        rows.extend(compare(what, pair[0], [pair[1]], options.quick))

    two, twelve = (2, 4 if options.quick else 64), (12, 2 if options.quick else 8)
    for bodies, runs in (two, twelve):
        given = sample(bodies, runs)
        measure(f"rollout, T = 200, {bodies} bodies", rollout(given))
        measure(f"training step, {bodies} bodies, {runs} x 200", training(given))
        if bodies == 2:
            measure(f"iLQR plan with the model, horizon {HORIZON}, 2 bodies", plan(given))
    report("eager_comparison", rows, options)


if __name__ == "__main__":
    main()
