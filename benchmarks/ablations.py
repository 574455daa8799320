"""What gets worse when a mechanism of inference, or of its training, is taken out.

Each row replaces one expression in a copy of the library, trains, and measures:

    python benchmarks/ablations.py release,delay,multi-pickup --out ablations

Data are 60 recorded trajectories of seed 300, and 30 of seed 1300 for tests. What is measured
already in the folder is kept. The first row is the library as it is, trained with three seeds,
whose range is the noise of the others, trained once.
"""

import argparse
import csv
import json
import os
import shutil
import statistics
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import contactgraph

PACKAGE = Path(contactgraph.__file__).parent
RECORDED = {"train": (60, 300), "test": (30, 1300)}
"""Episodes and seed of the trajectories of a task."""
KEYS = {
    "forced_cm": ("forced", "n_step_rmse_moving_inferred_m", 100.0),
    "forced_mean_cm": ("forced", "n_step_mean_moving_inferred_m", 100.0),
    "forced_calibration": ("forced", "calibration_error_inferred", 1.0),
    "forced_calibration_ahead": ("forced", "calibration_error_ahead_inferred", 1.0),
    "recorded_cm": ("recorded", "n_step_rmse_moving_inferred_m", 100.0),
    "recorded_mean_cm": ("recorded", "n_step_mean_moving_inferred_m", 100.0),
    "edge_f1": ("recorded", "edge_f1_now_inferred", 1.0),
}
"""Columns: the evaluation, the key in its output, and the factor to the column's unit."""


@dataclass(frozen=True)
class Ablation:
    """A mechanism, and the expression that is replaced to take it out."""

    name: str
    file: str
    """In the package."""
    old: str
    new: str

    def apply(self, package: Path) -> None:
        """Raises `ValueError` unless the expression occurs exactly once."""
        path = package / self.file
        text = path.read_text(encoding="utf-8")
        if text.count(self.old) != 1:
            raise ValueError(f"{self.name}: {self.file} has {text.count(self.old)} of {self.old!r}")
        path.write_text(text.replace(self.old, self.new), encoding="utf-8")


