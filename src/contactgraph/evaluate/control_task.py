"""A model in closed loop with a task, episode after episode."""

from collections.abc import Callable
from typing import cast

import gymnasium
import jax.numpy as jnp
import numpy as np

from contactgraph.control import ILQR, MPC, ControlLimits
from contactgraph.data import InvalidInputError, Trajectory
from contactgraph.envs.collect import episode_seeds
from contactgraph.envs.contract import Task
from contactgraph.envs.run_episode import run_episode
from contactgraph.evaluate.closed_loop import ClosedLoopMetrics, closed_loop_metrics
from contactgraph.evaluate.control_policy import EpisodeRecord, MPCPolicy
from contactgraph.evaluate.found_contacts import FoundContacts, found_contacts
from contactgraph.evaluate.observation_noise import ObservationNoise
from contactgraph.evaluate.planned_error import PlannedError, planned_error
from contactgraph.evaluate.scene_cost import SceneCost, TaskCost
from contactgraph.evaluate.sensor_faults import SensorFaults
from contactgraph.model import ContactSensor, MotionNoise, StepModel
from contactgraph.model.model_fit import check_fit

_EXACT = SensorFaults()
_CLEAR = ObservationNoise()


def control_task(
    model: StepModel,
    task_factory: Callable[[], Task],
    episodes: int,
    seed: int,
    *,
    cost: SceneCost | None = None,
    horizon: int = 20,
    iterations: int = 5,
    replan_every: int = 1,
    deadline: float | None = None,
    sensor: ContactSensor | None = None,
    faults: SensorFaults = _EXACT,
    measured: bool = True,
    noise: ObservationNoise = _CLEAR,
    motion_noise: MotionNoise | None = None,
    node_capacity: int = 0,
    on_episode: Callable[[Trajectory, EpisodeRecord], None] | None = None,
) -> tuple[ClosedLoopMetrics, list[Trajectory]]:
    """Runs ``episodes`` episodes under `MPC` with this model, and measures them.

    ``cost`` None is the task's own; the force limits are its action space's. Episode ``i`` has the
    seed `collect` would give it. ``horizon``, ``iterations`` and ``replan_every`` are `ILQR`'s
    and `MPC`'s, ``deadline`` is in seconds; ``node_capacity`` is `MPCPolicy`'s. ``on_episode`` is
    called after each episode with what was done and what the controller thought.

    ``faults`` spoils the contacts that the controller observes, and ``measured=False`` keeps all
    of them from it; the recorded episodes keep the truth. ``sensor`` is what the correction is
    told of error rates, by default those of ``faults``. ``motion_noise`` is `MPC`'s: with it,
    beliefs are corrected by the motion observed, too, on which there is ``noise``.

    Raises `InvalidInputError` where model and task do not fit, the task has no goal, or a number
    is out of range.
    """
    seeds = episode_seeds(episodes, seed)
    task = task_factory()
    # The scene, and with it the cost's chain, is known once an episode has begun.
    task.reset(seed=seeds[0])
    box = cast(gymnasium.spaces.Box, task.action_space)
    control_size = int(np.prod(box.shape))
    check_fit(model, task.scene, control_size, "the task")
    terms = task.cost_terms()
    limits = ControlLimits(jnp.asarray(box.low), jnp.asarray(box.high))
    ilqr = ILQR(horizon=horizon, iterations=iterations, limits=limits)
    mpc = MPC(
        model,
        ilqr,
        sensor or faults.sensor,
        replan_every,
        deadline,
        motion_noise=motion_noise,
    )
    wanted = TaskCost.of(terms, control_size) if cost is None else cost
    _check_cost(wanted, task, control_size)
    policy = MPCPolicy(mpc, wanted, node_capacity, faults, measured, noise)

    runs: list[Trajectory] = []
    succeeded: list[bool] = []
    plan_ms: list[np.ndarray] = []
    planned, found = PlannedError(), FoundContacts()
    for episode_seed in seeds:
        runs.append(run_episode(task, policy, episode_seed))
        succeeded.append(task.success())
        record = policy.record()
        plan_ms.append(record.plan_ms)
        planned += planned_error(runs[-1], record)
        found += found_contacts(runs[-1], record.found)
        if on_episode is not None:
            on_episode(runs[-1], record)
    metrics = closed_loop_metrics(
        runs, succeeded, terms.chain, seed, np.concatenate(plan_ms), planned, found
    )
    return metrics, runs


def _check_cost(cost: SceneCost, task: Task, control_size: int) -> None:
    """Before anything is compiled: whether the cost is about this task at all."""
    found = cost.in_scene(task.scene).quadratic(task.scene.node_count).control_size
    if found != control_size:
        raise InvalidInputError(
            f"the cost is for control size U {found}, but the task has {control_size}; they must "
            "agree"
        )
