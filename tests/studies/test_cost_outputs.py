"""Claim, tables, charts of the study of costs, from made-up numbers."""

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from made_up import Change, cost_results

from contactgraph.control import write_cost
from contactgraph.data import Scene, Trajectory, write_trajectories
from contactgraph_studies.cost.config import (
    COST_TASKS,
    FULL_COST,
    CostTest,
    by_demonstrations,
    known_answer,
)
from contactgraph_studies.cost.jobs import cost_measurements
from contactgraph_studies.cost.known_answer import (
    KnownAnswer,
    known_answer_terms,
    own_cost,
    read_answers,
)
from contactgraph_studies.cost.study import CostStudy, cost_table, transfers
from contactgraph_studies.paper.config import DOOR, MULTI_PICKUP, PICKUP

RATIO = "learned over hidden"
FEWEST, *_, MOST = by_demonstrations(FULL_COST)


@pytest.mark.parametrize(
    ("change", "task", "test", "holds"),
    [
        (None, "", MOST, True),
        ({"success_rate": 0.98}, "pickup", MOST, True),
        (lambda seed: {"success_rate": 0.98 if seed else 0.97}, "pickup", MOST, False),
        ({"success_rate": 0.5}, "door", MOST, True),
        ({"success_rate": 0.5}, "pickup", FEWEST, True),
    ],
)
def test_the_claim_is_about_all_episodes_of_pickup_and_the_most_demonstrations(
    change: Change | None, task: str, test: CostTest, holds: bool
) -> None:
    found = transfers(cost_results(change, task, test), COST_TASKS, FULL_COST)
    assert (found.number, found.holds) == (8, holds)
    json.dumps(found.to_json(), allow_nan=False)


def test_the_table_has_a_row_for_each_cost() -> None:
    measured = cost_results(lambda seed: {"success_rate": 1.0 - seed / 100}, "pickup")
    table = cost_table(measured, COST_TASKS, FULL_COST)
    assert len(table.rows) == 3 * 9 + 1
    read = list(csv.DictReader(io.StringIO(table.csv())))
    first, own = read[3], read[9]
    assert (first["successes"], first["episodes"], first["seeds"]) == ("297", "300", "3")
    assert float(first["interval_low"]) == pytest.approx(0.971, abs=5e-4)
    ends = [first[f"success_percent_{end}"] for end in ("median", "low", "high")]
    assert (*ends, first["learning_s_median"]) == ("99.0", "98.0", "100.0", "30.0")
    assert first["contact_speed_m_s_median"] == "1.5"
    assert (first["demonstrations"], own["demonstrations"]) == ("40", "")
    assert own["command_control"].startswith("contactgraph control pickup pickup --episodes 40 ")


def test_the_known_answer_is_known_up_to_scale() -> None:
    own = own_cost(PICKUP)
    same = replace(own, Q=7.0 * own.Q, R=7.0 * own.R)
    half = replace(own, Q=3.5 * own.Q, R=7.0 * own.R)
    terms = known_answer_terms(own, [KnownAnswer(same, 0.06), KnownAnswer(half, 0.07)])
    assert [(term["Term"], term["Off by"]) for term in terms] == [
        ("gripper - target", "1 m"),
        ("gripper - target", "1 m/s"),
        ("target - goal", "1 m"),
        ("target - goal", "1 m/s"),
    ]
    # Roots of the paper's weights over that of the force: 3, 0.2, 50 and 1 over 0.01.
    weights = [300**0.5, 20**0.5, 5000**0.5, 10.0]
    assert [term["hidden, N"].median for term in terms] == pytest.approx(weights)
    for term in terms:
        assert term[RATIO].values == pytest.approx((1.0, 0.5**0.5))
    assert known_answer_terms(own, []) == []


def test_costs_of_several_objects_are_compared_in_the_hidden_ones_order() -> None:
    own = own_cost(MULTI_PICKUP)
    assert own.kept_nodes == ("gripper", "target-1", "target-2")
    # The same cost, as a learner writes it that saw the second target touched first.
    order = np.array([0, 1, 2, 3, 8, 9, 10, 11, 4, 5, 6, 7])
    turned = replace(
        own,
        Q=own.Q[order][:, order],
        nodes=own.nodes[np.array([0, 2, 1])],
        kept_nodes=("gripper", "target-2", "target-1"),
    )
    terms = known_answer_terms(own, [KnownAnswer(turned, 0.0)])
    assert [term["Term"] for term in terms[::2]] == [
        "gripper - target-1",
        "target-1 - target-2",
        "target-2 - goal",
    ]
    assert [term[RATIO].median for term in terms] == pytest.approx([1.0] * 6)


def test_known_answers_are_those_whose_files_are_there(tmp_path: Path) -> None:
    own = replace(own_cost(DOOR), imitation_loss=jnp.ones(1))
    wanted = cost_measurements([DOOR], FULL_COST)
    learned = known_answer(FULL_COST)
    other = replace(own, Q=2.0 * own.Q)
    for seed, made, cost in ((0, learned, own), (1, learned, other), (1, MOST.learned, own)):
        path = tmp_path / "cells" / "door" / f"seed-{seed}" / made.slug / "cost.json"
        path.parent.mkdir(parents=True)
        write_cost(path, cost)
    force = np.array([[10.0, 0.0], [1.0, -10.0], [9.0, 9.0], [0.0, 0.0]])
    run = Trajectory(
        scene=Scene(("gripper",), ("gripper",), np.array([True]), dt=0.05),
        position=np.zeros((5, 1, 2)),
        velocity=np.zeros((5, 1, 2)),
        control=force,
    )
    write_trajectories(tmp_path / "cells" / "door" / "seed-0" / "own-cost.h5", [run])
    assert DOOR.spec.max_force == 10.0
    answers = read_answers(tmp_path, wanted, DOOR, learned)
    assert [each.at_limit for each in answers] == pytest.approx([0.5, np.nan], nan_ok=True)
    found = known_answer_terms(own, answers)[0][RATIO].values
    assert found == pytest.approx((1.0, 2.0**0.5))


def test_a_study_without_measurements(tmp_path: Path) -> None:
    found = CostStudy(COST_TASKS, FULL_COST).result(tmp_path)
    assert [claim.holds for claim in found.claims] == [None]
    assert found.readings == []
    assert "| pickup | expert | 40 | 0 | not known |" in found.tables[0].markdown()
