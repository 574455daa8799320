"""Share of the core's matrix-product rate that a training step reaches.

Usage: python benchmarks/matrix_share.py [--quick] [--json FILE]

Loss, gradients and update on recorded pickups, with 2 bodies (64 runs of 200 steps) and 12 (8
runs), on one core in float32: with the shipped model, whose networks are 32 wide, and with fresh
ones four and eight times as wide, where products are more of the work. Only products of the dense
layers count: one pass for the control sensitivity, one forward pass, and a backward pass with two
products for each (the gradients of input and weights). The core's rate is that of one product of
two large square matrices.
"""

import one_core  # noqa: F401, I001  before JAX
import dataclasses
import itertools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from measuring import arguments, medians, report
from contactgraph.data import Dataset, Trajectory
from contactgraph.envs import PickupExpert, PickupTask
from contactgraph.evaluate import collect
from contactgraph.model import (
    ContactDynamics,
    ModelConfig,
    Nodes,
    ReallocatingModel,
    gim_temp,
    load_model,
    scene_nodes,
    shipped_model,
)
from contactgraph.model.neighbor_list import edge_count
from contactgraph.train import LossTerms
from contactgraph.train.batch import Window
from contactgraph.train.loss import window_loss

PASSES = 4
SIZE = 2048
SHIPPED = 32
Sample = tuple[ContactDynamics, list[Trajectory], Nodes]


def sample(bodies: int, runs: int) -> Sample:
    """The model, and trajectories of 200 steps with ``bodies`` bodies."""
    recorded = collect([lambda: PickupTask(bodies - 2)], [PickupExpert()], runs, seed=0)
    # Neighbour lists are used as in training and evaluation.
    model = load_model(shipped_model("pickup")).model
    model = ReallocatingModel(model, Dataset(tuple(recorded))).model
    return model, recorded, scene_nodes(recorded[0].scene)


def training_step(given: Sample) -> Callable[[], object]:
    """A call that computes loss, gradients and updated weights."""
    model, runs, nodes = given
    recorded = (
        jnp.asarray(np.stack([getattr(run, name) for run in runs]), jnp.float32)
        for name in ("position", "velocity", "control")
    )
    each = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(runs), *leaf.shape)), nodes)
    window = Window(*recorded, each)
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
    return lambda: step(params, state, window)


def widened(given: Sample, width: int) -> Sample:
    """With fresh networks of this width in place of the shipped ones."""
    model, runs, nodes = given
    if width == SHIPPED:
        return given
    fresh = gim_temp(ModelConfig(2, 2, model.dt, width=width), key=jax.random.key(0))
    return dataclasses.replace(fresh, neighbor_list=model.neighbor_list), runs, nodes


def operations(model: ContactDynamics, edges: int, nodes: int) -> int:
    """Of the dense layers' products in one training step; so many edges and nodes in all steps."""
    parts = (
        (edges, (model.inference, model.local_dynamics.message_passing)),
        (edges, model.local_dynamics.head.edge),
        (nodes, model.local_dynamics.head.ground),
    )

    def layers(part: object) -> list[eqx.nn.Linear]:
        leaves = jax.tree.leaves(part, is_leaf=lambda leaf: isinstance(leaf, eqx.nn.Linear))
        return [leaf for leaf in leaves if isinstance(leaf, eqx.nn.Linear)]

    return sum(
        2 * PASSES * count * layer.weight.size for count, part in parts for layer in layers(part)
    )


def core_rate(rounds: int) -> float:
    """Operations a second."""
    square = jnp.ones((SIZE, SIZE), jnp.float32)
    product = jax.jit(jnp.matmul)
    return 2 * SIZE**3 / median_seconds(lambda: product(square, square), rounds)


def median_seconds(run: Callable[[], object], rounds: int) -> float:
    """Median of the calls after one that compiles."""
    return 1e-3 * medians({"call": run}, rounds)["call"]


def main() -> None:
    """Measure and print."""
    options = arguments("Share of the core's matrix-product rate in a training step.")
    rounds = 1 if options.quick else 10
    rows = []
    sizes = (2, 4 if options.quick else 64), (12, 2 if options.quick else 8)
    recorded = [(size, sample(*size)) for size in sizes]
    for ((bodies, runs), shipped), width in itertools.product(recorded, (SHIPPED, 128, 256)):
        given = widened(shipped, width)
        steps = sum(run.steps for run in given[1])
        edges = edge_count(given[0].neighbor_list, bodies)
        count = operations(given[0], steps * edges, steps * bodies)
        rate, seconds = core_rate(rounds), median_seconds(training_step(given), rounds)
        rows.append(
            {
                "training step": f"{bodies} bodies, {runs} x {steps // runs}",
                "width": width,
                "ms": 1e3 * seconds,
                "products, Gop": count / 1e9,
                "Gop/s": count / seconds / 1e9,
                "core's Gop/s": rate / 1e9,
                "share, %": 100 * count / seconds / rate,
            }
        )
    report("matrix_share", rows, options)


if __name__ == "__main__":
    main()
