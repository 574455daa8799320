"""The study of costs, from what is declared to command lines."""

from command_lines import commands_of, outputs_of_several, value

from contactgraph_studies.cell import Cell, in_order
from contactgraph_studies.cost.cells import Controlled, Demonstrated, Learned, cost_measurements
from contactgraph_studies.cost.declared import COST_TASKS, FULL_COST, PICKUP_COST, QUICK_COST


def test_every_command_line_is_one_of_ours() -> None:
    cells = [one.cell for one in cost_measurements(COST_TASKS, FULL_COST)]
    assert commands_of(cells) == {"collect", "control", "learn-cost"}


def test_outputs_are_each_made_by_one_cell() -> None:
    for amounts in (FULL_COST, QUICK_COST):
        assert outputs_of_several(one.cell for one in cost_measurements(COST_TASKS, amounts)) == {}


def test_all_that_was_asked_for() -> None:
    found = cost_measurements(COST_TASKS, FULL_COST)
    of = {
        kind: [one for one in found if isinstance(one.where, kind)]
        for kind in (Learned, Controlled)
    }
    # Four numbers of demonstrations, those among distractors, those with a known answer by two
    # costs; and on pickup without the prior.
    assert len(of[Learned]) == 3 * (3 * 7 + 1)
    assert len(of[Controlled]) == 3 * (3 * 7 + 1)
    assert sum(isinstance(one.where, Demonstrated) for one in found) == 3 * 3
    told = {(str(one.where.lesson.runs), value(one.cell, "--runs")) for one in of[Learned]}
    assert told == {(runs, runs) for runs in ("5", "10", "20", "40")}
    without = {one.cell for one in of[Learned] if "--prior-weight" in one.cell.arguments}
    assert {value(cell, "--prior-weight") for cell in without} == {"0"}
    assert {cell.arguments[1] for cell in without} == {"pickup"}
    among = [one.cell for one in of[Controlled] if "--distractors" in one.cell.arguments]
    assert {value(cell, "--distractors") for cell in among} == {"5"}
    learned = [cell.needs[0] for cell in among]
    assert len(among) == 3 * 3 * 2 and len({cell.output for cell in learned}) == 3 * 3 * 2
    quick = cost_measurements(COST_TASKS, QUICK_COST)
    assert {one.seed for one in quick} == {0}
    assert {one.where.lesson.runs for one in quick if isinstance(one.where, Learned)} == {5, 40}


def test_demonstrations_have_one_goal_unless_a_known_cost_makes_them() -> None:
    cells = in_order(one.cell for one in cost_measurements([PICKUP_COST], FULL_COST))

    def command(output: str) -> str:
        return next(cell.command for cell in cells if cell.output == output)

    expert = "contactgraph collect pickup --goal fixed --expert demo --episodes 40 --seed 1"
    assert command("cells/pickup/seed-1/expert.h5").startswith(f"{expert} --out ")
    among = command("cells/pickup/seed-1/expert-among-5.h5")
    assert among.startswith(f"{expert} --distractors 5 ")
    own = command("cells/pickup/seed-1/own-cost.json")
    assert own.startswith("contactgraph control pickup pickup --episodes 40 --seed 1 --json ")
    assert own.endswith(" --save cells/pickup/seed-1/own-cost.h5")
    assert command("cells/pickup/seed-1/own-cost-40/cost.json").startswith(
        "contactgraph learn-cost pickup cells/pickup/seed-1/own-cost.h5 --runs 40 "
    )
    again = command("cells/pickup/seed-1/learned-cost.json")
    hidden = "cells/pickup/seed-1/expert-40/cost.json"
    begun = f"contactgraph control pickup pickup --cost {hidden} --horizon 20 --episodes 40 "
    assert again.startswith(begun)
    made = next(cell for cell in cells if cell.output.endswith("seed-1/learned-cost.json"))
    assert [cell.output for cell in made.needs] == [hidden]


def test_test_scenes_are_the_same_for_every_cost_and_other_ones_for_every_seed() -> None:
    found = cost_measurements(COST_TASKS, FULL_COST)
    seeds: dict[int, set[str]] = {}
    for one in found:
        if isinstance(one.where, Controlled):
            seeds.setdefault(one.seed, set()).add(value(one.cell, "--seed"))
    assert seeds == {0: {"1100"}, 1: {"1101"}, 2: {"1102"}}
    cells = in_order(one.cell for one in found)
    assert {value(cell, "--seed") for cell in cells if _demonstrates(cell)} == {"0", "1", "2"}


def _demonstrates(cell: Cell) -> bool:
    return "--seed" in cell.arguments and value(cell, "--episodes") == "40"
