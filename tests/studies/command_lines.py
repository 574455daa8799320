"""Checks of the command lines of a study's jobs."""

from collections.abc import Iterable

from contactgraph.cli.main import parse
from contactgraph_studies.job import Job, in_dependency_order


def commands_of(jobs: Iterable[Job]) -> set[str]:
    """The commands; asserts that each accepts the options that the jobs give it."""
    checked: set[tuple[str, ...]] = set()
    for arguments in {job.arguments for job in in_dependency_order(jobs)}:
        # Values differ from job to job; a wrong name of an option is the possible mistake.
        options = (arguments[0], *(word for word in arguments if word.startswith("--")))
        if options not in checked:
            checked.add(options)
            assert not isinstance(parse(list(arguments)), int), " ".join(arguments)
    return {options[0] for options in checked}


def conflicting_outputs(jobs: Iterable[Job]) -> dict[str, set[str]]:
    """Outputs that more than one command line writes."""
    commands: dict[str, set[str]] = {}
    waiting = list(jobs)
    while waiting:
        job = waiting.pop()
        commands.setdefault(job.output, set()).add(job.command)
        waiting += job.needs
    return {output: each for output, each in commands.items() if len(each) > 1}


def value(job: Job, option: str) -> str:
    """The value of an option."""
    return job.arguments[job.arguments.index(option) + 1]
