"""An edge type of your own, with a law of its own: a spring that hooks on, and off again.

Usage: python examples/extend_edge_type.py

A type that neither pushes nor holds has no part in `ContactLaw`; a law that extends it adds its
force. When it acts is inferred from motion alone, as for touch and hold.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import contactgraph.model as cg
from contactgraph.data import Dataset, Scene, Trajectory
from contactgraph.evaluate import evaluate_open_loop
from contactgraph.train import TrainConfig, fit, initial_state

DT, SUBSTEPS = 0.05, 20  # s, -
SCENE = Scene(("puck", "hand"), ("puck", "hand"), np.array([False, True]), DT, 2)


def simulate(rng: np.random.Generator) -> Trajectory:
    """Bodies of 1 kg; below 0.25 m a spring (20 N/m, 0.2 m) joins them, until it is 0.4 m long."""
    x, v, hooked = np.array([[0.0, 0.0], 0.3 * rng.normal(size=2)]), np.zeros((2, 2)), False
    states, controls = [(x, v)], 2.0 * rng.normal(size=(60, 2))
    for control in controls:
        control += (6.0 * (len(states) // 15 % 2) - 1.0) * (x[0] - x[1]) - v[1]
        for _ in range(SUBSTEPS):
            length = np.linalg.norm(x[0] - x[1])
            hooked = length < (0.4 if hooked else 0.25)
            pull = hooked * 20.0 * (1.0 - 0.2 / length) * (x[0] - x[1])
            v = v + np.stack([-pull, pull + control]) * DT / SUBSTEPS
            x = x + v * DT / SUBSTEPS
        states.append((x, v))
    return Trajectory(SCENE, *map(np.stack, zip(*states, strict=True)), controls)


class SpringLaw(cg.ContactLaw):
    """A law of contact whose last edge type is a spring."""

    spring: jax.Array  # fifths of the logarithms of N/m and m, which learn as fast as networks

    def __init__(self, law):
        vars(self).update(vars(law), spring=jnp.log(jnp.array([10.0, 0.1])) / 5.0)

    def __call__(self, graph, embedding, message, *, theta, dt):
        parameters = super().__call__(graph, embedding, message, theta=theta, dt=dt)
        (stiffness, rest), geometry = jnp.exp(5.0 * self.spring), graph.geometry
        mass = self.mass(graph.bodies.node_type, 0.0)
        pull = graph.active[:, -1:] * stiffness * (geometry.distance - rest)[:, None]
        pull = jnp.stack([pull, -pull]) * geometry.direction
        force = cg.sum_at_nodes(pull, geometry.edge_index, len(mass)) / mass[:, None]
        return dataclasses.replace(parameters, acceleration=parameters.acceleration + force)


def error(*further: cg.EdgeType) -> float:
    """cm, of a model that is trained with further edge types, of which the last is a spring."""
    types, names = (cg.TOUCH, cg.HOLD, *further), ("puck", "hand")
    config = cg.ModelConfig(2, 2, DT, 0.05, width=16, node_types=names, edge_types=types)
    model = dataclasses.replace(cg.ours(config, key=jax.random.key(0)), cutoff=cg.NoCutoff())
    if further:
        model = eqx.tree_at(lambda each: each.local_dynamics.head, model, replace_fn=SpringLaw)
    steps = TrainConfig(300, 16, 4, learning_rate=5e-3, rollout_from=1.0, check_every=300)
    best = fit(initial_state(model, steps, seed=0), *recorded[:2], steps).model
    found = evaluate_open_loop(best, recorded[2], motion_noise=cg.motion_noise(best))
    return 100 * found["n_step_rmse_moving_m"]


runs = tuple(map(simulate, map(np.random.default_rng, range(36))))
recorded = [Dataset(runs[n : n + 12]) for n in (0, 12, 24)]
without, with_spring = error(), error(cg.EdgeType("spring"))
print(f"in half a second: {without:.2f} cm; {without / with_spring:.0f} times less with a spring")
