import json
from dataclasses import replace

import numpy as np
import pytest
from evaluation_worlds import scene_of

from contactgraph.data import Trajectory
from contactgraph.evaluate import closed_loop_metrics, wilson_interval
from contactgraph.evaluate.control_task import approach


def episode(speed, touch=None, distractor=None) -> Trajectory:
    """A gripper with these speeds that touches the target and a distractor in these states."""
    states = len(speed)
    velocity = np.zeros((states, 3, 2))
    velocity[:, 0] = np.outer(speed, [0.6, -0.8])
    velocity[:, 1] = 9.0  # the target's speed is not used
    contact = np.zeros((states, 3, 3), dtype=bool)
    for node, since in ((1, touch), (2, distractor)):
        if since is not None:
            contact[since:, 0, node] = contact[since:, node, 0] = True
    return Trajectory(
        scene_of(3), np.zeros((states, 3, 2)), velocity, np.zeros((states - 1, 2)), contact
    )


def test_speeds_by_hand():
    #        state    0    1    2    3    4    5    6    7    8    9
    trajectory = episode([0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 0.6, 0.8, 0.2], touch=9)
    found = approach(trajectory, (0, 1))
    assert found[0] == pytest.approx(0.8)  # before contact, not after it
    assert found[1] == pytest.approx(0.5)  # not in start-up, not after contact
    slowing = approach(episode([0, 1, 1, 1, 1, 1, 0.02, 1, 0], touch=8), (0, 1))
    assert slowing[1] == pytest.approx(0.02)


def test_start_up_is_a_time_not_a_number_of_steps():
    trajectory = episode([*np.linspace(0.0, 0.5, 26), 0.7, 0.6, 0.0], touch=28)
    quick = replace(trajectory, scene=replace(trajectory.scene, dt=0.01))
    assert approach(quick, (0, 1))[1] == pytest.approx(0.5)
    assert approach(trajectory, (0, 1))[1] == pytest.approx(0.1)


def test_contact_in_start_up_or_never_or_from_the_start():
    early = approach(episode([0.0, 0.5, 1.0, 1.0, 1.0, 1.0, 1.0], touch=2), (0, 1))
    assert early[0] == pytest.approx(0.5) and early[1] is None
    assert approach(episode([0.0, 1.0], touch=None), (0, 1)) is None
    assert approach(episode([0.0, 1.0], touch=0), (0, 1)) is None
    assert approach(episode([0.0, 1.0, 1.0], touch=1), (0,)) is None
    assert approach(replace(episode([0.0, 1.0], touch=1), contact=None), (0, 1)) is None


def test_over_episodes():
    trajectories = [
        episode([1.0] * 8, touch=7),
        episode([1.0] * 6 + [0.5, 0.9], touch=7, distractor=7),
        episode([2.0] * 8, touch=7),
        episode([3.0] * 8),
    ]
    found = closed_loop_metrics(
        trajectories, [True, False, True, True], [(0, 1)] * 4, 7, np.arange(101.0)
    )
    assert found.episodes == 4 and found.seed == 7
    assert found.success_rate == 0.75 and found.success_interval == wilson_interval(3, 4)
    assert found.to_json()["success_by_episode"] == [True, False, True, True]
    assert found.contact_speed_m_s == pytest.approx(1.0)  # of 1, 0.5 and 2
    assert found.slowest_before_contact_min_m_s == pytest.approx(0.5)
    assert found.touched_bystanders == 1
    assert found.touches_mean == 0.75  # once in three of four
    assert found.plan_ms_p50 == 50.0 and found.plan_ms_p99 == 99.0
    numbers = found.to_json()
    assert json.loads(json.dumps(numbers, allow_nan=False)) == numbers


def test_a_repeated_scene_is_no_further_scene():
    trajectories = [episode([1.0] * 8)] * 6
    succeeded = [True, True, False, True, True, False]
    once = closed_loop_metrics(trajectories, succeeded, [(0, 1)] * 6, 0)
    assert once.scenes == 6 and once.success_interval == wilson_interval(4, 6)
    # Scene 3 succeeds twice, scene 5 once in two, scene 8 once, scene 9 never: 2.5 of 4.
    seeds = [3, 5, 5, 3, 8, 9]
    found = closed_loop_metrics(trajectories, succeeded, [(0, 1)] * 6, 0, scene_seeds=seeds)
    assert (found.scenes, found.episodes) == (4, 6)
    assert found.success_rate == pytest.approx(4 / 6)
    assert found.success_interval == wilson_interval(2, 4)
    twice = closed_loop_metrics(
        trajectories, [True] * 6, [(0, 1)] * 6, 0, scene_seeds=[1, 2, 3, 1, 2, 3]
    )
    assert twice.success_interval == wilson_interval(3, 3), "no narrower than of three scenes"


def test_the_last_node_ends_at_a_distance_from_the_goal():
    def ending(point, goal=(1.0, 1.0)):
        trajectory = episode([1.0, 1.0])
        trajectory.position[-1, 1] = point
        trajectory.position[0, 1] = (50.0, 50.0)  # only the end counts
        return replace(trajectory, scene=replace(trajectory.scene, goal=goal))

    ends = [ending((1.0, 1.5)), ending((4.0, 5.0)), ending((1.0, 1.1))]
    found = closed_loop_metrics(ends, [True] * 3, [(0, 2, 1)] * 3, 0)
    assert found.goal_distance_m_median == pytest.approx(0.5)
    assert found.goal_distance_m_mean == pytest.approx((0.5 + 5.0 + 0.1) / 3)
    aimless = closed_loop_metrics([episode([1.0, 1.0])], [True], [(0, 1)], 0)
    near = [ending((1.0, 1.015)), ending((1.0, 1.5)), ending((1.0, 1.002)), ending((1.0, 1.03))]
    found = closed_loop_metrics(near, [True] * 4, [(0, 2, 1)] * 4, 0)
    assert aimless.goal_distance_m_median is aimless.goal_distance_m_mean is None


def test_each_episode_has_a_chain_of_its_own():
    trajectory = episode([1.0] * 8, touch=6, distractor=7)
    for chain, strangers in (((0, 1), 1), ((0, 1, 2), 0)):
        found = closed_loop_metrics([trajectory], [True], [chain], 0)
        assert found.touched_bystanders == strangers
    touches, passes = episode([1.0] * 8, touch=6), episode([2.0] * 8)
    for chains, speed in (([(0, 1), (0, 1)], 1.0), ([(0, 2), (0, 1)], None)):
        found = closed_loop_metrics([touches, passes], [True] * 2, chains, 0)
        assert found.contact_speed_m_s == speed


def test_unmeasured_values_are_none():
    trajectory = replace(episode([1.0] * 8, touch=7), contact=None)
    found = closed_loop_metrics([trajectory], [False], [(0, 1)], 0)
    assert found.touched_bystanders is found.contact_speed_m_s is found.plan_ms_p99 is None
    assert found.slowest_before_contact_min_m_s is None
    assert found.success_rate == 0.0
