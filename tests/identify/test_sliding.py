"""How the ground slows bodies that slide by themselves, from their motion alone."""

from functools import partial

import numpy as np
import pytest

from contactgraph.data import Scene, Trajectory
from contactgraph.envs import BilliardsTask, RestPolicy
from contactgraph.evaluate import collect
from contactgraph.identify import fit_slowing
from contactgraph.identify.shapes import centre_distances

DT, STEPS = 0.05, 40
ROUND = partial(centre_distances, boxes=False)


def test_discs_on_a_table_of_box2d_are_slowed_by_coulombs_friction() -> None:
    dataset = collect([partial(BilliardsTask, 3, passive=True)], [RestPolicy()], 6, 0)
    for deceleration, damper in fit_slowing(dataset, 0.1, ROUND).values():
        assert deceleration == pytest.approx(0.05 * 9.81, rel=0.01)
        assert damper == pytest.approx(0.0, abs=0.01)


def slides(*, pushed: bool) -> Trajectory:
    """A block slowed by 0.5 m/s^2 and 2 1/s; or pushed by a hand that slows down by 5 m/s^2."""
    speed = np.zeros(STEPS + 1)
    speed[0] = 1.0
    for step in range(STEPS):
        left = max(0.0, speed[step] - DT * (5.0 if pushed else 0.5))
        share = 0.0 if pushed else DT * 2.0 * left / max(speed[step], 1e-9)
        speed[step + 1] = left / (1.0 + share)
    block = np.stack([np.cumsum(DT * speed), np.zeros(STEPS + 1)], axis=1)
    behind = np.array([0.1, 0.0]) if pushed else np.array([2.0, 0.0])
    velocity = np.stack([speed, np.zeros(STEPS + 1)], axis=1)
    scene = Scene(("hand", "block"), ("hand", "block"), np.array([True, False]), DT)
    both = np.stack([block - behind, block], axis=1), np.stack([velocity, velocity], axis=1)
    return Trajectory(scene, *both, np.zeros((STEPS, 2)))


def test_bodies_that_stop_within_a_step_tell_how_fast_they_do() -> None:
    """At 4 m/s^2 and steps of 0.05 s a body of at most 0.4 m/s slides for two steps."""
    rng, stops = np.random.default_rng(0), []
    for _ in range(20):
        first = rng.uniform(0.05, 0.4)
        speed = np.maximum(first - 4.0 * DT * np.arange(STEPS + 1), 0.0)
        stops.append(alone(speed))
    deceleration, damper = fit_slowing(stops, 0.1, ROUND)["block"]
    assert deceleration + damper * 0.2 == pytest.approx(4.0, rel=0.05)


def alone(speed: np.ndarray) -> Trajectory:
    place = np.stack([np.cumsum(DT * speed), np.zeros_like(speed)], axis=1)[:, None]
    velocity = np.stack([speed, np.zeros_like(speed)], axis=1)[:, None]
    scene = Scene(("block",), ("block",), np.array([False]), DT)
    return Trajectory(scene, place, velocity, np.zeros((len(speed) - 1, 2)))


def test_both_laws_are_told_apart_and_a_pushed_body_tells_nothing() -> None:
    found = fit_slowing([slides(pushed=False), slides(pushed=True)], 0.1, ROUND)
    assert list(found) == ["block"]
    np.testing.assert_allclose(found["block"], (0.5, 2.0), rtol=0.02)
    assert not fit_slowing([slides(pushed=True)], 0.1, ROUND)


def test_a_body_that_glides_is_not_slowed_by_what_it_meets() -> None:
    """Fifteen steps of four hundred lose speed: no ground does that."""
    velocity = np.zeros((401, 1, 2))
    velocity[:, 0, 0] = np.where(np.arange(401) % 27 == 0, 0.4, 0.5)
    position = np.cumsum(0.05 * velocity, axis=0)
    scene = Scene(("puck",), ("puck",), np.zeros(1, bool), 0.05)
    glides = Trajectory(scene, position, velocity, np.zeros((400, 2)))
    assert not fit_slowing([glides], 0.1, ROUND)
