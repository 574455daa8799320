"""Costs of plans against the best of many random restarts, in scenes on the way.

Each scene is controlled for some steps. There the running controller's next plan is compared with
the cheapest of ``--restarts`` plans by iLQR from random controls, with four times the rollouts.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import contactgraph
from contactgraph.control import ILQR, MPC, AffinePolicy, ControlLimits, MultiStartILQR, Routes
from contactgraph.model import ModelState, scene_nodes
from contactgraph.policies import TaskCost, avoid_others

HORIZON, ITERATIONS, ROUTES, TOGETHER, LATEST = 20, 5, 7, 100, 40
CASES = {
    "pickup": ({}, None, ILQR),
    "in the way, iLQR alone": ({"distractors": 10, "in_the_way": True}, 0.03, ILQR),
    "in the way, routes": ({"distractors": 10, "in_the_way": True}, 0.03, MultiStartILQR),
}
STRENGTH_N = 4.0
"""Standard deviation of random controls, each of which lasts for five steps."""


def measure(name: str, scenes: int, restarts: int) -> dict[str, float]:
    options, clearance, kind = CASES[name]
    model, task = contactgraph.load("pickup"), contactgraph.make("pickup", **options)
    box = task.action_space
    limits = ControlLimits(jnp.asarray(box.low), jnp.asarray(box.high))
    more = {"proposals": (Routes(ROUTES),)} if kind is MultiStartILQR else {}
    mpc = MPC(model, kind(HORIZON, ITERATIONS, limits, **more))
    thorough = ILQR(HORIZON, 4 * ITERATIONS, limits)

    @eqx.filter_jit
    def cheapest(state: ModelState, nodes, cost, key: jax.Array) -> jax.Array:
        def one(key: jax.Array) -> jax.Array:
            held = STRENGTH_N * jax.random.normal(key, (HORIZON // 5, len(box.low)))
            guess = thorough.prepared(model, state, nodes, cost, None).guess
            return thorough.solve(
                model, state, nodes, cost, AffinePolicy(guess.K, jnp.repeat(held, 5, axis=0))
            ).cost

        keys = jax.random.split(key, (restarts // TOGETHER, TOGETHER))
        return jnp.nanmin(jax.lax.map(jax.vmap(one), keys))

    ratios = []
    for seed in range(scenes):
        observation, _ = task.reset(seed=seed)
        cost = TaskCost(task.cost_terms(), len(box.low), task.cost_terms)
        cost = cost.in_scene(task.scene)
        wanted = cost.quadratic(task.scene.node_count)
        if clearance is not None:
            wanted = replace(wanted, contacts=avoid_others(task.scene, cost.order, clearance))
        nodes = scene_nodes(task.scene)
        state = mpc.reset(observation, nodes, wanted)
        for _ in range(seed % LATEST):
            plan, state = mpc.step(observation, observation["contact"], state)
            observation, *_ = task.step(np.asarray(plan.controls[0]))
        plan, after = mpc.step(observation, observation["contact"], state)
        now = ModelState(after.last.position, after.last.velocity, after.last.belief)
        best = float(cheapest(now, state.nodes, state.cost, jax.random.key(seed)))
        ratios.append(float(plan.cost) / best)
    low, middle, high = np.percentile(ratios, [25, 50, 75])
    within = float(np.mean(np.array(ratios) <= 1.1))
    return {"median": middle, "quartile_25": low, "quartile_75": high, "within_1.1": within}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=100)
    parser.add_argument("--restarts", type=int, default=1000)
    parser.add_argument("--only", choices=list(CASES))
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    results = {}
    for name in [arguments.only] if arguments.only else CASES:
        results[name] = measure(name, arguments.scenes, arguments.restarts)
        numbers = ", ".join(f"{key} {value:.3f}" for key, value in results[name].items())
        print(f"{name}: cost of the plan over that of the best restart: {numbers}", flush=True)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
