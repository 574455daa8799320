"""Time of recording by two processes, compared with one.

Usage: python benchmarks/collection.py [--quick] [--json FILE]

Pickup runs by the scripted expert, through `collect`, by this process alone and by an executor
with two workers. The recorded runs are compared: they must be equal.
"""

import time

from measuring import arguments, comparison, difference, report

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
    """Measure and print."""
    options = arguments("Recording by two processes, beside one.")
    count = 40 if options.quick else RUNS
    alone, both = [], []
    for _ in range(1 if options.quick else 2):
        seconds_one, by_one = recorded(count, None)
        seconds_two, by_two = recorded(count, LocalExecutor(2))
        alone.append(seconds_one)
        both.append(seconds_two)
    steps = sum(run.steps for run in by_one)
    positions = [[run.position for run in runs] for runs in (by_two, by_one)]
    what = f"recording {count} pickup runs ({steps:,} steps), two processes"
    row = comparison(what, both, "one process", alone, difference(*positions))
    report("collection", [row], options)


if __name__ == "__main__":
    main()
