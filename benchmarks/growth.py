"""Growth curves: how time grows with objects, with scenes side by side, and with the horizon.

Usage: python benchmarks/growth.py [objects] [batch] [horizon] [memory] [--quick] [--out DIR]

Measures the curves named (all where none is), writes each as DIR/<curve>.csv, and draws all that
are in DIR into DIR/growth.svg. DIR is docs/growth by default, where the published ones are.

objects  one step of the model: see model_at_scale.py
batch    a rollout of 200 steps of scenes of two, against the scenes in one call
horizon  a control step of the pickup task against its horizon
memory   a step of training on a window of 50 steps: see training_memory.py
"""

import argparse
import csv
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import matplotlib
import numpy as np
from batched_rollouts import measured as rollouts_of
from control_tick import controller, cost_of
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from measuring import machine
from model_at_scale import listing
from model_at_scale import measured as step_of
from training_memory import measured as memory_of

from contactgraph.envs import PickupTask
from contactgraph.model import ContactDynamics, load_model, scene_nodes, shipped_model

Row = dict[str, float | int | str]
Curve = Callable[[ContactDynamics, bool], Iterator[Row]]

_DOCS = Path(__file__).resolve().parents[1] / "docs" / "growth"
_MOST_PLANNED = 400
"""iLQR stops after five rollouts, so the horizon is what grows."""


def objects(model: ContactDynamics, quick: bool) -> Iterator[Row]:
    """Milliseconds of a step."""
    counts = (12, 25) if quick else (12, 25, 50, 100, 300, 1000, 3000)
    for count in counts:
        found = step_of(model, count, 3 if quick else 11)
        yield {
            "objects": count,
            "with lists": found["step"],
            "the list alone": found["list"],
            "all pairs": found["all pairs"],
            "all pairs, by groups": found["by groups"],
        }


def batch(model: ContactDynamics, quick: bool) -> Iterator[Row]:
    """Microseconds of a step of one scene."""
    steps = 200
    for scenes in (1, 16) if quick else (1, 2, 4, 8, 16, 32, 64, 128, 250):
        found = rollouts_of(model, 2, scenes, steps, scenes, 3 if quick else 11)
        each = 1e3 * float(found["together ms"]) / (scenes * steps)
        yield {"scenes": scenes, "us a step of a scene": each}


def horizon(model: ContactDynamics, quick: bool) -> Iterator[Row]:
    """Milliseconds of a control step, the median over an episode's first ones."""
    task = PickupTask()
    for ahead in (5, 10) if quick else (5, 10, 20, 50, 100, 200, _MOST_PLANNED):
        mpc = controller(model, task, ahead)
        observation, _ = task.reset(seed=0)
        cost = cost_of(task, observation["goal"], task.scene.node_count)
        state = mpc.reset(observation, scene_nodes(task.scene), cost)
        taken = []
        for _ in range(10 if quick else 40):
            began = time.perf_counter()
            plan, state = mpc.step(observation, observation["contact"], state)
            force = np.asarray(plan.controls)[0]  # waits for the plan
            taken.append(1e3 * (time.perf_counter() - began))
            observation, *_ = task.step(force)
        yield {"steps ahead": ahead, "tick": float(np.median(taken))}


def memory(model: ContactDynamics, quick: bool) -> Iterator[Row]:
    """GiB planned by XLA; nothing runs."""
    for count in (12,) if quick else (12, 100, 1000):
        near = memory_of(listing(model, count), count, True)
        # A thousand nodes with all pairs as edges would exceed the memory.
        every = memory_of(model, count, True)["memory GiB"] if count <= 100 else ""
        yield {"objects": count, "listed": near["memory GiB"], "all pairs": every}


CURVES: dict[str, Curve] = {
    "objects": objects,
    "batch": batch,
    "horizon": horizon,
    "memory": memory,
}
_UNITS = {
    "objects": "one step of the model, ms",
    "batch": "a step of a scene of two, µs",
    "horizon": "control step, ms",
    "memory": "step of training, GiB",
}


def draw(folder: Path) -> None:
    """All curves of a folder in one picture."""
    matplotlib.rcParams["svg.hashsalt"] = "growth"
    here = [name for name in CURVES if (folder / f"{name}.csv").is_file()]
    figure = Figure(figsize=(3.4 * len(here), 3.2), layout="constrained")
    axes = figure.subplots(1, len(here), squeeze=False)[0]
    for name, panel in zip(here, axes, strict=True):
        with (folder / f"{name}.csv").open() as file:
            _panel(panel, list(csv.DictReader(file)), _UNITS[name])
    figure.savefig(folder / "growth.svg", metadata={"Date": None})


def _panel(axes: Axes, rows: list[dict[str, str]], unit: str) -> None:
    along, *names = rows[0]
    for name in names:
        points = [(float(row[along]), float(row[name])) for row in rows if row[name]]
        axes.loglog(*zip(*points, strict=True), marker="o", ms=3, lw=1.4, label=name)
    axes.set(xlabel=along, ylabel=unit)
    axes.grid(True, which="major", lw=0.4, alpha=0.6)
    if len(names) > 1:
        axes.legend(frameon=False, fontsize="small")


def _rounded(value: float | int | str) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def main() -> None:
    """Measure, write, draw."""
    parser = argparse.ArgumentParser(description="Growth curves.")
    parser.add_argument("curves", nargs="*", choices=[*CURVES, []], help="all where none is named")
    parser.add_argument("--quick", action="store_true", help="few points: to see that it runs")
    parser.add_argument("--out", type=Path, default=_DOCS, help="folder of CSV files and figure")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    model = load_model(shipped_model("pickup")).model
    about = machine()
    print(f"{about['processor']}, {about['cores']} cores, load {about['load_1min']}")
    for name in options.curves or CURVES:
        with (options.out / f"{name}.csv").open("w", newline="") as file:
            for number, row in enumerate(CURVES[name](model, options.quick)):
                writer = csv.DictWriter(file, list(row), lineterminator="\n")
                if number == 0:
                    writer.writeheader()
                writer.writerow({key: _rounded(row[key]) for key in row})
                # Finished curves are kept if a later one fails.
                file.flush()
        print(options.out / f"{name}.csv")
    draw(options.out)


if __name__ == "__main__":
    main()
