"""Bounce, friction and ratios of masses, from the motion of discs alone."""

from functools import partial

import numpy as np
import pytest

from contactgraph.data import Dataset, Scene, Trajectory
from contactgraph.envs import BilliardsTask, DoorExpert, DoorTask, RestPolicy, StrikingPolicy
from contactgraph.evaluate import collect
from contactgraph.identify import fit_actuation, fit_impacts, identify
from contactgraph.model import ActuationFit
from contactgraph.model.presets import PLANE


@pytest.mark.usefixtures("engine")
def test_simulated_discs_tell_the_laws_they_follow() -> None:
    dataset = collect([partial(BilliardsTask, 5, passive=True)], [RestPolicy()], 30, 0)
    found = fit_impacts(dataset, {})
    assert {("ball", "puck"), ("ball", PLANE), ("puck", PLANE)} <= set(found)
    for pair, laws in found.items():
        assert laws.bounce == pytest.approx(0.9, abs=0.03), pair
        if laws.friction is not None:
            assert laws.friction == pytest.approx(0.0 if PLANE in pair else 0.1, abs=0.02), pair
    assert found["ball", "puck"].mass_ratio == pytest.approx(1.0 / 3.0, rel=0.1)
    assert found["ball", PLANE].mass_ratio is None


def test_a_force_on_a_body_is_not_taken_for_an_impact() -> None:
    dataset = collect([partial(BilliardsTask, 2)], [StrikingPolicy()], 30, 0)
    actuation = fit_actuation(dataset, 0.55)
    laws = fit_impacts(dataset, actuation)["ball", "cue"]
    assert laws.bounce == pytest.approx(0.9, abs=0.05)
    assert laws.friction == pytest.approx(0.1, abs=0.03)
    assert laws.mass_ratio == pytest.approx(0.5, rel=0.1)


def strike(speed: float) -> Trajectory:
    """A puck of 1 kg meets a hand of 2 kg in the middle of a step, and bounces by 0.6; a third
    body goes past at 1 m/s."""
    before = speed * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    center = speed / 3.0
    after = before + 1.6 * center * np.array([[1.0, 0.0], [-2.0, 0.0], [0.0, 0.0]])
    before[2, 1] = after[2, 1] = 1.0
    place = np.array([[0.1, 0.0], [0.0, 0.0], [1.0, 0.0]])
    position = np.stack([place - 0.05 * before, place + 0.05 * after])
    names = ("hand", "puck", "other")
    scene = Scene(names, names, np.array([True, False, False]), 0.1)
    return Trajectory(scene, position, np.stack([before, after]), np.zeros((1, 2)))


def test_what_a_servo_moves_tells_nothing() -> None:
    strikes = [strike(speed) for speed in np.linspace(0.3, 1.0, 10)]
    force = ActuationFit(np.eye(2), np.zeros(2), 0.0, 0.0, 0.0)
    servo = ActuationFit(np.eye(2), np.zeros(2), 100.0, 20.0, 0.0)
    (laws,) = fit_impacts(strikes, {"hand": force}).values()
    assert laws.bounce == pytest.approx(0.6, abs=1e-6)
    assert laws.mass_ratio == pytest.approx(2.0)
    assert laws.friction is None
    assert not fit_impacts(strikes, {"hand": servo})
    assert not fit_impacts(strikes[1:], {"hand": force})


def test_a_hinged_body_is_not_taken_for_a_point() -> None:
    """A door does not bounce off the gripper, but its centre is not where it is struck."""
    doors = collect([DoorTask], [DoorExpert()], episodes=40, seed=0)
    assert doors[0].scene.hinged.any()
    assert not fit_impacts(doors, fit_actuation(doors, 0.55))
    assert not identify(Dataset(tuple(doors))).config.slowing, (
        "its middle slows down because it turns"
    )
