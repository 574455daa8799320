"""How fast runs are recorded by two processes, beside one.

Usage: python benchmarks/collection.py [--quick] [--json FILE]

Pickup runs by the scripted expert, through `collect`, by this process alone and by an executor
with two workers. The recorded runs are compared: they must be equal.
"""

import time

import numpy as np
from comparing import difference
from measuring import arguments, report

from contactgraph.data import Trajectory
from contactgraph.envs import PickupExpert, PickupTask
from contactgraph.envs.episodes import collect
from contactgraph.parallel import LocalExecutor

RUNS = 1000


def recorded(runs: int, executor: LocalExecutor | None) -> tuple[float, list[Trajectory]]:
    """Seconds, and the runs."""
    began = time.perf_counter()
    found = collect([PickupTask], [PickupExpert()], runs, seed=0, executor=executor)
    return time.perf_counter() - began, found


def main() -> None:
    """Measure and say."""
    told = arguments("Recording by two processes, beside one.")
    count = 40 if told.quick else RUNS
    alone, both, ratios = [], [], []
    for _ in range(1 if told.quick else 2):
        seconds_one, by_one = recorded(count, None)
        seconds_two, by_two = recorded(count, LocalExecutor(2))
        alone.append(seconds_one)
        both.append(seconds_two)
        ratios.append(seconds_one / seconds_two)
    steps = sum(run.steps for run in by_one)
    positions = [[run.position for run in runs] for runs in (by_two, by_one)]
    row = {
        "what": f"recording {count} pickup runs ({steps:,} steps), two processes",
        "ours ms": 1e3 * float(np.median(both)),
        "peer": "one process",
        "peer ms": 1e3 * float(np.median(alone)),
        "ratio": float(np.median(ratios)),
        "agreement": f"{difference(*positions):.0e}",
        "rounds": len(ratios),
    }
    report("collection", [row], told)


if __name__ == "__main__":
    main()
