from dataclasses import dataclass, replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evaluation_worlds import DT, GluedBodies, by_model, random_run, scene_of

from contactgraph.control import ILQR, MPC, ControlLimits, QuadraticCost, chain_cost
from contactgraph.data import Dataset, InvalidInputError, pair_indices
from contactgraph.envs import ChainCost, PickupTask
from contactgraph.evaluate import episode_seeds, evaluate_open_loop, model_diagnostics
from contactgraph.model import PRESETS, ContactBelief, ModelConfig, scene_nodes, two_type_belief
from contactgraph.policies import MPCPolicy, TaskCost

SEER = GluedBodies(reach=0.081)


class Counted(GluedBodies):
    """Counts how often it is traced, which is once for everything that compiles it."""

    traces = [0]  # noqa: RUF012

    def linear_step(self, state, control, nodes):
        self.traces[0] += 1
        return GluedBodies(self.theta, self.reach).linear_step(state, control, nodes)


def policy_of(model, capacity=0, limits=None) -> MPCPolicy:
    ilqr = ILQR(5, 2, limits)
    return MPCPolicy(MPC(model, ilqr), TaskCost(PickupTask().cost_terms(), 2), capacity)


def test_the_known_world_is_picked_up_in_one_sweep():
    records = []
    metrics, runs = by_model(
        SEER, PickupTask, 2, 0, on_episode=lambda run, record: records.append((run, record))
    )
    assert metrics.success_rate == 1.0 and metrics.episodes == 2 and metrics.seed == 0
    assert all(run.scene.metadata["success"] for run in runs)
    assert metrics.contact_speed_m_s > 0.3 and metrics.slowest_before_contact_min_m_s > 0.1
    assert metrics.touched_bystanders == 0 and 0 < metrics.plan_ms_p50 <= metrics.plan_ms_p99
    assert [run.scene.metadata["seed"] for run in runs] == episode_seeds(2, 0)
    for (run, record), same in zip(records, runs, strict=True):
        assert run is same and run.scene.metadata["policy"] == "MPCPolicy"
        assert record.plan_ms.shape == record.status.shape == (200,)
        assert record.plan_belief.shape == (200, 20, 1) and record.plan.shape == (200, 21, 2, 2)
        # Every plan begins where things are.
        assert np.allclose(record.plan[:, 0], run.position[:-1], atol=1e-6)
        # It looks ahead without forces: a near miss, or a touch a step off, can fool it.
        held, believed = run.contact[1:, 0, 1], record.plan_belief[:, 0, 0] > 0.5
        assert held.any() and np.sum(believed != held) <= 3


@pytest.fixture(scope="module")
def followed():
    """Metrics of an episode in which every plan is followed for half a second."""
    metrics, _ = by_model(SEER, PickupTask, 1, 0, replan_every=10)
    return metrics


def test_the_known_world_does_as_planned(followed):
    found = followed.planned
    assert found.windows == 200 * DT / 0.5 and found.edges.total == 200
    assert found.planned.rmse < 0.02 < found.constant_velocity.rmse
    assert followed.to_json()["n_step_rmse_planned_m"] == found.planned.rmse
    assert found.edges.accuracy > 0.95


class Touching(PickupTask):
    """A pickup in which all nodes touch at every step, and those in contact before hold."""

    def reset(self, **arguments):
        observation, info = super().reset(**arguments)
        return self.touching(observation), info

    def step(self, action):
        observation, *rest = super().step(action)
        return self.touching(observation), *rest

    def touching(self, observation):
        all_pairs = np.ones((2, 2), np.int8) - np.eye(2, dtype=np.int8)
        return {**observation, "contact": all_pairs, "holding": observation["contact"]}


def test_estimates_and_plans_are_scored_against_holding_where_it_is_observed(followed):
    touching, (run,) = by_model(SEER, Touching, 1, 0, replan_every=10)
    assert run.contact[:, 0, 1].all() and not run.holding[:, 0, 1].all()
    assert touching.estimated == followed.estimated and touching.planned == followed.planned
    assert followed.estimated.edges.hits > 0


