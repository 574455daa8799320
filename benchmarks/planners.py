"""iLQR beside MPPI with the same models, by success and by the time of a control step.

Usage: python benchmarks/planners.py [--episodes N] [--out FOLDER]

MPPI is that of ``examples/extend_planner_mppi.py``, as it is there, with numbers of samples that
take about the time of iLQR's step, and more. Every planner controls the same scenes, on one core.
The table is ``planners.csv`` in the folder.
"""

import argparse
import csv
import importlib.util
from functools import partial
from pathlib import Path

from contactgraph.control import compile_small_loops

compile_small_loops()  # before JAX computes anything

import contactgraph  # noqa: E402
from contactgraph.control import pin_to_core  # noqa: E402
from contactgraph.evaluate import control_task  # noqa: E402
from contactgraph.policies import Planning, task_policy  # noqa: E402

EXAMPLE = Path(__file__).parents[1] / "examples" / "extend_planner_mppi.py"
TASKS = ("pickup", "multi-pickup")
SAMPLES = (8, 32)
SEED = 5000


def measure(name: str, samples: int | None, episodes: int) -> dict[str, str | float]:
    """A row of the table; ``samples`` None is iLQR."""
    model, task = contactgraph.load(name), contactgraph.make(name)
    planner = None
    if samples is not None:
        spec = importlib.util.spec_from_file_location(EXAMPLE.stem, EXAMPLE)
        example = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(example)
        planner = partial(example.MPPI, samples=samples)
    policy = task_policy(model, task, Planning(planner=planner))
    task.reset(seed=SEED)
    policy.reset(task.scene, SEED)  # compiles
    with pin_to_core():
        found = control_task(policy, task, episodes, seed=SEED).metrics
    low, high = found.success_interval
    return {
        "task": name,
        "planner": "iLQR" if samples is None else f"MPPI, {samples} samples",
        "success_percent": round(100 * found.success_rate, 1),
        "success_low": round(100 * low),
        "success_high": round(100 * high),
        "goal_cm": float(f"{100 * found.goal_distance_m_median:.3g}"),
        "step_ms_p50": float(f"{found.plan_ms_p50:.3g}"),
        "step_ms_p99": float(f"{found.plan_ms_p99:.3g}"),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=30)
    parser.add_argument("--out", type=Path, default=Path("results/tables"))
    given = parser.parse_args()
    rows = []
    for name in TASKS:
        for samples in (None, *SAMPLES):
            rows.append(measure(name, samples, given.episodes))
            print(rows[-1], flush=True)
            given.out.mkdir(parents=True, exist_ok=True)
            with (given.out / "planners.csv").open("w", newline="") as file:
                writer = csv.DictWriter(file, rows[0], lineterminator="\n")
                writer.writeheader()
                writer.writerows(rows)


if __name__ == "__main__":
    main()