_EDGES = "inference/edge_inference.py"
_FEATURES = "inference/features.py"
_NOISE = "inference/motion_noise.py"
_EM = "train/expectation_maximisation.py"
_LAW = "dynamics/contact_law.py"
_GEOMETRY = "bodies/geometry.py"
ABLATIONS = (
    Ablation("ages of types", _EDGES, "_AGES = 44", "_AGES = 2"),
    Ablation(
        "pulls that end holds",
        _EDGES,
        "unbroken = jax.nn.sigmoid(-(2.0 + jnp.exp(steeper)) * excess)",
        "unbroken = jnp.ones_like(excess)",
    ),
    Ablation(
        "a touch ends at a gap",
        _EDGES,
        "unilateral[:, None] & (embedding[:, -1:, None] > 0)",
        "unilateral[:, None] & (embedding[:, -1:, None] > np.inf)",
    ),
    Ablation(
        "a touch lasts",
        _EDGES,
        "_TOUCHES, _STAYS_FREE = 3.0, 10.0",
        "_TOUCHES, _STAYS_FREE = 0.0, 10.0",
    ),
    Ablation(
        "what is free stays free",
        _EDGES,
        "_TOUCHES, _STAYS_FREE = 3.0, 10.0",
        "_TOUCHES, _STAYS_FREE = 3.0, 0.0",
    ),
    Ablation("far bodies hold less", _EDGES, "_DISTANT = 10.0", "_DISTANT = 0.0"),
    Ablation(
        "least transitions",
        "model/presets.py",
        "_MIN_TRANSITION, _MIN_TRANSITION_RATE = 2e-3, 0.04",
        "_MIN_TRANSITION, _MIN_TRANSITION_RATE = 1e-6, 1e-6",
    ),
    Ablation(
        "least transitions by geometry",
        _EDGES,
        "jnp.where(free, 1.0, 1.0 - prior[:, :1])",
        "jnp.ones_like(prior)",
    ),
    Ablation(
        "gap as a feature",
        _EDGES,
        "jnp.concatenate([known[:, 2:], ends, own], axis=-1)",
        "jnp.concatenate([0.0 * known[:, 2:5], known[:, 5:], ends, own], axis=-1)",
    ),
    Ablation(
        "tolerance of the gap",
        _FEATURES,
        "_TOUCHING, GAP_SCALES = 0.002,",
        "_TOUCHING, GAP_SCALES = 0.0,",
    ),
    Ablation(
        "holds begin where bodies meet",
        _EDGES,
        "jnp.where(lasts, 1.0, meets[:, None, None])",
        "1.0",
    ),
    Ablation(
        "changes at any time of a step",
        _NOISE,
        "_UNIFORM = 12.0**-0.5",
        "_UNIFORM = 0.0",
    ),
    Ablation(
        "contact as geometry foresees",
        _NOISE,
        "second = jnp.where(first == 0, throughout_last, jnp.arange(types**2))",
        "second = jnp.arange(types**2)",
    ),
    Ablation(
        "a hold may end in the last instant",
        _NOISE,
        "second = jnp.where(~touches & (first > last), throughout_first, second)",
        "second = jnp.where(False, throughout_first, second)",
    ),
    Ablation(
        "a hold may begin in the last instant",
        _NOISE,
        "begins = (touches | (first == 0)) & jnp.asarray(holds)[last]",
        "begins = jnp.zeros_like(touches)",
    ),
    Ablation(
        "no evidence within the noise",
        _NOISE,
        "relevance = 1.0 - dimension / jnp.maximum(contrast, dimension)",
        "relevance = jnp.ones_like(contrast)",
    ),
    Ablation(
        "bound on a step's evidence",
        _NOISE,
        "max_log_ratio: float = eqx.field(static=True, default=6.0)",
        "max_log_ratio: float = eqx.field(static=True, default=60.0)",
    ),
    Ablation(
        "heavy tails",
        _NOISE,
        "tail: float = eqx.field(static=True, default=4.0)",
        "tail: float = eqx.field(static=True, default=1000.0)",
    ),
    Ablation(
        "learned share of effects",
        _NOISE,
        "return jnp.maximum(jnp.exp(_PACE * self.log_share), _LEAST_SHARE)",
        "return 0.0 * self.log_share + _LEAST_SHARE",
    ),
    Ablation(
        "edges judged as touching",
        "model/motion_likelihood.py",
        "belief, meeting, as_touching=True)",
        "belief, meeting)",
    ),
    Ablation(
        "one edge after the other",
        "model/motion_likelihood.py",
        "return types.at[edge].set(one_hot[jnp.argmax(after)]), ratios",
        "return types + 0.0 * after.sum(), ratios",
    ),
    Ablation(
        "near bodies are held until judged",
        "train/motion_evidence.py",
        "first_where(each.holds for each in prior.edge_types)",
        "first_where(each.unilateral for each in prior.edge_types)",
    ),
    Ablation(
        "windows from their first states",
        _EM,
        "(jnp.arange(config.batch_size) % 2 == 1) & joined",
        "(jnp.arange(config.batch_size) % 2 == 2) & joined",
    ),
    Ablation("models are compared late", _EM, "compared_from = 0.75", "compared_from = 0.0"),
    Ablation(
        "motion before held-out windows", _EM, "least_burn, burn = 1, 20", "least_burn, burn = 1, 1"
    ),
    Ablation(
        "slow contact distance",
        _EM,
        "bounded_distance(in_lengths=True)",
        "bounded_distance(in_lengths=False)",
    ),
    Ablation(
        "early contacts do nothing",
        _LAW,
        "early = geometry.approach > (tolerance := _EARLY * self.length)",
        "early = geometry.approach > 1e9 * (tolerance := _EARLY * self.length)",
    ),
    Ablation("soft contacts", _LAW, "_SOFTEST = 0.5", "_SOFTEST = 0.0"),
    Ablation(
        "motion by the control within a step",
        "model/contact_dynamics.py",
        "return None if displacement is None else displacement.astype(bodies.velocity.dtype)",
        "return None",
    ),
    Ablation(
        "pulls as if nothing held",
        "model/contact_dynamics.py",
        "displacement=alone,",
        "displacement=displacement,",
    ),
    Ablation(
        "what holds meets as if it did not",
        "model/contact_dynamics.py",
        "driven = jnp.where(held, meeting.relative(alone), meeting.relative(displacement))",
        "driven = meeting.relative(displacement)",
    ),
    Ablation(
        "where bodies end",
        "model/motion_likelihood.py",
        "ratios = ratios - ratios[0, 0] + apart[edge]",
        "ratios = ratios - ratios[0, 0]",
    ),
    Ablation(
        "three beginnings of a mass",
        "model/body_mass.py",
        "np.array([[0.0], [-1.0], [1.0]])",
        "np.array([[0.0]])",
    ),
    Ablation("the path under a force", _GEOMETRY, "_REFINEMENTS = 3", "_REFINEMENTS = 1"),
    Ablation("chords of the path", _GEOMETRY, "_CHORDS = 8", "_CHORDS = 1"),
    Ablation(
        "normals turn within a step",
        _GEOMETRY,
        "touching = touching + 0.5 * (1.0 - time_of_contact) * across",
        "touching = touching + 0.0 * across",
    ),
)
NOTHING, SEEDS = "nothing", range(3)


