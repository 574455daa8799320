"""Running a policy in a task, and recording what happened."""

from collections.abc import Callable
from dataclasses import replace
from typing import cast

import gymnasium
import numpy as np

from contactgraph.data import InvalidInputError, Trajectory
from contactgraph.envs.contract import (
    Drawn,
    FeedbackPolicy,
    FeedbackTask,
    InformedPolicy,
    Observation,
    Policy,
    Task,
)

StepCallback = Callable[[int, Observation, np.ndarray], None]
"""Called after every step with its index, the observation before it and the control ``[U]`` N."""


def run_episode(
    task: Task, policy: Policy, seed: int, on_step: StepCallback | None = None
) -> Trajectory:
    """Runs one episode and records it: ``T`` controls as applied, ``T + 1`` states and contacts.

    ``seed`` samples the scene (``task.reset(seed=seed)``), and the policy's seed is derived from
    it. Where task and policy both know of it, feedback acts within the steps, and controls are
    their means. The scene's metadata gains the policy's class name and whether the run succeeded.
    A task that is `Drawn` has its skeleton recorded at every state.
    """
    if seed < 0:
        raise InvalidInputError(f"seed must be at least 0, found {seed}")
    box = cast(gymnasium.spaces.Box, task.action_space)
    observation, _ = task.reset(seed=seed)
    # A stream of its own: a noise drawn from the scene's numbers would depend on the layout.
    policy.reset(task.scene, int(np.random.SeedSequence(seed).generate_state(1)[0]))
    observations = [observation]
    drawn = task if isinstance(task, Drawn) else None
    # Copies: a simulator may well answer with a view of what it moves.
    skeletons = [] if drawn is None else [np.array(drawn.skeleton())]
    controls: list[np.ndarray] = []
    done = False
    while not done:
        control = np.clip(policy(observation), box.low, box.high).astype(box.dtype)
        if isinstance(task, FeedbackTask) and isinstance(policy, FeedbackPolicy):
            following, _, terminated, truncated, info = task.step_under(policy.feedback())
            control = info["control"]
        else:
            following, _, terminated, truncated, _ = task.step(control)
        if isinstance(policy, InformedPolicy):
            policy.applied(control)
        if on_step is not None:
            on_step(len(controls), observation, control)
        observation, done = following, terminated or truncated
        observations.append(observation)
        if drawn is not None:
            skeletons.append(np.array(drawn.skeleton()))
        controls.append(control)
    metadata = {
        **task.scene.metadata,
        "policy": type(policy).__name__,
        "success": task.success(),
    }
    return Trajectory(
        scene=replace(task.scene, metadata=metadata),
        position=np.stack([each["position"] for each in observations]),
        velocity=np.stack([each["velocity"] for each in observations]),
        control=np.stack(controls),
        contact=np.stack([each["contact"] for each in observations]).astype(bool),
        skeleton=np.stack(skeletons) if skeletons else None,
    )
