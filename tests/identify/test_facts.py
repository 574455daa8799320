"""Model and training defaults derived from trajectories."""

from dataclasses import replace

import numpy as np
import pytest

from contactgraph.data import Dataset, InvalidInputError, Scene, Trajectory
from contactgraph.identify import identify, scene_facts


def trajectories(*scenes: Scene) -> Dataset:
    def still(scene: Scene) -> Trajectory:
        shape = 3, scene.node_count, scene.dimension
        return Trajectory(scene, np.zeros(shape), np.zeros(shape), np.zeros((2, scene.dimension)))

    return Dataset(tuple(still(scene) for scene in scenes))


def scene(**metadata: float) -> Scene:
    return Scene(
        ("hand", "block"), ("hand", "block"), np.array([1, 0], bool), 0.1, metadata=metadata
    )


def test_the_contact_distance_is_learned_without_a_given_one() -> None:
    found = scene_facts(trajectories(scene()))
    assert found.config.contact_distance == 0.085 and found.config.learned_contact_distance
    assert (found.config.hinges, found.rollout_from) == (False, 0.5)


def test_a_given_distance_is_kept() -> None:
    given = trajectories(scene(contact_distance=0.02), scene(contact_distance=0.02))
    found = scene_facts(given).config
    assert (found.contact_distance, found.learned_contact_distance) == (0.02, False)


def test_weight_and_hinges_are_detected_in_any_trajectory() -> None:
    heavy = replace(scene(), gravity=np.array([0.0, -9.81]))
    hinged = replace(scene(), anchor=np.array([[np.nan, np.nan], [0.0, 0.0]]))
    found = scene_facts(trajectories(scene(), heavy, hinged))
    assert found.config.hinges and found.rollout_from == 0.0
    light = trajectories(replace(scene(), gravity=np.zeros(2)))
    assert scene_facts(light).rollout_from == 0.5


def test_planes_stop_only_the_types_that_stay_before_them() -> None:
    walled = replace(scene(), planes=np.array([[1.0, 0.0, 0.0]]))
    position = np.zeros((201, 2, 2))
    position[:, 0, 0] = np.linspace(-0.03, 0.4, 201)  # the hand passes the plane
    position[:, 1, 0] = np.linspace(0.05, 0.4, 201)
    moved = Trajectory(walled, position, np.zeros_like(position), np.zeros((200, 2)))
    found = identify(Dataset((moved,))).config.plane_distance
    assert found["hand"] == -0.03 and 0.05 <= found["block"] < 0.06


SQUARE = 0.05 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])


def slides(floor: bool, turns: float) -> Trajectory:
    """A box that 4 m/s^2 stop, and that turns by ``turns`` [rad] in all; with a ``floor``, a plane
    and gravity do."""
    time = 0.02 * np.arange(26.0)
    position = np.stack([2.0 * time - 2.0 * time**2, np.full(26, 0.05)], axis=-1)[:, None]
    velocity = np.stack([2.0 - 4.0 * time, np.zeros(26)], axis=-1)[:, None]
    ground = {"planes": np.array([[0.0, 1.0, 0.0]]), "gravity": np.array([0.0, -9.81])}
    shape = {"polygons": (SQUARE,), "polygon_of": np.zeros(1, int)}
    of_box = Scene(("a",), ("box",), np.zeros(1, bool), 0.02, **shape, **(ground if floor else {}))
    angle = np.linspace(0.0, turns, 26)[:, None, None]
    rate = np.full_like(angle, turns / 0.5)
    control = np.zeros((25, 0))
    return Trajectory(of_box, position, velocity, control, orientation=angle, angular_velocity=rate)


def test_the_friction_of_planes_slows_boxes_that_lie_on_them_once() -> None:
    free, borne = (identify(Dataset((slides(floor, 0.1),))).config for floor in (False, True))
    assert free.slowing["box"][0] == pytest.approx(4.0, rel=0.01)
    assert borne.slowing == {} and borne.inertia == free.inertia == {"box": 1.0}


def test_boxes_on_planes_have_outlines_even_where_they_never_turn() -> None:
    free, borne = (identify(Dataset((slides(floor, 0.0),))).config for floor in (False, True))
    assert free.turn_length is None and free.inertia == {}
    assert borne.contact_distance == pytest.approx(0.1) and not borne.learned_contact_distance
    assert borne.turn_length == pytest.approx(0.1 / 6**0.5) and borne.inertia == {"box": 1.0}


@pytest.mark.parametrize("wrong", [0.0, -1.0, float("inf"), "near"])
def test_a_distance_that_is_none_is_refused(wrong) -> None:
    with pytest.raises(InvalidInputError, match="contact_distance must be positive metres"):
        scene_facts(trajectories(scene(contact_distance=wrong)))


def test_trajectories_must_not_contradict_each_other() -> None:
    with pytest.raises(InvalidInputError, match="the same in all trajectories"):
        scene_facts(trajectories(scene(contact_distance=0.02), scene(contact_distance=0.03)))


def followed(kind: str, count: int = 40) -> Trajectory:
    """v' = 0.3 v + 16 u along both axes, with steps of 0.04 s."""
    control = np.random.default_rng(0).normal(size=(count, 2))
    velocity = np.zeros((count + 1, 2, 2))
    for step in range(count):
        velocity[step + 1, 0] = 0.3 * velocity[step, 0] + 16.0 * control[step]
    kinds = replace(scene(), dt=0.04, control_kind=(kind, kind))
    return Trajectory(kinds, np.zeros_like(velocity), velocity, control)


def test_a_component_that_drives_no_node_is_refused_for_bodies() -> None:
    given = followed("displacement")
    undriven = replace(given.scene, control_of=np.array([[True, False], [False, False]]))
    with pytest.raises(InvalidInputError, match="trajectory 0: component 1 of the control, which"):
        identify(Dataset((replace(given, scene=undriven),)))


def test_a_distance_of_the_callers_takes_the_place_of_the_datas() -> None:
    """From there it is learned, but where velocities are means over a step."""
    follows = followed("displacement")
    moved = np.cumsum(0.04 * follows.velocity, axis=0)
    own = identify(Dataset((replace(follows, position=moved),)), contact_distance=0.05)
    assert own.in_data.contact_distance == pytest.approx(0.05)
    assert own.config.averaged and not own.config.learned_contact_distance
    kept = trajectories(scene(contact_distance=0.02))
    given = scene_facts(kept).with_contact_distance(0.05)
    assert given.config.contact_distance == 0.05 and given.config.learned_contact_distance
    assert not scene_facts(kept).config.learned_contact_distance
