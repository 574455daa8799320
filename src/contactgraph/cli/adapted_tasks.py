"""The table of the tasks that are other people's environments."""

from dataclasses import replace
from functools import partial

from contactgraph.cli.task_types import KnownTask
from contactgraph.envs import fetch
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
    title="A contact graph that pushes a T",
)

ADAPTED_TASKS = {
    "pusht": _PUSHT,
    "pusht-pose": replace(
        _PUSHT,
        make=pusht_pose_task,
        summary="as pusht, with its own success: the T covers 95 % of its outline at the goal",
        title="A contact graph that pushes a T to a pose",
    ),
    "fetch-push": KnownTask(
        partial(fetch.fetch_task, "fetch-push"),
        fetch.push_expert,
        fetch.push_fixed_start,
        fetch.push_fixed_start,
        fetch.push_explorer,
        horizon=30,
        starts=64,
        max_force=fetch.MAX_DISPLACEMENT,
        summary="an arm pushes a block to a goal (gymnasium-robotics, MuJoCo)",
        title="A contact graph that pushes a block with an arm",
    ),
    "fetch-slide": KnownTask(
        partial(fetch.fetch_task, "fetch-slide"),
        fetch.slide_expert,
        fetch.slide_fixed_start,
        fetch.slide_fixed_start,
        fetch.slide_explorer,
        horizon=30,
        starts=64,
        max_force=fetch.MAX_DISPLACEMENT,
        summary="an arm strikes a puck that slides to a goal beyond its reach (MuJoCo)",
        title="A contact graph that strikes a puck",
    ),
    "fetch-pick-and-place": KnownTask(
        partial(fetch.fetch_task, "fetch-pick-and-place"),
        fetch.pick_expert,
        fetch.pick_fixed_start,
        fetch.pick_fixed_start,
        fetch.pick_explorer,
        horizon=30,
        starts=64,
        max_force=None,
        summary="an arm grasps a block, lifts it and takes it to a goal in the air (MuJoCo)",
        title="A contact graph that grasps with fingers",
    ),
}
