"""Closed loop under controls of any kind: bounds by component, switches, targets, early ends."""

from dataclasses import replace
from functools import partial

import equinox as eqx
import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
from evaluation_worlds import DT, by_model, scene_of

from contactgraph.data import InvalidInputError
from contactgraph.envs import ChainCost, RestPolicy, StickyTask
from contactgraph.evaluate import control_task, episode_seeds
from contactgraph.model import LinearDynamics, two_type_belief
from contactgraph.policies import Planning, TaskCost

STEPS = 24
GAIN = {"displacement": 0.05, "position": 0.3}
"""m, of a control of 1; share of the distance to the target that a step covers."""


class Hand(eqx.Module):
    """The model of `HandTask`: control moves the first node, and further components nothing."""

    kind: str = eqx.field(static=True)
    control_size: int = eqx.field(static=True)

    def initial_belief(self, position, velocity, nodes):
        return two_type_belief(jnp.zeros(nodes.candidate.shape, position.dtype))

    def linear_step(self, state, control, nodes):
        N, D = state.position.shape
        gain, hand = GAIN[self.kind], nodes.actuated[:, None, None]
        left = gain if self.kind == "position" else 0.0
        driven = jnp.array([[1.0 - left, 0.0], [-left / DT, 0.0]])
        A = jnp.where(hand[..., None], driven, jnp.eye(2)) * jnp.ones((N, D, 1, 1))
        per_axis = jnp.eye(D, self.control_size)[:, None, :] * jnp.array([[gain], [gain / DT]])
        B = jnp.where(hand[..., None], per_axis, 0.0)
        return LinearDynamics(A, B, jnp.zeros((N, D, 2))), self.initial_belief(
            state.position, state.velocity, nodes
        )


class HandTask:
    """A hand that goes where its control says, to a goal; an object rests far away."""

    max_steps = STEPS

    def __init__(self, kind, low, high, start, goal, ends=None, wins=False):
        self.action_space = gymnasium.spaces.Box(np.float32(low), np.float32(high))
        self.kind, self.ends, self.wins = kind, ends, wins
        self.start = np.array([start, np.full(len(start), 99.0)])
        D, U = len(goal), len(low)
        kinds = (*[kind] * min(D, U), *["switch"] * (U - D))
        self.scene = scene_of(2, dimension=D, goal=np.array(goal, float), control_kind=kinds)

    def reset(self, *, seed=None, options=None):
        self.count, self.position = 0, self.start.copy()
        self.velocity = np.zeros_like(self.start)
        return self._observation(), {}

    def step(self, action):
        assert action in self.action_space
        own = np.array(action, float)[: self.position.shape[1]]
        if self.kind == "position":
            own = own - self.position[0]
        self.velocity[0] = GAIN[self.kind] * own / DT
        self.position[0] += DT * self.velocity[0]
        self.count += 1
        return self._observation(), 0.0, self.count == self.ends, self.count == STEPS, {}

    def success(self):
        return self.wins or bool(np.linalg.norm(self.position[0] - self.scene.goal) < 0.01)

    def cost_terms(self):
        D = len(self.scene.goal)
        return ChainCost((0,), np.zeros(2 * D), np.repeat([50.0, 0.1], D), 0.001)

    def _observation(self):
        return {
            "position": self.position.copy(),
            "velocity": self.velocity.copy(),
            "contact": np.zeros((2, 2), np.int8),
            "goal": self.scene.goal,
        }


def controlled(kind, low, high, start, goal, **options):
    """Metrics, the one trajectory, and the controller's record, under the model of the task."""
    task, records = partial(HandTask, kind, low, high, start, goal, **options), []
    metrics, (trajectory,) = by_model(
        *(Hand(kind, len(low)), task, 1, 0),
        plans=Planning(horizon=8, iterations=4),
        on_episode=lambda _, record: records.append(record),
    )
    return metrics, trajectory, records[0]


def test_a_hand_in_space_with_a_switch_reaches_its_goal():
    metrics, trajectory, _ = controlled(
        "displacement", [-1, -1, -1, 0], [1, 1, 1, 1], (0.0, 0.0, 0.0), (0.3, -0.2, 0.1)
    )
    assert metrics.success_rate == 1.0 and metrics.goal_distance_m_mean < 0.01
    assert trajectory.control.shape == (STEPS, 4)
    # The far axis goes at the limit; a switch that moves nothing stays off.
    assert np.allclose(trajectory.control[0, :3], [1.0, -1.0, 1.0], atol=1e-3)
    assert np.array_equal(trajectory.control[:, 3], np.zeros(STEPS))
    assert metrics.planned.moved_objects == 0 and metrics.planned.rmse is None


def test_each_component_has_bounds_of_its_own():
    _, trajectory, record = controlled(
        "displacement", [-0.2, -1.0], [1.0, 0.5], (0.0, 0.0), (-0.9, 0.9)
    )
    assert np.allclose(trajectory.control[:5], [-0.2, 0.5])
    assert np.allclose(trajectory.position[5, 0], [5 * 0.05 * -0.2, 5 * 0.05 * 0.5])
    # Plans know the bounds: the task need not clip.
    assert np.allclose(record.plan[0, :6], trajectory.position[:6], atol=1e-6)


