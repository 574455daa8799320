"""Each task violates one rule, and `check_task` must name it."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph.envs import ChainCost, PickupTask, check_task

pytestmark = pytest.mark.usefixtures("engine")


class Altered(PickupTask):
    """A pickup whose observations pass through `alter`."""

    def alter(self, observation):
        return observation

    def reset(self, **arguments):
        observation, info = super().reset(**arguments)
        return self.alter(observation), info

    def step(self, action):
        observation, *rest = super().step(action)
        return self.alter(observation), *rest


class NotFinite(Altered):
    def alter(self, observation):
        observation["velocity"][1] = np.nan
        return observation


class OneSidedContact(Altered):
    def alter(self, observation):
        observation["contact"][0, 1] = 1
        return observation


class SelfContact(Altered):
    def alter(self, observation):
        np.fill_diagonal(observation["contact"], 1)
        return observation


class ContactAsFloat(Altered):
    def alter(self, observation):
        return {**observation, "contact": observation["contact"].astype(float)}


class NodeTooMany(Altered):
    def alter(self, observation):
        return {**observation, "position": np.zeros((3, 2))}


class KeyTooFew(Altered):
    def alter(self, observation):
        del observation["velocity"]
        return observation


class OtherGoal(Altered):
    def alter(self, observation):
        return {**observation, "goal": observation["goal"] + 0.01}


class Overlapping(Altered):
    def alter(self, observation):
        observation["position"][1] = observation["position"][0] + 0.01
        return observation


class ReusedArrays(Altered):
    kept = None

    def alter(self, observation):
        self.kept = self.kept or observation
        for name, value in observation.items():
            self.kept[name][...] = value
        return self.kept


class IgnoresSeed(PickupTask):
    def reset(self, *, seed=None, options=None):
        return super().reset(options=options)


class NoisyStep(Altered):
    def alter(self, observation):
        observation["velocity"] += np.random.default_rng().normal(0.0, 1e-12, (2, 2))
        return observation


class DoesNotClip(PickupTask):
    def step(self, action):
        return super().step(np.asarray(action) * (1.0 if np.abs(action).max() <= 10.0 else 0.5))


class NeverEnds(PickupTask):
    def step(self, action):
        observation, reward, *_ = super().step(action)
        return observation, reward, False, False, {}


class UnboundedControl(PickupTask):
    def __init__(self):
        super().__init__()
        self.action_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)


class NobodyActuated(PickupTask):
    @property
    def scene(self):
        return replace(super().scene, actuated=np.zeros(2, dtype=bool))


class ForeignChain(PickupTask):
    def cost_terms(self):
        return ChainCost((0, 2), np.ones(4), np.ones(4), 1.0)


class WeightsIn3D(PickupTask):
    def cost_terms(self):
        return ChainCost((0, 1), np.ones(6), np.ones(6), 1.0)


class SceneOfItsOwn(PickupTask):
    @property
    def scene(self):
        return {"nodes": 2}


class SuccessAsNumber(PickupTask):
    def success(self):
        return 1.0


class Renderable(PickupTask):
    """A pickup with a stick to draw."""

    stick = np.zeros((2, 2))

    def link_positions(self):
        return self.stick


class DrawnAsOnePoint(Renderable):
    stick = np.zeros((1, 2))


class DrawnInSpace(Renderable):
    stick = np.zeros((4, 3))


class DrawnNowhere(Renderable):
    stick = np.full((2, 2), np.nan)


class DrawnLongerAndLonger(Renderable):
    def step(self, action):
        self.stick = np.append(self.stick, np.zeros((1, 2)), axis=0)
        return super().step(action)


class Turning(PickupTask):
    """A pickup that observes holding and orientation as well, each passed through `alter`."""

    def __init__(self):
        super().__init__()
        angle = gymnasium.spaces.Box(-10.0, 10.0, (2, 1), np.float64)
        self.observation_space = gymnasium.spaces.Dict(
            {
                **self.observation_space,
                "holding": self.observation_space["contact"],
                "orientation": angle,
                "angular_velocity": angle,
            }
        )

    def reset(self, **arguments):
        observation, info = super().reset(**arguments)
        return self.turned(observation), info

    def step(self, action):
        observation, *rest = super().step(action)
        return self.turned(observation), *rest

    def turned(self, observation):
        turned = {"holding": observation["contact"].copy(), "orientation": np.full((2, 1), 0.5)}
        return self.alter({**observation, **turned, "angular_velocity": np.full((2, 1), -2.0)})

    def alter(self, observation):
        return observation


class HoldsFromAfar(Turning):
    def alter(self, observation):
        return {**observation, "holding": np.array([[0, 1], [1, 0]], np.int8)}


class HoldsAsFloat(Turning):
    def alter(self, observation):
        return {**observation, "holding": np.zeros((2, 2))}


class OneHoldsTheOther(Turning):
    def alter(self, observation):
        return {**observation, "holding": np.array([[0, 1], [0, 0]], np.int8)}


class TurnsInSpace(Turning):
    def alter(self, observation):
        return {**observation, "orientation": np.ones((2, 4))}


class TurnsUnknown(Turning):
    def alter(self, observation):
        return {**observation, "angular_velocity": np.full((2, 1), np.nan)}


class TurnsUndeclared(Turning):
    def __init__(self):
        super().__init__()
        self.observation_space = PickupTask().observation_space


class OtherKinds(PickupTask):
    @property
    def scene(self):
        return replace(super().scene, control_kind=("force", "force", "switch"))


class OtherComponents(PickupTask):
    @property
    def scene(self):
        return replace(super().scene, control_of=np.ones((2, 1), dtype=bool))


def test_a_task_may_be_drawn():
    check_task(Renderable)


def test_a_task_may_observe_holding_and_orientation():
    check_task(Turning)


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (NotFinite, "velocity must be finite, found .*nan.* at reset"),
        (OneSidedContact, "contact must be symmetric with a zero diagonal, violated at reset"),
        (SelfContact, "contact must be symmetric with a zero diagonal"),
        (ContactAsFloat, "contact must be int8, 0 or 1, found float64"),
        (NodeTooMany, r"position must have the scene's shape \(2, 2\), found \(3, 2\)"),
        (KeyTooFew, "an observation must have the keys .*velocity"),
        (OtherGoal, "scene.goal must be the observed goal"),
        (Overlapping, "found gripper and target overlapping by 0.06.* m"),
        (ReusedArrays, "a step must not change the observation before it"),
        (IgnoresSeed, "two tasks reset with seed 0 must agree"),
        (NoisyStep, r"the same seed and controls give the same .* \(velocity differs\)|must agree"),
        (DoesNotClip, "a control out of bounds must act as the nearest one within"),
        (NeverEnds, "an episode must end after max_steps = 200 steps"),
        (UnboundedControl, r"action_space must be a bounded Box of shape \(U,\)"),
        (NobodyActuated, "scene.actuated must name at least one node"),
        (ForeignChain, r"cost_terms\(\).chain must name nodes 0 to 1, found \(0, 2\)"),
        (WeightsIn3D, r"cost_terms\(\) must have 4 weights"),
        (SuccessAsNumber, r"success\(\) must be a bool, found float"),
        (SceneOfItsOwn, "scene must be a contactgraph.data.Scene, found dict"),
        (
            DrawnAsOnePoint,
            r"link_positions\(\) must have shape \(P, 2\) with P >= 2, found \(1, 2\)",
        ),
        (DrawnInSpace, r"link_positions\(\) must have shape \(P, 2\) .* found \(4, 3\) at reset"),
        (DrawnNowhere, r"link_positions\(\) must be finite, found .*nan.* at reset"),
        (DrawnLongerAndLonger, r"keep its 2 points, found 202 at the end of an episode"),
        (HoldsFromAfar, "holding must imply contact, violated at reset"),
        (HoldsAsFloat, "holding must be int8, 0 or 1, found float64 at reset"),
        (OneHoldsTheOther, "holding must be symmetric with a zero diagonal, violated at reset"),
        (TurnsInSpace, r"orientation must have the scene's shape \(2, 1\), found \(2, 4\)"),
        (TurnsUnknown, "angular_velocity must be finite, found .*nan.* at reset"),
        (TurnsUndeclared, "an observation must lie in observation_space, violated at reset"),
        (OtherKinds, "scene.control_kind must be of 2 components, found 3"),
        (OtherComponents, "scene.control_of must be of 2 components, found 1"),
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
