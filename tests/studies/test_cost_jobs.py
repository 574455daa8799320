"""Jobs of the study of learned costs."""

from command_lines import commands_of, conflicting_outputs, value

from contactgraph_studies.cost.config import COST_TASKS, FULL_COST, QUICK_COST
from contactgraph_studies.cost.jobs import cost_measurements
from contactgraph_studies.job import Job, in_dependency_order
from contactgraph_studies.paper.config import PICKUP


def test_every_command_line_is_one_of_ours() -> None:
    jobs = [one.job for one in cost_measurements(COST_TASKS, FULL_COST)]
    assert commands_of(jobs) == {"collect", "control", "learn-cost"}


def test_outputs_are_each_made_by_one_cell() -> None:
    for amounts in (FULL_COST, QUICK_COST):
        assert conflicting_outputs(one.job for one in cost_measurements(COST_TASKS, amounts)) == {}


def test_all_measurements() -> None:
    found = cost_measurements(COST_TASKS, FULL_COST)
    of = {
        source: [one for one in found if one.condition.source == source]
        for source in ("learning", "control")
    }
    # Four numbers of demonstrations, two tests among distractors, two known answers of which one is
    # tested; without contacts; and on pickup without the prior.
    assert len(of["learning"]) == 3 * (3 * 8 + 1)
    assert len(of["control"]) == 3 * (3 * 8 + 1)
    as_far = {one.job for one in of["control"] if "--horizon" in one.job.arguments}
    assert {value(job, "--horizon") for job in as_far} == {"20"}
    assert all("--without-contacts" in job.needs[0].arguments for job in as_far)
    assert len(as_far) == 3 * 3
    assert len(found) - sum(map(len, of.values())) == 3 * 3, "with the task's own cost"
    learned = {(one.condition.demonstrations, value(one.job, "--runs")) for one in of["learning"]}
    assert learned == {(5, "5"), (10, "10"), (20, "20"), (40, "40")}
    without = {one.job for one in of["learning"] if "--prior-weight" in one.job.arguments}
    assert {value(job, "--prior-weight") for job in without} == {"0"}
    assert {job.arguments[1] for job in without} == {"pickup"}
    among = [one.job for one in of["control"] if "--distractors" in one.job.arguments]
    assert {value(job, "--distractors") for job in among} == {"5"}
    assert len(among) == len({job.needs[0].output for job in among}) == 3 * 3 * 2
    quick = cost_measurements(COST_TASKS, QUICK_COST)
    assert {one.seed for one in quick} == {0}
    counts = {one.condition.demonstrations for one in quick if one.condition.source == "learning"}
    assert counts == {5, 40}


def test_demonstrations_have_one_goal_unless_a_known_cost_makes_them() -> None:
    jobs = in_dependency_order(one.job for one in cost_measurements([PICKUP], FULL_COST))

    def command(output: str) -> str:
        return next(job.command for job in jobs if job.output == output)

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
    made = next(job for job in jobs if job.output.endswith("seed-1/learned-cost.json"))
    assert [job.output for job in made.needs] == [hidden]


def test_test_scenes_are_the_same_for_every_cost_and_other_ones_for_every_seed() -> None:
    found = cost_measurements(COST_TASKS, FULL_COST)
    seeds: dict[int, set[str]] = {}
    for one in found:
        if one.condition.source == "control":
            seeds.setdefault(one.seed, set()).add(value(one.job, "--seed"))
    assert seeds == {0: {"1100"}, 1: {"1101"}, 2: {"1102"}}
    jobs = in_dependency_order(one.job for one in found)
    assert {value(job, "--seed") for job in jobs if _demonstrates(job)} == {"0", "1", "2"}


def _demonstrates(job: Job) -> bool:
    return "--seed" in job.arguments and value(job, "--episodes") == "40"