def test_a_target_in_the_world_is_commanded_within_its_box():
    box = [0.0, 0.0], [5.12, 5.12]
    metrics, trajectory, _ = controlled("position", *box, (2.56, 2.56), (4.5, 0.5))
    assert metrics.success_rate == 1.0
    assert np.allclose(trajectory.control[-1], (4.5, 0.5), atol=0.02)
    metrics, trajectory, _ = controlled("position", *box, (2.56, 2.56), (6.0, -1.0))
    assert metrics.success_rate == 0.0, "the goal is outside"
    assert np.allclose(trajectory.control[-1], (5.12, 0.0), atol=1e-6)
    assert metrics.goal_distance_m_median == pytest.approx(np.hypot(0.88, 1.0), abs=0.01)


def test_bounds_may_exclude_zero():
    box = [1.0, 1.0, 0.2], [5.0, 5.0, 1.0]
    _, trajectory, _ = controlled("position", *box, (3.0, 3.0), (0.5, 4.0))
    assert np.allclose(trajectory.control[-1], (1.0, 4.0, 0.2), atol=0.01)
    assert np.all(trajectory.control[:, 2] == np.float32(0.2)), "the nearest to off"


@pytest.mark.parametrize("wins", [False, True])
def test_an_episode_that_ends_early_is_recorded_and_fails_unless_it_succeeds(wins):
    metrics, trajectory, _ = controlled(
        *("displacement", [-1, -1, -1, 0], [1, 1, 1, 1], (0.0, 0.0, 0.0), (0.3, -0.2, 0.1)),
        ends=3,
        wins=wins,
    )
    assert trajectory.steps == 3 and trajectory.scene.metadata["success"] is wins
    assert (metrics.episodes, metrics.success_rate) == (1, float(wins))
    assert metrics.planned.windows == 0 and metrics.plan_ms_p50 > 0
    gone = trajectory.position[3, 0] - (0.3, -0.2, 0.1)
    assert metrics.goal_distance_m_mean == pytest.approx(np.linalg.norm(gone))


def test_every_component_has_the_cost_of_the_control():
    task = HandTask("displacement", [-1] * 3 + [0], [1] * 4, (0.0,) * 3, (1.0,) * 3)
    cost = TaskCost(task.cost_terms(), 4).in_scene(task.scene).quadratic(2)
    assert np.allclose(cost.R, 0.001 * np.eye(4)) and cost.Q.shape == (12, 12)
    assert TaskCost(task.cost_terms(), 0).in_scene(task.scene).quadratic(2).control_size == 0


def test_a_task_without_control_is_refused():
    nothing = np.zeros(0)
    task = partial(HandTask, "displacement", nothing, nothing, (0.0, 0.0), (1.0, 1.0))
    message = r"^the task takes no control \(U = 0\), so nothing can control it$"
    with pytest.raises(InvalidInputError, match=message):
        by_model(Hand("displacement", 0), task, 1, 0)
    with pytest.raises(InvalidInputError, match=message):
        control_task(RestPolicy(), task(), 1, 0)


def test_a_policy_gets_the_seeds_of_a_model():
    class Straight:
        """To the goal at full speed."""

        def reset(self, scene, seed):
            self.seeds = [*getattr(self, "seeds", ()), seed]

        def __call__(self, observation):
            return (observation["goal"] - observation["position"][0]) / GAIN["displacement"]

    policy, done = Straight(), []
    task = partial(HandTask, "displacement", [-1, -1], [1, 1], (0.0, 0.0), (0.3, -0.2))
    result = control_task(
        policy, task(), 3, 7, on_episode=lambda run, record: done.append((run, record))
    )
    metrics, runs = result.metrics, result.trajectories
    assert done == [(run, None) for run in runs] and (
        metrics.success_rate,
        metrics.scenes,
        metrics.seed,
    ) == (1.0, 3, 7)
    derived = [int(np.random.SeedSequence(s).generate_state(1)[0]) for s in episode_seeds(3, 7)]
    assert policy.seeds == derived
    assert metrics.plan_ms_p50 is None and metrics.goal_distance_m_mean < 1e-6
    # 0.3 m at 5 cm a step, clipped to the box.
    assert np.allclose(runs[0].position[6, 0], (0.3, -0.2)) and runs[0].position[5, 0, 0] < 0.26


def test_metrics_of_ones_own_are_measured_beside_the_others():
    """A name that is taken is refused before an episode runs."""
    task = HandTask("displacement", [-1, -1], [1, 1], (0.0, 0.0), (0.3, -0.2))
    names = {"first_x_m": lambda run: float(run.position[0, 0, 0]), "unknown": lambda run: None}
    result = control_task(RestPolicy(), task, 2, 7, metrics=names)
    values = result.to_json()
    assert values["first_x_m"] == 0.0 and values["first_x_m_by_episode"] == [0.0, 0.0]
    assert values["unknown"] is None and values["success_rate"] == 0.0

    class Never(RestPolicy):
        def reset(self, scene, seed):
            pytest.fail("an episode has begun")

    for taken in ("success_rate", "planned_windows", "edge_f1_found"):
        with pytest.raises(InvalidInputError, match=f"new names, found '{taken}'"):
            control_task(Never(), task, 2, 7, metrics={taken: len})


def test_a_task_s_cost_follows_the_chain_of_each_episode() -> None:
    class Chosen(StickyTask):
        def cost_terms(self):
            chosen = 1 + self.scene.metadata["seed"] % 3
            return replace(super().cost_terms(), chain=(0, chosen))

    task = Chosen()
    task.reset(seed=0)
    cost = TaskCost(task.cost_terms(), 2, task.cost_terms)
    for seed in range(3):
        task.reset(seed=seed)
        assert cost.in_scene(task.scene).order == (0, 1 + seed)
    assert cost.order == (0, 1)
