"""Each task violates one rule, and `check_task` must name it."""

from dataclasses import replace
from functools import partial

import gymnasium
import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.envs import ChainCost, PickupTask, check_task

ANGLE = gymnasium.spaces.Box(-10.0, 10.0, (2, 1), np.float64)


class Altered(PickupTask):
    """A pickup whose observations pass through `alter`."""

    def __init__(self, alter=dict):
        super().__init__()
        self.alter = alter

    def observed(self):
        return self.alter(self.seen())

    def seen(self):
        return super().observed()


class Turning(Altered):
    """A pickup that observes holding and orientation as well."""

    def __init__(self, alter=dict):
        super().__init__(alter)
        spaces = self.observation_space.spaces
        more = {"holding": spaces["contact"], "orientation": ANGLE, "angular_velocity": ANGLE}
        self.observation_space = gymnasium.spaces.Dict({**spaces, **more})

    def seen(self):
        observation = super().seen()
        turned = {"holding": observation["contact"].copy(), "orientation": np.full((2, 1), 0.5)}
        return {**observation, **turned, "angular_velocity": np.full((2, 1), -2.0)}


def put(task=Altered, **values):
    """A task with these arrays in its observations."""
    return partial(task, lambda observation: {**observation, **values})


def changed(**members):
    """A pickup with other members."""
    return type("Changed", (PickupTask,), members)


def with_scene(**fields):
    """A pickup with other fields of its scene."""
    return changed(scene=property(lambda self: replace(PickupTask.scene.fget(self), **fields)))


def with_space(task, **spaces):
    """A task with other spaces."""

    def factory():
        made = task()
        for name, space in spaces.items():
            setattr(made, name, space)
        return made

    return factory


class ReusedArrays(PickupTask):
    kept = None

    def observed(self):
        observation = super().observed()
        self.kept = self.kept or observation
        for name, value in observation.items():
            self.kept[name][...] = value
        return self.kept


class DoesNotClip(PickupTask):
    def step(self, action):
        return super().step(np.asarray(action) * (1.0 if np.abs(action).max() <= 10.0 else 0.5))


class DrawnLongerAndLonger(PickupTask):
    points = 1

    def link_positions(self):
        self.points += 1
        return np.zeros((self.points, 2))


def without_velocity(observation):
    return {name: value for name, value in observation.items() if name != "velocity"}


def with_other_goal(observation):
    return {**observation, "goal": observation["goal"] + 0.01}


def overlapping(observation):
    gripper = observation["position"][0]
    return {**observation, "position": np.stack([gripper, gripper + 0.01])}


def noisy(observation):
    noise = np.random.default_rng().normal(0.0, 1e-12, (2, 2))
    return {**observation, "velocity": observation["velocity"] + noise}


def drawn(links):
    """A pickup with a stick to draw."""
    return changed(link_positions=lambda self: links)


def with_cost(*arguments, **options):
    return changed(cost_terms=lambda self: ChainCost(*arguments, **options))


IGNORES_SEED = changed(reset=lambda self, **arguments: PickupTask.reset(self))
NEVER_ENDS = changed(
    step=lambda self, action: (*PickupTask.step(self, action)[:2], False, False, {})
)
UNBOUNDED = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
ONE_SIDED = np.array([[0, 1], [0, 0]], np.int8)
NAN = np.full((2, 2), np.nan)


