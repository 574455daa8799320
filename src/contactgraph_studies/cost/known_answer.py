"""Costs learned from a controller whose cost is known, compared with that cost."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import gymnasium
import jax.numpy as jnp
import numpy as np

from contactgraph.control import LearnedCost, cost_terms, read_cost
from contactgraph.data import read_trajectories
from contactgraph.policies import TaskCost
from contactgraph_studies.cost.config import CostAmounts, CostCondition, known_answer
from contactgraph_studies.cost.jobs import learning
from contactgraph_studies.job import Measurement
from contactgraph_studies.paper.config import StudyTask
from contactgraph_studies.results import SeedStatistic
from contactgraph_studies.tables import StudyTable

_AT_LIMIT = 0.999


class KnownAnswer(NamedTuple):
    """What one seed's runs of a controller with a known cost tell of it."""

    learned: LearnedCost
    at_limit: float
    """Fraction of steps with a saturated force; NaN if the trajectories are missing."""


def own_cost(task: StudyTask) -> LearnedCost:
    """The task's own cost in the form of a learned one."""
    made = task.spec.make()
    made.reset(seed=0)
    scene, terms = made.scene, made.cost_terms()
    control_size = cast(gymnasium.spaces.Box, made.action_space).shape[0]
    whole = TaskCost(terms, control_size).in_scene(scene).quadratic(scene.node_count)
    D = scene.dimension
    rows = _state_rows(terms.chain, 2 * D)
    return LearnedCost(
        Q=whole.Q[rows[:, None], rows[None, :]],
        R=whole.R,
        goal=whole.goal[rows][:D],
        nodes=jnp.asarray(terms.chain, jnp.int32),
        kept_nodes=tuple(scene.node_name[node] for node in terms.chain),
        imitation_loss=jnp.zeros(0),
        task_nodes=(),
    )


def read_answers(
    folder: Path, measurements: Sequence[Measurement], task: StudyTask, learned: CostCondition
) -> list[KnownAnswer]:
    """Those whose files are in the folder and about the nodes of the task's own cost."""
    answers, nodes = [], sorted(own_cost(task).kept_nodes)
    for one in measurements:
        path = folder / one.job.output
        if one.condition == learning(task, learned) and path.is_file():
            cost, demonstrations = read_cost(path), folder / one.job.needs[0].output
            if sorted(cost.kept_nodes) == nodes:
                at_limit = _at_limit(task, demonstrations.with_suffix(".h5"))
                answers.append(KnownAnswer(cost, at_limit))
    return answers


def known_answer_terms(hidden: LearnedCost, answers: Sequence[KnownAnswer]) -> list[dict[str, Any]]:
    """The terms of the hidden cost, each as the force, N, that costs as much as being off by one
    unit of position or velocity."""
    learned = [cost_terms(_reordered(each.learned, hidden.kept_nodes)) for each in answers]
    at_limit = SeedStatistic(tuple(100.0 * each.at_limit for each in answers))
    rows = []
    for index, term in enumerate(cost_terms(hidden) if answers else ()):
        for unit, part in (("1 m", "position"), ("1 m/s", "velocity")):
            known = getattr(term, part)
            found = tuple(getattr(terms[index], part) for terms in learned)
            rows.append(
                {
                    "Term": term.name,
                    "Off by": unit,
                    "hidden, N": SeedStatistic((known,)),
                    "learned, N": SeedStatistic(found),
                    "learned over hidden": SeedStatistic(tuple(each / known for each in found)),
                    "steps with a saturated force, %": at_limit,
                }
            )
    return rows


def known_answer_table(
    folder: Path,
    measurements: Sequence[Measurement],
    tasks: Sequence[StudyTask],
    amounts: CostAmounts,
) -> StudyTable:
    """Hidden and learned costs, term by term."""
    learned = known_answer(amounts)
    names = (
        *("Task", "Demonstrated by", "Term", "Off by", "hidden, N", "learned, N"),
        *("learned over hidden", "steps with a saturated force, %"),
    )
    return StudyTable(
        title="A known answer",
        caption="Costs learned from runs of MPC with a known cost, beside that cost. Each term "
        "is given as the force that costs as much as being off by one unit for one step; a factor "
        "on the whole cost, which no run can show, cancels. Median of the seeds, with their range. "
        "LQR knows no limit of the force, so steps with a saturated force mislead it.",
        headings={name: name for name in names},
        rows=[
            {"Task": task.name, "Demonstrated by": learned.name, **terms}
            for task in tasks
            for terms in known_answer_terms(
                own_cost(task), read_answers(folder, measurements, task, learned)
            )
        ],
    )


def _reordered(cost: LearnedCost, names: Sequence[str]) -> LearnedCost:
    """The same cost with its nodes in another order."""
    order = [cost.kept_nodes.index(name) for name in names]
    rows = _state_rows(order, 2 * cost.goal.shape[0])
    Q, nodes = cost.Q[rows[:, None], rows[None, :]], cost.nodes[np.array(order)]
    return replace(cost, Q=Q, nodes=nodes, kept_nodes=tuple(names))


def _state_rows(nodes: Sequence[int], size: int) -> np.ndarray:
    """Indices of the nodes' states, ``size`` numbers each, in a flat state."""
    return (size * np.asarray(nodes)[:, None] + np.arange(size)).reshape(-1)


def _at_limit(task: StudyTask, trajectories: Path) -> float:
    if not trajectories.is_file() or task.spec.max_force is None:
        return float("nan")
    force = np.concatenate([one.control for one in read_trajectories(trajectories)])
    return float(np.mean((np.abs(force) >= _AT_LIMIT * task.spec.max_force).any(axis=1)))
