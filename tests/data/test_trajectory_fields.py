"""Optional fields of scenes and trajectories: each rule, and its message."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from contactgraph.data import (
    Dataset,
    InvalidInputError,
    Scene,
    Trajectory,
    strip_contacts,
    subsample,
    with_edge_labels,
    write_trajectories,
)
from contactgraph.data.dataset_file import REQUIRED

STEPS, NODES = 4, 3


def scene(dimension: int = 2, **fields: Any) -> Scene:
    names = ("hand", "box", "wall")
    return Scene(names, names, np.array([True, False, False]), 0.1, dimension, **fields)


def trajectory(of: Scene, control_size: int = 2, **fields: Any) -> Trajectory:
    state = np.zeros((STEPS + 1, NODES, of.dimension))
    return Trajectory(of, state, state, np.zeros((STEPS, control_size)), **fields)


def pairs(*steps: int) -> np.ndarray:
    """Hand and box hold each other at these steps."""
    value = np.zeros((STEPS + 1, NODES, NODES), dtype=bool)
    value[list(steps), 0, 1] = value[list(steps), 1, 0] = True
    return value


def quaternions() -> np.ndarray:
    """[T+1, N, 4] a quarter turn about z."""
    return np.tile([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], (STEPS + 1, NODES, 1))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"gravity": 0.0}, "gravity must have shape (D,) = (2,), found ()"),
        ({"anchor": np.full(3, np.nan)}, "anchor must have shape (N, D)"),
        ({"planes": 5}, "planes must have shape (P, D+1)"),
        ({"pins": [[0, 1]], "pin_points": []}, "pins and pin_points must be given together"),
        (
            {"polygons": [[[0, 0], [1, 0], [0, 1]]], "polygon_of": []},
            "polygons and polygon_of must be given together",
        ),
        ({"polygons": (), "polygon_of": [0]}, "polygons and polygon_of must be given together"),
    ],
)
def test_an_array_that_says_nothing_has_the_right_axes(fields: dict, message: str) -> None:
    """Of any sizes, since a part of a trajectory has fewer states."""
    with pytest.raises(InvalidInputError, match=re.escape(message)):
        scene(**fields)


def test_every_field_is_stored_in_its_type() -> None:
    of = scene(
        static=[0, 0, 1],
        control_kind=["position", "switch"],
        control_of=[[1, 1], [0, 0], [0, 0]],
        planes=[[0, 1, -1]],
        polygons=[[[0, 0], [0, 1], [1, 0]]],
        polygon_of=[1],
    )
    assert of.static.dtype == bool
    assert of.control_kind == ("position", "switch")
    assert of.control_of is not None and of.control_of.dtype == bool
    assert of.planes.dtype == np.float64
    assert of.polygons[0].dtype == np.float64
    assert of.polygon_of.tolist() == [1]
    run = trajectory(of, holding=pairs().astype(int), orientation=np.zeros((5, 3, 1), int))
    assert run.holding is not None and run.holding.dtype == bool
    assert run.orientation.dtype == np.float64


def test_what_is_not_given_has_no_rows_or_says_nothing(tmp_path: Path) -> None:
    plain = trajectory(scene())
    of = plain.scene
    assert of.planes.shape == (0, 3) and of.pins.shape == (0, 2) and of.polygons == ()
    assert not of.static.any() and not of.gravity.any() and not of.hinged.any()
    assert np.isnan(of.reach).all() and of.reach.shape == (NODES, 2, 2)
    assert np.isnan(plain.orientation).all() and plain.orientation.shape == (STEPS + 1, NODES, 1)
    assert repr(plain) == f"Trajectory(T={STEPS}, N={NODES}, D=2, U=2)"
    shorter = replace(
        plain,
        **{name: getattr(plain, name)[:3] for name in ("position", "velocity")},
        control=plain.control[:2],
    )
    assert shorter.orientation.shape == (3, NODES, 1)
    write_trajectories(tmp_path / "plain.h5", [plain])
    with h5py.File(tmp_path / "plain.h5") as file:
        stored = set(file["trajectories/000000"])
    assert stored == {*("position", "velocity", "control"), *REQUIRED, "metadata"}


def test_a_control_of_no_component_has_no_kind() -> None:
    of = scene(control_kind=(), control_of=np.zeros((NODES, 0)))
    assert trajectory(of, control_size=0).control_size == 0


def test_holding_may_be_recorded_without_contact() -> None:
    run = trajectory(scene(), holding=pairs(1))
    assert run.contact is None and run.holding is not None


def test_an_orientation_may_be_unknown_for_a_node_at_a_step() -> None:
    turning = quaternions()
    turning[2, 1] = np.nan
    run = trajectory(scene(3), orientation=turning, angular_velocity=turning[..., 1:])
    assert np.isnan(run.orientation[2, 1]).all()


def test_quaternions_have_length_1() -> None:
    turning = quaternions()
    turning[3, 2] *= -1.0009
    trajectory(scene(3), orientation=turning)
    turning[3, 2] *= 1.002
    with pytest.raises(InvalidInputError, match=r"length 1, .* for 'wall' at step 3"):
        trajectory(scene(3), orientation=turning)


def test_half_a_quaternion_is_refused() -> None:
    turning = quaternions()
    turning[1, 0, 3] = np.nan
    with pytest.raises(InvalidInputError, match=r"NaN throughout .* for 'hand' at step 1"):
        trajectory(scene(3), orientation=turning)


@pytest.mark.parametrize(
    ("dimension", "name", "width"),
    [(2, "orientation", 4), (3, "orientation", 1), (2, "angular_velocity", 3)],
)
def test_a_turn_has_the_width_of_its_space(dimension: int, name: str, width: int) -> None:
    wanted = {2: 1, 3: 4}[dimension]
    with pytest.raises(
        InvalidInputError, match=re.escape(f"(5, 3, {wanted}), found (5, 3, {width})")
    ):
        trajectory(scene(dimension), **{name: np.zeros((STEPS + 1, NODES, width))})


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"polygons": [[[0, 0], [2, 0], [0.2, 0.2], [0, 2]]], "polygon_of": [0]},
            "polygons[0] must be convex, found [[0.0, 0.0], [2.0, 0.0], [0.2, 0.2], [0.0, 2.0]]",
        ),
        (
            {"polygons": [[[0, 0], [1, 0]]], "polygon_of": [0]},
            "polygons[0] must have shape (V, D) = (V, 2) with V >= 3, found (2, 2)",
        ),
        (
            {"dimension": 3, "polygons": [[[0, 0], [1, 0], [0, 1]]], "polygon_of": [0]},
            "polygons[0] must have shape (V, D) = (V, 3) with V >= 3, found (3, 2)",
        ),
        (
            {"dimension": 3, "polygons": [np.eye(4, 3)[[0, 1, 3, 3]]], "polygon_of": [0]},
            "polygons in space must be at least 4 points that do not lie in a plane",
        ),
        (
            {"dimension": 1, "polygons": [[[0], [1], [2]]], "polygon_of": [0]},
            "2 or 3 dimensions, found 1",
        ),
        (
            {"dimension": 3, "pins": [[0, 1]], "pin_points": np.zeros((1, 2, 3))},
            "pins need a scene in the plane, found 3 dimensions",
        ),
        ({"pins": [0, 1], "pin_points": np.zeros((2, 2))}, "pins must have shape (J, 2), found"),
        (
            {"pins": [[0.5, 1.0]], "pin_points": np.zeros((1, 2, 2))},
            "pins must be integers, found float64",
        ),
        ({"dimension": 3, "planes": [[0, 1, 0]]}, "planes must have shape (P, D+1) = (P, 4)"),
        (
            {"anchor": [[0, 0], [0, np.nan], [0, 0]]},
            "anchor must be finite, or NaN throughout where it is not known, found [0.0, nan] for "
            "'box'",
        ),
        ({"candidate_edges": [[0, 1.5]]}, "candidate_edges must be integers, found float64"),
    ],
)
def test_what_a_scene_refuses(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=re.escape(message)):
        scene(**fields)


@pytest.mark.parametrize("turn", [1, -1])
def test_a_convex_outline_may_go_round_either_way_and_have_a_straight_corner(turn: int) -> None:
    outline = np.array([[0, 0], [1, 0], [2, 0], [2, 1], [0, 1]])[::turn]
    found = scene(polygons=(outline,), polygon_of=[2]).polygons
    assert found is not None and np.array_equal(found[0], outline)


def test_a_pair_that_held_within_a_longer_step_holds_in_it() -> None:
    angle = np.arange(15.0).reshape(5, 3, 1)
    run = trajectory(
        scene(),
        contact=pairs(1, 4),
        holding=pairs(1),
        orientation=angle,
        angular_velocity=2 * angle,
    )
    (longer,) = subsample(Dataset((run,)), 2)
    assert longer.holding is not None and longer.holding[:, 0, 1].tolist() == [False, True, False]
    assert longer.contact is not None and longer.contact[:, 0, 1].tolist() == [False, True, True]
    np.testing.assert_array_equal(longer.orientation, angle[[0, 2, 4]])
    np.testing.assert_array_equal(longer.angular_velocity, 2 * angle[[0, 2, 4]])


def test_labels_of_holding_are_stripped_with_those_of_contact() -> None:
    run = trajectory(scene(), contact=pairs(1), holding=pairs(1), orientation=np.zeros((5, 3, 1)))
    (stripped,) = strip_contacts(Dataset((run,)))
    assert stripped.contact is None and stripped.holding is None
    assert stripped.orientation is run.orientation


FIRST, SECOND = pairs(1, 2), pairs(1)


@pytest.mark.parametrize(
    ("recorded", "labels"),
    [
        ([(FIRST, pairs(2)), (SECOND, pairs())], [pairs(2), pairs()]),
        ([(FIRST, pairs()), (SECOND, pairs())], [FIRST, SECOND]),
        ([(FIRST, pairs(2)), (None, None)], [FIRST, None]),
        ([(None, pairs(3))], [pairs(3)]),
    ],
    ids=["a pair holds", "nothing ever holds", "one lacks holding", "contact is not recorded"],
)
def test_an_edge_is_labelled_by_holding_where_all_know_it_and_some_pair_holds(
    recorded: list, labels: list
) -> None:
    runs = (trajectory(scene(), contact=touch, holding=hold) for touch, hold in recorded)
    for found, expected in zip(with_edge_labels(Dataset(tuple(runs))), labels, strict=True):
        np.testing.assert_array_equal(found.contact, expected)