@pytest.mark.parametrize("task", [drawn(np.zeros((2, 2))), Turning])
def test_a_task_may_be_drawn_and_may_observe_holding_and_orientation(task):
    check_task(task)


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (put(velocity=NAN), "velocity must be finite, found .*nan.* at reset"),
        (put(contact=ONE_SIDED), "contact must be symmetric with a zero diagonal, violated at re"),
        (put(contact=np.eye(2, dtype=np.int8)), "contact must be symmetric with a zero diagonal"),
        (put(contact=np.zeros((2, 2))), "contact must be int8, 0 or 1, found float64"),
        (
            put(position=np.zeros((3, 2))),
            r"position must have the scene's shape \(2, 2\), found \(3, 2\)",
        ),
        (partial(Altered, without_velocity), "an observation must have the keys .*velocity"),
        (partial(Altered, with_other_goal), "scene.goal must be the observed goal"),
        (partial(Altered, overlapping), "found gripper and target overlapping by 0.06.* m"),
        (ReusedArrays, "a step must not change the observation before it"),
        (IGNORES_SEED, "two tasks reset with seed 0 must agree"),
        (
            partial(Altered, noisy),
            r"the same seed and controls give the same .* \(velocity differs\)|must agree",
        ),
        (DoesNotClip, "a control out of bounds must act as the nearest one within"),
        (NEVER_ENDS, "an episode must end after max_steps = 200 steps"),
        (
            with_space(PickupTask, action_space=UNBOUNDED),
            r"action_space must be a bounded Box of shape \(U,\)",
        ),
        (with_scene(actuated=np.zeros(2, dtype=bool)), "scene.actuated must name at least one n"),
        (
            with_cost((0, 2), np.ones(4), np.ones(4), 1.0),
            r"cost_terms\(\).chain must name nodes 0 to 1, found \(0, 2\)",
        ),
        (
            with_cost((0, 1), np.ones(4), np.ones(4), 1.0, candidates=(1, 2)),
            r"cost_terms\(\).candidates must name nodes 0 to 1, found \(1, 2\)",
        ),
        (
            with_cost((0, 1), np.ones(6), np.ones(6), 1.0),
            r"cost_terms\(\) must have 4 weights",
        ),
        (changed(success=lambda self: 1.0), r"success\(\) must be a bool, found float"),
        (changed(scene={"nodes": 2}), "scene must be a contactgraph.data.Scene, found dict"),
        (
            drawn(np.zeros((1, 2))),
            r"link_positions\(\) must have shape \(P, 2\) with P >= 2, found \(1, 2\)",
        ),
        (
            drawn(np.zeros((4, 3))),
            r"link_positions\(\) must have shape \(P, 2\) .* found \(4, 3\) at reset",
        ),
        (drawn(NAN), r"link_positions\(\) must be finite, found .*nan.* at reset"),
        (DrawnLongerAndLonger, "keep its 2 points, found 3 at the end of an episode"),
        (
            put(Turning, holding=ONE_SIDED | ONE_SIDED.T),
            "holding must imply contact, violated at reset",
        ),
        (
            put(Turning, holding=np.zeros((2, 2))),
            "holding must be int8, 0 or 1, found float64 at reset",
        ),
        (
            put(Turning, holding=ONE_SIDED),
            "holding must be symmetric with a zero diagonal, violated at reset",
        ),
        (
            put(Turning, orientation=np.ones((2, 4))),
            r"orientation must have the scene's shape \(2, 1\), found \(2, 4\)",
        ),
        (
            put(Turning, angular_velocity=NAN[:, :1]),
            "angular_velocity must be finite, found .*nan.* at reset",
        ),
        (
            with_space(Turning, observation_space=PickupTask().observation_space),
            "an observation must lie in observation_space, violated at reset",
        ),
        (
            with_scene(control_kind=("force", "force", "switch")),
            "scene.control_kind must be of 2 components, found 3",
        ),
        (
            with_scene(control_of=np.ones((2, 1), dtype=bool)),
            "scene.control_of must be of 2 components, found 1",
        ),
        (object, "a task must be a gymnasium.Env, found object"),
    ],
)
def test_a_broken_promise_is_named(task, message):
    with pytest.raises(InvalidInputError, match=f"^task contract: .*{message}"):
        check_task(task)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((), np.ones(4), np.ones(4), 1.0), "chain must be different node indices"),
        (((0, 0), np.ones(4), np.ones(4), 1.0), "chain must be different node indices"),
        (((0, 1), -np.ones(4), np.ones(4), 1.0), "pick_weights must be 2D weights"),
        (((0, 1), np.ones(4), np.ones(3), 1.0), "goal_weights must be 2D weights"),
        (((0, 1), np.ones(4), np.ones(6), 1.0), "must be equally long, found 4 and 6"),
        (((0, 1), np.ones(4), np.full(4, np.nan), 1.0), "goal_weights must be 2D weights"),
        (((0, 1), np.ones(4), np.ones(4), 0.0), "control_weight must be positive, found 0.0"),
    ],
)
def test_chain_cost_rejects_invalid_arguments(arguments, message):
    with pytest.raises(InvalidInputError, match=message):
        ChainCost(*arguments)