def command(log: Path, package: Path, *lines: list[object]) -> None:
    """Runs command lines in a process of the library in the folder ``package``."""
    given = [[str(word) for word in line] for line in lines]
    code = f"from contactgraph.cli.main import run\nexit(max(map(run, {given})))"
    environment = {**os.environ, "PYTHONPATH": str(package)}
    with log.open("w") as output:
        subprocess.run(
            [sys.executable, "-c", code], env=environment, check=True, stdout=output, stderr=output
        )


def measure(folder: Path, ablation: Ablation | None, seed: int) -> None:
    """Writes both evaluations into a new ``folder`` beside the recorded trajectories."""
    part = folder.with_suffix(".part")
    shutil.rmtree(part, ignore_errors=True)
    copy = part / "src" / PACKAGE.name
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__", "pretrained"))
    if ablation is not None:
        ablation.apply(copy)
    run, test = part / "run", folder.parent / "test.h5"
    command(
        part / "log",
        copy.parent,
        ["train", folder.parent / "train.h5", "--out", run, "--seed", seed],
        ["evaluate", run, test, "--json", part / "recorded.json"],
        ["evaluate", run, test, "--forced", "--json", part / "forced.json"],
    )
    shutil.rmtree(part / "src")
    part.rename(folder)


def numbers(folder: Path) -> dict[str, float]:
    """The columns of a measured training, NaN for what is not known."""
    found = {
        kind: json.loads((folder / f"{kind}.json").read_text()) for kind, _, _ in KEYS.values()
    }
    return {
        name: factor * float("nan" if (value := found[kind].get(key)) is None else value)
        for name, (kind, key, factor) in KEYS.items()
    }


def folder_of(task: Path, name: str, seed: int) -> Path:
    """Of a training without the mechanism of that name."""
    return task / f"{name.replace(' ', '-')}-{seed}"


def table(tasks: list[Path]) -> list[dict[str, object]]:
    """The measured rows: median, least and greatest number of the trainings, for each task."""
    rows: list[dict[str, object]] = []
    for name in (NOTHING, *(one.name for one in ABLATIONS)):
        row: dict[str, object] = {"taken_out": name}
        for task in tasks:
            folders = (folder_of(task, name, seed) for seed in SEEDS)
            measured = [numbers(folder) for folder in folders if folder.is_dir()]
            for key in KEYS:
                values = [each[key] for each in measured]
                of_values = ("median", statistics.median), ("low", min), ("high", max)
                for end, summary in of_values if values else ():
                    row[f"{task.name}_{key}_{end}".replace("-", "_")] = f"{summary(values):.4g}"
        rows.append(row)
    return rows


def main() -> None:
    """Measure what lacks, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tasks", help="names, separated by commas")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", default="", help="parts of names, separated by commas")
    parser.add_argument("--jobs", type=int, default=2, help="trainings at a time")
    given = parser.parse_args()
    tasks = [given.out / name for name in given.tasks.split(",")]
    for task in tasks:
        task.mkdir(parents=True, exist_ok=True)
        for name, (episodes, seed) in RECORDED.items():
            if not (task / f"{name}.h5").is_file():
                counts = ["--episodes", episodes, "--seed", seed]
                line = ["collect", task.name, *counts, "--out", task / f"{name}.h5"]
                command(task / f"{name}.log", PACKAGE.parent, line)
    wanted = [each.strip() for each in given.only.split(",")]
    chosen = [one for one in ABLATIONS if any(each in one.name for each in wanted)]
    jobs: list[tuple[Path, str, Ablation | None, int]] = []
    for task in tasks:
        jobs += [(task, NOTHING, None, seed) for seed in SEEDS]
        jobs += [(task, one.name, one, SEEDS[0]) for one in chosen]

    def done(job: tuple[Path, str, Ablation | None, int]) -> None:
        task, name, ablation, seed = job
        folder = folder_of(task, name, seed)
        if not folder.is_dir():
            try:
                measure(folder, ablation, seed)
            except subprocess.CalledProcessError:
                print(f"{name}: failed, see {folder.with_suffix('.part') / 'log'}", flush=True)
                return
        texts = (f"{key} {value:.4g}" for key, value in numbers(folder).items())
        print(f"{task.name}, {name}, {seed}: {', '.join(texts)}", flush=True)

    with ThreadPoolExecutor(given.jobs) as pool:
        list(pool.map(done, jobs))
    rows = table(tasks)
    with (given.out / "ablations.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys(), restval="")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
