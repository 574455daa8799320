"""The arm's pickup without a simulator: for arms that are no simulation."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph_franka.envs.expert import FrankaExpert
from contactgraph_franka.envs.pickup import is_success, pickup_scene

GOAL = np.array([0.5, 0.2, 0.3])


def test_expert_and_layout_need_no_simulator() -> None:
    script = (
        "import sys; sys.modules['mujoco'] = None\n"
        "from contactgraph_franka.envs.expert import FrankaExpert\n"
        "from contactgraph_franka.envs.pickup import sample_layout"
    )
    subprocess.run([sys.executable, "-c", script], check=True)


def test_the_expert_pushes_as_the_hand_is_heavy() -> None:
    observation = {
        "position": np.array([[0.4, -0.2, 0.2], [0.5, 0.0, 0.05]]),
        "velocity": np.zeros((2, 3)),
        "goal": GOAL,
    }
    scene, forces = pickup_scene(0.01, GOAL, block_mass=0.4), []
    assert scene.mass is not None
    for mass in (None, np.array([4.0, 0.4]), np.array([8.0, 0.4])):
        expert = FrankaExpert(noise=0.0)
        expert.reset(replace(scene, mass=mass), 0)
        forces.append(np.stack([expert(observation) for _ in range(3)])[2])
    np.testing.assert_array_equal(forces[0], forces[1])
    assert np.linalg.norm(forces[2] - forces[1]) > 0.1


@pytest.mark.parametrize(
    ("hand", "block", "yes"),
    [
        (GOAL, GOAL, True),
        (GOAL + np.array([0.0, 0.0, 0.029]), GOAL, True),
        (GOAL + np.array([0.0, 0.0, 0.031]), GOAL, False),
        (GOAL + np.array([0.0, 0.049, 0.0]), GOAL + np.array([0.0, 0.049, 0.0]), True),
        (GOAL + np.array([0.0, 0.051, 0.0]), GOAL + np.array([0.0, 0.051, 0.0]), False),
    ],
)
def test_brought_is_near_the_goal_and_held(hand: np.ndarray, block: np.ndarray, yes: bool) -> None:
    assert is_success(np.stack([hand, block]), GOAL) == yes
    with pytest.raises(InvalidInputError, match="a hand and a block"):
        is_success(hand[None], GOAL)
