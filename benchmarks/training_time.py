"""From recorded runs to an accurate model: the whole `contactgraph train`, cold and warm.

Usage: python benchmarks/training_time.py [--quick] [--json FILE]

Every row records 40 runs of the pickup with a seed of its own, trains in a new process without any
compiled program, trains again in another with them, and controls 20 episodes of a seed of its own,
a plan followed for ten steps. The error is the paper's metric: planned
against executed positions over 0.5 s.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from measuring import arguments, report


def measured(seed: int, episodes: int, options: list[str]) -> dict[str, float | int]:
    """One row."""
    with tempfile.TemporaryDirectory(prefix="contactgraph-") as name:
        folder = Path(name)
        os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
        record = ["collect", "pickup", "--episodes", "40", "--seed", f"{seed}", "--out", "data.h5"]
        run(folder, *record)
        train = ["train", "data.h5", "--seed", f"{seed}", *options]
        cold = run(folder, *train, "--out", "cold")
        warm = run(folder, *train, "--out", "warm")
        tested = ["--episodes", f"{episodes}", "--seed", f"{seed + 1}", "--replan-every", "10"]
        run(folder, "control", "warm", "pickup", *tested, "--json", "planned.json")
        found = json.loads((folder / "planned.json").read_text())
    return {
        "seed": seed,
        "cold s": cold,
        "warm s": warm,
        "planned against executed cm": 1e2 * found["n_step_rmse_planned_m"],
        "edge F1": found["edge_f1_planned"],
        "success %": 1e2 * found["success_rate"],
    }


def run(folder: Path, *command: str) -> float:
    """Duration of the command, including process start, s."""
    began = time.perf_counter()
    program = [sys.executable, "-m", "contactgraph", *command]
    subprocess.run(program, cwd=folder, check=True, capture_output=True)
    return time.perf_counter() - began


def main() -> None:
    """Measure and print."""
    options = arguments("From recorded runs to an accurate model.")
    if options.quick:
        rows = [measured(7001, 2, ["--steps", "20"])]
    else:
        rows = [measured(seed, 20, []) for seed in (7001, 7011, 7021)]
    report("training_time", rows, options)


if __name__ == "__main__":
    main()