def test_other_numbers_of_objects_do_not_recompile():
    policy = policy_of(Counted(reach=0.081), capacity=5)
    traces = []
    for distractors in (0, 3, 1):
        task = PickupTask(distractors)
        observation, _ = task.reset(seed=0)
        policy.reset(task.scene, 0)
        for _ in range(2):
            assert np.linalg.norm(policy(observation)) > 0.1
        assert policy.record().plan.shape == (2, 6, 2 + distractors, 2)
        assert policy.record().plan_belief.shape[2] == (2 + distractors) * (1 + distractors) // 2
        traces.append(Counted.traces[0])
    assert traces[0] > 0 and traces == [traces[0]] * 3


@dataclass(frozen=True)
class Watched:
    """The part of a planner's state that the policy reads."""

    cost: QuadraticCost
    belief: ContactBelief

    @property
    def last(self):
        return self

    @property
    def node_ids(self):
        return np.arange(4)


class Watcher:
    """Plans nothing, believes the measured contacts, and stores the costs."""

    def __init__(self):
        self.costs = []

    def reset(self, observation, nodes, cost):
        return Watched(cost, two_type_belief(jnp.zeros(nodes.candidate.shape)))

    def step(self, observation, contacts, state, applied, cost):
        state = state if cost is None else replace(state, cost=cost)
        self.costs.append(state.cost.quadratic(4))
        touching = contacts[tuple(pair_indices(len(contacts)).T)]
        held = replace(state, belief=two_type_belief(jnp.asarray(touching, float)))
        return SimpleNamespace(controls=jnp.zeros((1, 2))), held


TASK_CHAIN = (0, 3, 1)
WEIGHTS = np.array([3.0, 3.0, 0.2, 0.2]), np.array([50.0, 50.0, 1.0, 1.0]), 0.01


def planned_for(contacts, chain=TASK_CHAIN, holding=False) -> list[QuadraticCost]:
    """The cost at each step, given the contacts of the step before.

    With ``holding`` the pairs hold each other, and all nodes touch.
    """
    watcher = Watcher()
    policy = MPCPolicy(watcher, TaskCost(ChainCost(chain, *WEIGHTS), 2))
    policy.reset(scene_of(4, goal=np.ones(2)), 0)
    for pairs in contacts:
        contact = np.zeros((4, 4), np.int8)
        for first, second in pairs:
            contact[first, second] = contact[second, first] = 1
        state = {"position": np.zeros((4, 2)), "velocity": np.zeros((4, 2))}
        pairs = {"holding": contact, "contact": 1 - np.eye(4)} if holding else {"contact": contact}
        policy({**state, **pairs})
    return watcher.costs


@pytest.mark.parametrize(
    ("held", "expected"),
    [
        ([], (0, 3, 1)),
        ([(0, 3)], (0, 3, 1)),
        ([(0, 1)], (0, 1, 3)),  # Picked up out of turn.
        ([(0, 2), (1, 2)], (0, 1, 3)),  # By way of a body that the task does not name.
        ([(0, 1), (0, 3)], (0, 3, 1)),
        ([(1, 2), (2, 3)], (0, 3, 1)),  # They hold each other, and the gripper holds none.
    ],
)
def test_the_chain_follows_the_grasped_nodes(held, expected):
    costs = planned_for([held, [], []])
    for cost, chain in zip(costs, (TASK_CHAIN, expected, TASK_CHAIN), strict=True):
        wanted = chain_cost(chain, *WEIGHTS, np.ones(2), 4)
        assert np.array_equal(cost.Q, wanted.Q) and np.array_equal(cost.goal, wanted.goal)
        assert cost.cost_node_ids.tolist() == list(chain)


def test_nodes_that_touch_are_not_grasped_where_holding_is_observed():
    for held, expected in (([(0, 1)], (0, 1, 3)), ([], TASK_CHAIN)):
        after = planned_for([held, []], holding=True)[1]
        assert after.cost_node_ids.tolist() == list(expected)


def test_with_nothing_further_to_pick_up_the_chain_stays():
    for cost in planned_for([[(0, 3)], [], []], chain=(0, 3)):
        assert cost.cost_node_ids.tolist() == [0, 3]


