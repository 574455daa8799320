"""Costs learned from runs whose cost is known, beside that cost."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from contactgraph.control import CostTerm, LearnedCost, LearningHistory, cost_terms, read_cost
from contactgraph.evaluate import TaskCost
from contactgraph.reproduce.cost.cells import Learned, Place
from contactgraph.reproduce.cost.declared import CostAmounts, CostTask, known_answer
from contactgraph.reproduce.measurement import Measurement
from contactgraph.reproduce.page_table import PageTable, TableRow
from contactgraph.reproduce.results import Figure
from contactgraph.reproduce.words import short, with_range


@dataclass(frozen=True)
class KnownTerm:
    """What it costs to be off by one unit in one of a cost's terms, as a force: `CostTerm`."""

    task: str
    name: str
    unit: str
    """Of being off."""
    own: float
    """N, by the task's own cost."""
    learned: Figure
    """N, by the cost learned from each seed's runs."""

    @property
    def ratio(self) -> Figure:
        """Learned over own; 1 is the known answer."""
        return Figure(tuple(value / self.own for value in self.learned.values))


def own_cost(task: CostTask, kept_nodes: Sequence[str]) -> LearnedCost:
    """The task's own cost, about nodes of these names, as if it had been learned."""
    made = task.task()
    made.reset(seed=0)
    scene, terms = made.scene, made.cost_terms()
    assert scene.goal is not None and made.action_space.shape is not None
    whole = TaskCost.of(terms, made.action_space.shape[0]).in_scene(scene)
    cost = whole.quadratic(scene.node_count)
    nodes = np.array([scene.node_name.index(name) for name in kept_nodes])
    part = 2 * scene.dimension
    rows = (part * nodes[:, None] + np.arange(part)).reshape(-1)
    nothing = jnp.zeros(0)
    return LearnedCost(
        Q=cost.Q[rows[:, None], rows[None, :]],
        R=cost.R,
        goal=jnp.asarray(scene.goal),
        nodes=jnp.asarray(nodes, jnp.int32),
        kept_nodes=tuple(kept_nodes),
        history=LearningHistory(nothing, nothing, nothing, nothing),
        participants=(),
    )


def known_costs(
    folder: Path,
    wanted: Sequence[Measurement[Place]],
    task: CostTask,
    amounts: CostAmounts,
) -> list[LearnedCost]:
    """Of every seed whose cell is there."""
    where = Learned(task.name, known_answer(amounts).lesson)
    paths = [folder / one.cell.output for one in wanted if one.where == where]
    return [read_cost(path) for path in paths if path.is_file()]


def known_terms(task: CostTask, learned: Sequence[LearnedCost]) -> list[KnownTerm]:
    """Every term of the task's cost, by position and by velocity; none where nothing was learned.

    Costs of other nodes, or of the same in another order, than the first seed's are left out: they
    have other terms.
    """
    if not learned:
        return []
    kept = learned[0].kept_nodes
    own = cost_terms(own_cost(task, kept))
    found = [cost_terms(cost) for cost in learned if cost.kept_nodes == kept]
    return [
        KnownTerm(
            task.name, term.name, unit, size(term), Figure(tuple(size(f[place]) for f in found))
        )
        for place, term in enumerate(own)
        for unit, size in (("1 m", _position), ("1 m/s", _velocity))
    ]


def _position(term: CostTerm) -> float:
    return term.position


def _velocity(term: CostTerm) -> float:
    return term.velocity


def known_table(terms: Sequence[KnownTerm]) -> PageTable:
    """For the study's page."""
    return PageTable(
        slug="known-answer",
        title="A known answer",
        caption="Costs learned from runs of MPC with the task's own cost, beside that cost. "
        "What it costs to be off for one step, as the force that costs as much: a factor on the "
        "whole cost, which no run tells, drops out. Median of the seeds, with their range.",
        heads=("Task", "Term", "Off by", "own, N", "learned, N", "learned over own"),
        rows=[
            TableRow(
                (term.task, term.name, term.unit),
                (short(term.own), with_range(term.learned), with_range(term.ratio)),
            )
            for term in terms
        ],
    )
