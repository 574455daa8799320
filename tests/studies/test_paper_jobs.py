"""Jobs of the study of models: valid command lines, and none is missing."""

from command_lines import commands_of, conflicting_outputs, value

from contactgraph_studies.job import in_dependency_order
from contactgraph_studies.paper.config import (
    EVERY_TASK,
    FAMILIES,
    FAULTS,
    FRANKA,
    FULL,
    PICKUP,
    QUICK,
    TASKS,
)
from contactgraph_studies.paper.jobs import Source, measurements


def test_every_command_line_is_one_of_ours() -> None:
    jobs = [one.job for one in measurements(EVERY_TASK, FULL)]
    assert commands_of(jobs) == {"collect", "train", "evaluate", "control"}


def test_outputs_are_each_made_by_one_cell() -> None:
    for amounts in (FULL, QUICK):
        assert conflicting_outputs(one.job for one in measurements(EVERY_TASK, amounts)) == {}


def test_all_measurements() -> None:
    found = measurements(TASKS, FULL)
    of = {source: [one for one in found if one.condition.source is source] for source in Source}
    seeds = len(FULL.seeds)
    conditions = seeds * sum(len(task.conditions) for task in TASKS)
    models = [model for family in FAMILIES for model in family.models]
    for source in (Source.recorded, Source.planned):
        assert len(of[source]) == len(models) * conditions
    assert len(of[Source.every_step]) == len(FAMILIES) * conditions
    assert len(of[Source.faults]) == seeds * len(FAMILIES) * len(TASKS) * len(FAULTS)
    assert len(of[Source.samples]) == seeds * 3 * 2 * 2 * len(FULL.sample_sizes)
    trainings = [
        job for job in in_dependency_order(one.job for one in found) if job.arguments[0] == "train"
    ]
    # Of the samples, 40 trajectories are GIM-Temp's own, 160 pickup's augmented ones.
    assert len(trainings) == seeds * 3 * len(models) + seeds * (3 * 2 * 6 - 6)
    assert all(value(job, "--held-out") == "0.2" for job in trainings)
    data = {value(need, "--episodes") for job in trainings for need in job.needs}
    assert "50" in data, "40 to learn from, and 10 held out"


def test_the_papers_forms_have_the_authors_distance() -> None:
    found = measurements(TASKS, QUICK)
    trained = [job for job in in_dependency_order(one.job for one in found) if job.checkpoints]
    told = {
        (job.output.split("/")[1], value(job, "--contact-distance"))
        for job in trained
        if "--contact-distance" in job.arguments
    }
    assert told == {("pickup", "0.1"), ("multi-pickup", "0.2"), ("door", "0.085")}
    assert not [
        one
        for one in trained
        if "gim-temp-40" in one.output and value(one, "--model") == "paper-literal"
    ]


def test_test_scenes_are_the_same_for_every_model_and_seed() -> None:
    jobs = in_dependency_order(one.job for one in measurements([PICKUP], FULL))
    tests = [job for job in jobs if "/test-" in job.output]
    assert len(tests) == len(PICKUP.conditions)
    assert all("--seed 1000" in job.command for job in tests)


def test_half_a_second_and_an_episode_have_other_numbers_of_steps_with_an_arm() -> None:
    found = measurements([FRANKA], QUICK)
    jobs = in_dependency_order(one.job for one in found)

    def options(source: Source, option: str) -> set[str]:
        return {value(one.job, option) for one in found if one.condition.source is source}

    assert options(Source.planned, "--replan-every") == {"50"}
    assert options(Source.planned, "--horizon") == {"100"}
    trained = [job for job in jobs if job.arguments[0] == "train"]
    models = [value(job, "--model") for job in trained]
    assert models == ["gim-temp", "gim-non-temp", "no-gim"], "those that the paper compares"
    assert not [one for one in found if one.condition.source in (Source.growth, Source.long_plan)]
    runs = {value(job, "--episodes") for job in trained[0].needs}
    assert runs == {"250"}
