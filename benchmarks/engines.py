"""Box2D and pymunk side by side: models of one on the other, experts, and control steps a second.

Usage: python benchmarks/engines.py [--out FOLDER] [--work FOLDER] [--part P ...] [--task T ...]

models    one model of each task and engine (60 trajectories, seed 0, as `train` chooses), on 40
          fresh trajectories and in closed loop on fresh scenes of both engines; and the shipped
          models, which were trained on Box2D
experts   successes of the scripted experts in 100 scenes
rates     control steps a second of a task under random forces, the median of five runs

Models and experts are run by the command line. What is in the work folder is not made again.
"""

import argparse
import csv
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

ENGINES = ("box2d", "pymunk")
TRAINED = {
    "pickup": ((), 100),
    "multi-pickup": (("--objects", "5"), 100),
    "door": ((), 100),
    "billiards": ((), 5),
    "sticky": ((), 30),
    "suction": ((), 30),
}
"""By task: options of its tests, and episodes of control."""
SHIPPED = ("pickup", "multi-pickup", "door")
EXPERTS = (
    *("pickup", "multi-pickup", "door", "billiards", "chain", "unknown-mass"),
    *("suction", "release", "delay", "sticky"),
)
RATES = {
    "pickup": (dict(), dict(distractors=10)),
    "multi-pickup": (dict(objects=1), dict(objects=5, distractors=6)),
    "door": (dict(), dict(distractors=10)),
    "billiards": (dict(objects=1), dict(objects=8)),
    "unknown-mass": (dict(), dict(distractors=10)),
    "suction": (dict(), dict(distractors=10)),
    "release": (dict(), dict(distractors=10)),
    "delay": (dict(), dict(distractors=10)),
    "sticky": (dict(objects=2), dict(objects=5, distractors=6)),
    "chain": (dict(),),
}
"""By task: options of scenes with few bodies and with many."""

Row = dict[str, object]


def contactgraph(*arguments: str) -> None:
    print("contactgraph", *arguments, flush=True)
    subprocess.run(
        [sys.executable, "-m", "contactgraph", *arguments],
        check=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def recorded(work: Path, task: str, engine: str, seed: int, episodes: int, *options: str) -> Path:
    path = work / f"{task}-{engine}-{seed}.h5"
    if not path.exists():
        given = ("--episodes", str(episodes), "--seed", str(seed), "--engine", engine, *options)
        contactgraph("collect", task, "--out", str(path), *given)
    return path


def trained(work: Path, task: str, engine: str) -> Path:
    run = work / f"{task}-{engine}-run"
    data = recorded(work, task, engine, 0, 60)
    if not (run / "done").exists():
        resumed = ("--resume",) if (run / "config.json").exists() else ()
        contactgraph("train", str(data), "--out", str(run), "--seed", "0", *resumed)
        (run / "done").touch()
    return run


def measured(work: Path, task: str, model: str, learned: str, tested: str) -> Row:
    """Of a run folder or a shipped model, ``model``."""
    options, episodes = TRAINED[task]
    data = recorded(work, task, tested, 1000, 40, *options)
    name = "-".join([Path(model).name, tested])
    open_loop, closed_loop = (work / f"{kind}-{name}.json" for kind in ("evaluate", "control"))
    if not open_loop.exists():
        contactgraph("evaluate", model, str(data), "--json", str(open_loop))
    if not closed_loop.exists():
        given = ("--episodes", str(episodes), "--seed", "2000", "--engine", tested, *options)
        contactgraph("control", model, task, "--json", str(closed_loop), *given)
    errors, controlled = (json.loads(path.read_text()) for path in (open_loop, closed_loop))
    return {
        "task": " ".join([task, *options]),
        "trained on": learned,
        "tested on": tested,
        "error, cm": f"{100 * errors['n_step_rmse_moving_m']:.3f}",
        "edge F1": f"{errors['edge_f1']:.3f}",
        "success, %": f"{100 * controlled['success_rate']:.0f}",
        "episodes": episodes,
    }


def models(work: Path, tasks: list[str]) -> Iterator[Row]:
    for task in SHIPPED:
        for tested in ENGINES if task in tasks else ():
            yield measured(work, task, task, "box2d (shipped)", tested)
    for task in tasks:
        for learned in ENGINES:
            for tested in ENGINES:
                yield measured(work, task, str(trained(work, task, learned)), learned, tested)


def experts(work: Path, tasks: list[str]) -> Iterator[Row]:
    for task in EXPERTS:
        row: Row = {"task": task}
        for engine in ENGINES:
            path = work / f"expert-{task}-{engine}.json"
            if not path.exists():
                given = ("--episodes", "100", "--seed", "3000", "--engine", engine)
                contactgraph("control", "expert", task, "--json", str(path), *given)
            row[f"{engine}, % of 100"] = f"{100 * json.loads(path.read_text())['success_rate']:.0f}"
        yield row


def steps_a_second(make: Callable[[], object], steps: int = 200) -> float:
    """Of a world whose first body random forces drive towards the second, without its task."""
    took = []
    for seed in range(5):
        task = make()
        task.reset(seed=seed)
        world, rng = task.world, np.random.default_rng(seed)
        force, spent = np.zeros((len(world.position), 2)), 0.0
        for step in range(steps):
            if step % 5 == 0:
                way = world.position[1] - world.position[0]
                force[0] = 9.0 * way - 1.5 * world.velocity[0] + rng.normal(0.0, 4.0, 2)
            begun = time.perf_counter()
            world.step(force)
            spent += time.perf_counter() - begun
        took.append(spent / steps)
    return 1.0 / float(np.median(took))


def rates(work: Path, tasks: list[str]) -> Iterator[Row]:
    from contactgraph import make

    for task, scenes in RATES.items():
        for options in scenes:
            row: Row = {"task": task, "bodies": 0}
            for engine in ENGINES:
                made = partial(make, task, engine=engine, **options)
                example = made()
                example.reset(seed=0)
                row["bodies"] = example.scene.node_count
                row[f"{engine}, control steps a second"] = 100 * round(steps_a_second(made) / 100)
            yield row


PARTS = {"models": models, "experts": experts, "rates": rates}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/engines"))
    parser.add_argument("--work", type=Path, default=Path("build/engines"))
    parser.add_argument("--part", nargs="*", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--task", nargs="*", choices=list(TRAINED), default=list(TRAINED))
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    options.out.mkdir(parents=True, exist_ok=True)
    for part in options.part:
        rows: list[Row] = []
        for row in PARTS[part](options.work, options.task):
            print(row, flush=True)
            rows.append(row)
        with (options.out / f"{part}.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, fieldnames=list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
