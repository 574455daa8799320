"""Costs learned from runs of a controller whose cost is known, beside that cost."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import gymnasium
import jax.numpy as jnp
import numpy as np

from contactgraph.control import CostTerm, LearnedCost, LearningHistory, cost_terms, read_cost
from contactgraph.data import read_trajectories
from contactgraph.evaluate import TaskCost
from contactgraph_studies.cost.cells import Learned, Place
from contactgraph_studies.cost.declared import CostTask, Lesson
from contactgraph_studies.measurement import Measurement
from contactgraph_studies.results import Figure

_AT_LIMIT = 0.999


@dataclass(frozen=True, eq=False)
class KnownAnswer:
    """Of one seed."""

    hidden: LearnedCost
    """That the runs were made by."""
    learned: LearnedCost
    """From the runs."""
    at_limit: float
    """Share of the runs' steps in which the force is as large as it may be."""


@dataclass(frozen=True)
class KnownTerm:
    """What it costs to be off by one unit in one of a cost's terms, as a force: `CostTerm`."""

    name: str
    unit: str
    """Of being off."""
    hidden: Figure
    """N; of every seed."""
    learned: Figure
    """N; of every seed."""

    @property
    def ratio(self) -> Figure:
        """Learned over hidden; 1 is the known answer."""
        pairs = zip(self.learned.values, self.hidden.values, strict=True)
        return Figure(tuple(learned / hidden for learned, hidden in pairs))


def own_cost(task: CostTask) -> LearnedCost:
    """The task's own cost, as if it had been learned."""
    made = task.task()
    made.reset(seed=0)
    scene, terms = made.scene, made.cost_terms()
    control_size = int(_limits(task).size)
    whole = TaskCost.of(terms, control_size).in_scene(scene).quadratic(scene.node_count)
    D = scene.dimension
    rows = _rows(terms.chain, 2 * D)
    nothing = jnp.zeros(0)
    return LearnedCost(
        Q=whole.Q[rows[:, None], rows[None, :]],
        R=whole.R,
        goal=whole.goal[rows][:D],
        nodes=jnp.asarray(terms.chain, jnp.int32),
        kept_nodes=tuple(scene.node_name[node] for node in terms.chain),
        history=LearningHistory(nothing, nothing, nothing, nothing),
        participants=(),
    )


def known_answer(
    folder: Path,
    wanted: Sequence[Measurement[Place]],
    task: CostTask,
    lesson: Lesson,
) -> list[KnownAnswer]:
    """What there is in the folder; of costs about other nodes than the hidden one's, nothing."""
    found = []
    for one in wanted:
        path = folder / one.cell.output
        if one.where != Learned(task.name, lesson) or not path.is_file():
            continue
        learned, recorded = read_cost(path), folder / one.cell.needs[0].output
        known = one.cell.needs[0].needs
        hidden = read_cost(folder / known[0].output) if known else own_cost(task)
        if sorted(hidden.kept_nodes) == sorted(learned.kept_nodes):
            found.append(KnownAnswer(hidden, learned, _at_limit(task, recorded)))
    return found


def known_terms(answers: Sequence[KnownAnswer]) -> list[KnownTerm]:
    """Every term of the hidden cost of the first seed, by position and by velocity."""
    if not answers:
        return []
    order = answers[0].hidden.kept_nodes
    hidden = [cost_terms(_about(each.hidden, order)) for each in answers]
    learned = [cost_terms(_about(each.learned, order)) for each in answers]

    def of(costs: list[tuple[CostTerm, ...]], place: int, size: Callable) -> Figure:
        return Figure(tuple(size(terms[place]) for terms in costs))

    return [
        KnownTerm(term.name, unit, of(hidden, place, size), of(learned, place, size))
        for place, term in enumerate(hidden[0])
        for unit, size in (("1 m", _position), ("1 m/s", _velocity))
    ]


def _position(term: CostTerm) -> float:
    return term.position


def _velocity(term: CostTerm) -> float:
    return term.velocity


def _about(cost: LearnedCost, names: Sequence[str]) -> LearnedCost:
    """The same cost with its nodes in another order."""
    places = [cost.kept_nodes.index(name) for name in names]
    rows = _rows(places, 2 * cost.goal.shape[0])
    Q, nodes = cost.Q[rows[:, None], rows[None, :]], cost.nodes[np.array(places)]
    return replace(cost, Q=Q, nodes=nodes, kept_nodes=tuple(names))


def _rows(nodes: Sequence[int], part: int) -> np.ndarray:
    """Where the states of these nodes, of so many numbers each, are in a state."""
    return (part * np.asarray(nodes)[:, None] + np.arange(part)).reshape(-1)


def _limits(task: CostTask) -> np.ndarray:
    """[U] N, the largest force."""
    return cast(gymnasium.spaces.Box, task.task().action_space).high


def _at_limit(task: CostTask, measured: Path) -> float:
    """Of the runs beside a file of measurements; NaN where they are not there."""
    runs = measured.with_suffix(".h5")
    if not runs.is_file():
        return float("nan")
    force = np.concatenate([run.control for run in read_trajectories(runs)])
    return float(np.mean((np.abs(force) >= _AT_LIMIT * _limits(task)).any(axis=1)))
