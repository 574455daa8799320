"""Time from the start of a process to its first control step, with compiled programs.

Usage: python benchmarks/first_tick.py [--quick] [--json FILE]

A process imports the package, loads the shipped pickup model, resets the controller on a scene of
11 objects and makes one control step with horizon 20. The time is that of the whole process, with
interpreter and imports. Traced and compiled programs are kept in a folder, which is empty for the
first process (the peer here) and complete for the next one. The forces are compared.
"""

import subprocess
import sys
import tempfile
import time

import numpy as np
from measuring import arguments, comparison, difference, report

FIRST_STEP = """
import sys, jax
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
import numpy as np
from contactgraph.control import ILQR, MPC, ActiveSetMPC, chain_cost
from contactgraph.model import (load_model, shipped_model)
from contactgraph.model import scene_nodes
from contactgraph.envs import PickupTask

task = PickupTask(distractors=9)
observation, _ = task.reset(seed=0)
terms = task.cost_terms()
cost = chain_cost(terms.chain, terms.pick_weights, terms.goal_weights, terms.control_weight,
                  observation["goal"], task.scene.node_count)
mpc = ActiveSetMPC(MPC(load_model(shipped_model("pickup")).model, ILQR(horizon=20, iterations=5)))
state = mpc.reset(observation, scene_nodes(task.scene), cost)
plan, state = mpc.step(observation, observation["contact"], state)
print(*np.asarray(plan.controls[0], float))
"""


def first_step(folder: str) -> tuple[float, np.ndarray]:
    """Seconds from the process's start to its end, and the first force, N."""
    began = time.perf_counter()
    command = [sys.executable, "-c", FIRST_STEP, folder]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return time.perf_counter() - began, np.array([float(word) for word in output.split()])


def main() -> None:
    """Measure and print."""
    options = arguments("Time to the first control step of a new process.")
    cold, warm = [], []
    for _ in range(1 if options.quick else 3):
        with tempfile.TemporaryDirectory() as folder:
            seconds, force = first_step(folder)
            cold.append(seconds)
            seconds, again = first_step(folder)
            warm.append(seconds)
    what = "first control tick of a new process, programs compiled before"
    apart = difference(again, force)
    row = comparison(what, warm, "nothing compiled before", cold, apart)
    report("first_tick", [row], options)


if __name__ == "__main__":
    main()
