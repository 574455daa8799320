"""The table of the tasks that are other people's environments."""

from collections.abc import Callable
from functools import partial

from contactgraph.cli.task_types import KnownTask, TaskFactory, TaskOptions, refuse_option
from contactgraph.envs.adapter import AdaptedTask
from contactgraph.envs.pusht import pusht_expert, pusht_explorer, pusht_fixed_start, pusht_task


def _factory(name: str, make: Callable[[], AdaptedTask], options: TaskOptions) -> TaskFactory:
    reason = "is another package's environment and takes no options"
    refuse_option(name, "--distractors", options.distractors or None, reason)
    refuse_option(name, "--objects", options.objects, reason)
    refuse_option(name, "--grasp", options.grasp, reason)
    refuse_option(name, "--goal fixed", options.fixed_seed, reason)
    return make


ADAPTED_TASKS = {
    "pusht": KnownTask(
        partial(_factory, "pusht", pusht_task),
        pusht_expert,
        pusht_fixed_start,
        pusht_fixed_start,
        pusht_explorer,
        max_force=None,
        summary="an agent pushes a T to a goal (gym-pusht; success by position, at any angle)",
        title="A contact graph that pushes a T",
    ),
}