def test_nothing_is_picked_up_while_the_last_node_lies_at_the_goal():
    terms = ChainCost((0, 1), *WEIGHTS, placed_radius=0.01)
    watcher = Watcher()
    policy = MPCPolicy(watcher, TaskCost(terms, 2))
    policy.reset(scene_of(4, goal=np.ones(2)), 0)
    for away in (0.011, 0.009, 0.0, 0.02):
        position = np.zeros((4, 2))
        position[1] = 1.0 + np.array([0.0, away])
        policy({"position": position, "velocity": np.zeros((4, 2)), "contact": np.eye(4) < 0})
    left = [chain_cost((0, 1), k * WEIGHTS[0], *WEIGHTS[1:], np.ones(2), 4).Q for k in (0.0, 1.0)]
    for cost, picks in zip(watcher.costs, (1, 0, 0, 1), strict=True):
        assert np.array_equal(cost.Q, left[picks])


def test_padding_changes_no_control():
    task = PickupTask(1)
    runs = []
    for capacity in (0, 6):
        observation, _ = task.reset(seed=3)
        policy = policy_of(SEER, capacity)
        policy.reset(task.scene, 0)
        runs.append(policy(observation))
    assert np.allclose(*runs, atol=1e-5)


@pytest.mark.slow
def test_diagnostics_match_the_controllers_beliefs():
    model = PRESETS["ours-recurrent"](ModelConfig(2, 2, DT, width=8), key=jax.random.key(0))
    run = random_run(3, 12, 2, goal=np.ones(2))
    # Without force: a plan also knows what its own force does to a touch, a recording does not.
    policy = policy_of(model, 4, ControlLimits(jnp.zeros(2), jnp.zeros(2)))
    policy.reset(run.scene, 0)
    for position, velocity, contact in zip(
        run.position[:-1], run.velocity[:-1], run.contact[:-1], strict=True
    ):
        policy({"position": position, "velocity": velocity, "contact": contact})
    insight = model_diagnostics(model, run, node_capacity=4)
    assert np.allclose(insight.belief, policy.record().plan_belief[:, 0], atol=1e-4)
    assert insight.belief.shape == (12, 3) and insight.edges.tolist() == [[0, 1], [0, 2], [1, 2]]
    assert insight.parameters.inverse_mass.shape == (12, 3, 2)
    assert np.all(insight.parameters.stiffness_rate >= 0)
    blind = model_diagnostics(model, run, node_capacity=4, measured=False)
    assert not np.allclose(blind.belief, insight.belief, atol=1e-2)
    # The first step of every open-loop window is the same prediction.
    found = evaluate_open_loop(model, Dataset((run,)), horizon_s=DT).predictions["n_step"]
    assert np.array_equal(found.edge_active[:, 0], insight.belief > 0.5)


def test_scene_nodes_pads_and_knows_candidates():
    scene = scene_of(3, candidate_edges=[[2, 0], [0, 1]])
    nodes = scene_nodes(scene, 4)
    assert nodes.mask.tolist() == [True, True, True, False]
    assert nodes.actuated.tolist() == [True, False, False, False]
    assert nodes.candidate.tolist() == [True, True, False, False, False, False]
    assert scene_nodes(scene_of(3)).candidate.all()
    assert nodes.anchor is None and not nodes.hinged.any()
    hung = scene_nodes(scene_of(3, anchor=[[np.nan] * 2, [1.0, 2.0], [np.nan] * 2]), 4)
    assert hung.hinged.tolist() == [False, True, False, False]
    assert hung.anchor[1].tolist() == [1.0, 2.0]
    assert scene_nodes(scene_of(3, anchor=np.full((3, 2), np.nan))).anchor is None
    with pytest.raises(InvalidInputError, match="node_capacity must be at least 3, found 2"):
        scene_nodes(scene, 2)


def test_mismatched_inputs_are_rejected():
    class Aimless(PickupTask):
        @property
        def scene(self):
            return replace(super().scene, goal=None)

    with pytest.raises(InvalidInputError, match="the scene has no goal"):
        by_model(SEER, Aimless, 1, 0)
    with pytest.raises(InvalidInputError, match="episodes must be at least 1, found 0"):
        by_model(SEER, PickupTask, 0, 0)
    with pytest.raises(InvalidInputError, match="no step since reset"):
        policy_of(SEER).record()
