"""The table of the tasks that are other people's environments."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from contactgraph.cli.task_types import KnownTask
from contactgraph.envs import fetch
from contactgraph.envs.contract import Policy
from contactgraph.envs.pusht import (
    pusht_expert,
    pusht_explorer,
    pusht_fixed_start,
    pusht_pose_task,
    pusht_task,
)

_PUSHT = KnownTask(
    pusht_task,
    pusht_expert,
    pusht_fixed_start,
    pusht_fixed_start,
    pusht_explorer,
    horizon=30,
    starts=64,
    max_force=None,
    summary="an agent pushes a T to a goal (gym-pusht; success by position, at any angle)",
)


def _fetch(
    name: str, policies: Sequence[Callable[[], Policy]], max_force: float | None, summary: str
) -> KnownTask:
    """``policies``: expert, fixed start and explorer."""
    expert, fixed_start, explorer = policies
    return KnownTask(
        partial(fetch.fetch_task, name),
        expert,
        fixed_start,
        fixed_start,
        explorer,
        horizon=30,
        starts=64,
        max_force=max_force,
        summary=summary,
    )


ADAPTED_TASKS = {
    "pusht": _PUSHT,
    "pusht-pose": replace(
        _PUSHT,
        make=pusht_pose_task,
        summary="as pusht, with its own success: the T covers 95 % of its outline at the goal",
    ),
    "fetch-push": _fetch(
        "fetch-push",
        (fetch.push_expert, fetch.push_fixed_start, fetch.push_explorer),
        fetch.MAX_DISPLACEMENT,
        "an arm pushes a block to a goal (gymnasium-robotics, MuJoCo)",
    ),
    "fetch-slide": _fetch(
        "fetch-slide",
        (fetch.slide_expert, fetch.slide_fixed_start, fetch.slide_explorer),
        fetch.MAX_DISPLACEMENT,
        "an arm strikes a puck that slides to a goal beyond its reach (MuJoCo)",
    ),
    "fetch-pick-and-place": _fetch(
        "fetch-pick-and-place",
        (fetch.pick_expert, fetch.pick_fixed_start, fetch.pick_explorer),
        None,
        "an arm grasps a block, lifts it and takes it to a goal in the air (MuJoCo)",
    ),
}
