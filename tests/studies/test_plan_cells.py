"""From what is declared to command lines: each is one that the commands take, and all are there."""

from command_lines import commands_of, outputs_of_several, value

from contactgraph_studies.cell import in_order
from contactgraph_studies.declared import (
    EVERY_TASK,
    FAULTS,
    FRANKA,
    FULL,
    MODELS,
    PICKUP,
    QUICK,
    TASKS,
)
from contactgraph_studies.plan_cells import Source, measurements


def test_every_command_line_is_one_of_ours() -> None:
    cells = [one.cell for one in measurements(EVERY_TASK, FULL)]
    assert commands_of(cells) == {"collect", "train", "evaluate", "control"}


def test_outputs_are_each_made_by_one_cell() -> None:
    for amounts in (FULL, QUICK):
        assert outputs_of_several(one.cell for one in measurements(EVERY_TASK, amounts)) == {}


def test_all_that_was_asked_for() -> None:
    found = measurements(TASKS, FULL)
    of = {source: [one for one in found if one.where.source is source] for source in Source}
    conditions = sum(len(task.conditions) for task in TASKS)
    assert len(of[Source.recorded]) == len(of[Source.planned]) == 3 * len(MODELS) * conditions
    assert len(of[Source.every_step]) == 3 * conditions
    assert len(of[Source.faults]) == 3 * len(TASKS) * len(FAULTS)
    assert len(of[Source.samples]) == 3 * 2 * 2 * 2 * len(FULL.sample_sizes)
    trainings = [
        cell for cell in in_order(one.cell for one in found) if cell.arguments[0] == "train"
    ]
    # 7 models a task; of the samples, 40 runs are GIM-Temp's own, 160 pickup's augmented ones.
    assert len(trainings) == 3 * (3 * 8 + 2 * 2 * 6 - 3)


def test_test_scenes_are_the_same_for_every_model_and_seed() -> None:
    cells = in_order(one.cell for one in measurements([PICKUP], FULL))
    tests = [cell for cell in cells if "/test-" in cell.output]
    assert len(tests) == len(PICKUP.conditions)
    assert all("--seed 1000" in cell.command for cell in tests)


def test_half_a_second_and_a_run_are_other_numbers_of_steps_with_an_arm() -> None:
    found = measurements([FRANKA], QUICK)
    cells = in_order(one.cell for one in found)

    def options(source: Source, option: str) -> set[str]:
        return {value(one.cell, option) for one in found if one.where.source is source}

    assert options(Source.planned, "--replan-every") == {"50"}
    assert options(Source.planned, "--horizon") == {"100"}
    trained = [cell for cell in cells if cell.arguments[0] == "train"]
    models = [value(cell, "--model") for cell in trained]
    assert models == ["gim-temp", "gim-non-temp", "no-gim"], "those that the paper compares"
    assert not [one for one in found if one.where.source in (Source.growth, Source.long_plan)]
    runs = {value(cell, "--episodes") for cell in trained[0].needs}
    assert runs == {"200"}
