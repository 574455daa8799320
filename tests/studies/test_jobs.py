"""Jobs of the studies: valid command lines, an output each, and the protocol of the tests."""

from collections.abc import Callable, Iterable, Sequence

import pytest

from contactgraph.cli.main import parse
from contactgraph_studies.cost.config import COST_TASKS, FULL_COST, QUICK_COST
from contactgraph_studies.cost.jobs import cost_measurements
from contactgraph_studies.data_sets import DATA_SETS, FULL, GATE, QUICK, Source, result_measurements
from contactgraph_studies.job import Job, Measurement, in_dependency_order
from contactgraph_studies.paper import config
from contactgraph_studies.paper.jobs import measurements
from contactgraph_studies.simulated_robot import FULL_SIM, QUICK_SIM, SimulatedRobotStudy

Study = Sequence[Measurement]


def jobs_of(study: Study) -> list[Job]:
    return in_dependency_order(one.job for one in study)


def value(job: Job, option: str) -> str:
    """The value of an option."""
    return job.arguments[job.arguments.index(option) + 1]


def commands_of(jobs: Iterable[Job]) -> set[str]:
    """The commands; asserts that each accepts the options that the jobs give it."""
    checked: set[tuple[str, ...]] = set()
    for arguments in {job.arguments for job in jobs}:
        # Values differ from job to job; a wrong name of an option is the possible mistake.
        options = (arguments[0], *(word for word in arguments if word.startswith("--")))
        if options not in checked:
            checked.add(options)
            assert not isinstance(parse(list(arguments)), int), " ".join(arguments)
    return {options[0] for options in checked}


def all_of(study: Study) -> list[Job]:
    """The jobs and all that they need, those of one output several times."""
    found, waiting = [], [one.job for one in study]
    while waiting:
        found.append(waiting.pop())
        waiting += found[-1].needs
    return found


@pytest.mark.parametrize(
    ("studies", "commands"),
    [
        (
            lambda: [measurements(config.EVERY_TASK, each) for each in (config.FULL, config.QUICK)],
            {"collect", "train", "evaluate", "control"},
        ),
        (
            lambda: [cost_measurements(COST_TASKS, each) for each in (FULL_COST, QUICK_COST)],
            {"collect", "control", "learn-cost"},
        ),
        (
            lambda: [result_measurements(DATA_SETS, each) for each in (FULL, GATE, QUICK)],
            {"collect", "train", "evaluate", "control"},
        ),
        (
            lambda: [SimulatedRobotStudy(each).measurements for each in (FULL_SIM, QUICK_SIM)],
            {"robot", "train", "evaluate"},
        ),
    ],
    ids=["paper", "cost", "results", "robot"],
)
def test_every_command_line_is_one_of_ours_and_writes_files_of_its_own(
    studies: Callable[[], list[Study]], commands: set[str]
) -> None:
    for study in studies():
        assert commands_of(jobs_of(study)) == commands
        pairs = {(job.output, job.command) for job in all_of(study)}
        assert len(pairs) == len({output for output, _ in pairs})


def test_models_of_the_paper_are_tested_in_the_same_scenes_which_no_training_has_seen() -> None:
    jobs = jobs_of(measurements([config.PICKUP], config.FULL))
    tests = [job for job in jobs if "/test-" in job.output]
    assert len(tests) == len(config.PICKUP.conditions)
    closed = [job for job in jobs if job.arguments[0] == "control"]
    assert {value(job, "--seed") for job in tests + closed} == {"1000"}
    trainings = [job for job in jobs if job.arguments[0] == "train"]
    assert {value(job, "--held-out") for job in trainings} == {"0.2"}
    data = [need for job in trainings for need in job.needs]
    assert {value(need, "--seed") for need in data} == {str(seed) for seed in config.FULL.seeds}


def test_the_papers_forms_have_the_authors_distance() -> None:
    trained = [job for job in jobs_of(measurements(config.TASKS, config.QUICK)) if job.checkpoints]
    told = {
        (job.output.split("/")[1], value(job, "--contact-distance"))
        for job in trained
        if "--contact-distance" in job.arguments
    }
    assert told == {("pickup", "0.1"), ("multi-pickup", "0.2"), ("door", "0.085")}


def test_costs_are_tested_in_the_same_scenes_and_learned_from_experts_with_one_goal() -> None:
    study = cost_measurements(COST_TASKS, FULL_COST)
    seeds: dict[int, set[str]] = {}
    for one in study:
        if one.condition.source == "control":
            seeds.setdefault(one.seed, set()).add(value(one.job, "--seed"))
    assert seeds == {0: {"1100"}, 1: {"1101"}, 2: {"1102"}}
    recorded = [job for job in jobs_of(study) if job.arguments[0] == "collect"]
    assert {value(job, "--seed") for job in recorded} == {"0", "1", "2"}
    goals = {(value(job, "--goal"), value(job, "--expert")) for job in recorded}
    assert goals == {("fixed", "demo")}


def test_results_are_of_three_trainings_on_the_same_data_and_of_other_seeds() -> None:
    jobs = jobs_of(result_measurements(DATA_SETS, FULL))
    trained = [job for job in jobs if job.arguments[0] == "train"]
    assert len(trained) == 3 * len(DATA_SETS)
    assert {value(job, "--seed") for job in trained} == {"0", "1", "2"}
    assert {value(need, "--seed") for job in trained for need in job.needs} == {"0"}
    tests = [job for job in jobs if "/test-" in job.output]
    assert {value(job, "--seed") for job in tests} == {"1000"}


def test_all_controllers_of_a_row_get_the_same_scenes() -> None:
    (data,) = (each for each in DATA_SETS if each.slug == "pusht")
    found = result_measurements([data], FULL)
    for scenes in data.scenes:
        here = [one for one in found if one.condition.scenes == scenes.slug]
        closed = [one.job.arguments for one in here if one.job.arguments[0] == "control"]
        options = {arguments[2 : arguments.index("--json")] for arguments in closed}
        assert options == {(scenes.task or "pusht", "--episodes", "20", "--seed", "2000")}
        kinds = [one.condition.source for one in here]
        assert kinds.count(Source.mpc) == 3 and {Source.expert, Source.fixed_start} < set(kinds)
    models = {one.job.arguments[1] for one in found if one.condition.source is Source.mpc}
    assert models == {f"pusht/seed-{seed}/run" for seed in (0, 1, 2)}, "one model for both tasks"


def test_the_gate_repeats_trainings_of_the_full_study_without_its_baselines() -> None:
    full, small = (
        {job.fingerprint: job for job in jobs_of(result_measurements(DATA_SETS, each))}
        for each in (FULL, GATE)
    )
    others = {small[each].arguments[0] for each in small.keys() - full.keys()}
    assert others == {"collect", "evaluate", "control"}  # trajectories to test, scenes
    assert len(small) < len(full) / 2
