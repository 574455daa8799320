"""Cost files: an exact round trip, and one line of error when damaged."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from contactgraph.control import (
    CostTerm,
    LearnedContact,
    LearnedCost,
    TaskNode,
    cost_terms,
    describe_cost,
    read_cost,
    write_cost,
)
from contactgraph.control.learned_cost import relative_basis
from contactgraph.data import InvalidInputError

MADE = {"model": "pickup", "seed": 3, "recipe": {"steps": 20, "discount": 0.8}, "goal": [0.1, 2]}


def a_cost() -> LearnedCost:
    """Of two nodes in the plane, with numbers that no decimal is equal to."""
    rng = np.random.default_rng(0)
    L, Lu = rng.normal(size=(8, 8)), np.eye(2) + 0.3 * rng.normal(size=(2, 2))
    Q, R = jnp.asarray(L @ L.T), jnp.asarray(Lu @ Lu.T)
    return LearnedCost(
        Q=0.5 * (Q + Q.T),
        R=0.5 * (R + R.T),
        goal=jnp.asarray(rng.normal(size=2)),
        nodes=jnp.asarray([2, 0], jnp.int32),
        kept_nodes=("gripper", "Öl-Kanne"),
        imitation_loss=jnp.asarray(rng.exponential(size=20)),
        task_nodes=(
            TaskNode("gripper", True, 3, 2, 0.8),
            TaskNode("Öl-Kanne", False, 3, 3, 0.85),
            TaskNode("lamp", False, 2, 0, None),
        ),
        contacts=(
            LearnedContact("touch", ("gripper", "Öl-Kanne"), 0.1),
            LearnedContact("hold", ("Öl-Kanne", "gripper"), 3.0),
        ),
    )


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "cost.json"
    write_cost(path, a_cost(), MADE)
    return path


def test_a_written_cost_is_read_unchanged(path: Path) -> None:
    wanted, found = a_cost(), read_cost(path)
    for name in ("Q", "R", "goal", "nodes", "imitation_loss"):
        one, other = getattr(wanted, name), getattr(found, name)
        assert one.dtype == other.dtype
        assert np.array_equal(one, other), name
    assert found.kept_nodes == wanted.kept_nodes
    assert found.task_nodes == wanted.task_nodes
    assert found.contacts == wanted.contacts
    assert describe_cost(path)[1] == MADE


def test_what_was_read_is_written_to_the_same_bytes(path: Path, tmp_path: Path) -> None:
    content = json.loads(path.read_text(encoding="utf-8"))
    assert (content["format"], content["format_version"]) == ("contactgraph-cost", 2)
    again = tmp_path / "again.json"
    write_cost(again, read_cost(path), MADE)
    assert again.read_bytes() == path.read_bytes()
    assert sorted(each.name for each in tmp_path.iterdir()) == ["again.json", "cost.json"]


def test_its_contacts_are_about_its_nodes_of_a_scene(path: Path) -> None:
    (found,) = read_cost(path).quadratic(4).contacts
    assert found.pairs.tolist() == [[2, 0], [0, 2]] and found.kind.tolist() == [1, 2]
    np.testing.assert_allclose(found.weight, [0.1, 3.0])


def test_weights_of_a_file_may_vary_over_time(path: Path, tmp_path: Path) -> None:
    """As many states as controls and one more; the terms of the first step are told."""
    content, one = json.loads(path.read_text()), a_cost()
    factors = [1.0, 2.0, 3.0]
    content["Q"] = [(k * np.asarray(one.Q, float)).tolist() for k in factors]
    content["R"] = [(k * np.asarray(one.R, float)).tolist() for k in factors[:2]]
    content["contacts"][1]["weight"] = [4.0, 5.0]
    path.write_text(json.dumps(content))
    found = read_cost(path)
    whole, (contacts,) = found.quadratic(4), found.quadratic(4).contacts
    Q, R, _ = whole.over(2)
    np.testing.assert_allclose(Q, np.multiply.outer(factors, one.quadratic(4).Q), rtol=1e-5)
    np.testing.assert_allclose(R, np.multiply.outer(factors[:2], one.R), rtol=1e-5)
    np.testing.assert_allclose(contacts.weight, [[0.1, 4.0], [0.1, 5.0]])
    with pytest.raises(InvalidInputError, match="Q must have 5 matrices for 4 steps, found 3"):
        whole.over(4)
    steady = tuple((each.position, each.velocity) for each in cost_terms(one))
    varying = [(each.position, each.velocity) for each in cost_terms(found)]
    np.testing.assert_allclose(varying, steady, rtol=1e-5)
    write_cost(tmp_path / "again.json", found, MADE)
    assert np.array_equal(read_cost(tmp_path / "again.json").Q, found.Q)
    content["Q"][1] = negative(content["Q"][1])
    path.write_text(json.dumps(content))
    assert refusal(path).startswith("step 1: field 'Q' must be positive semi-definite")


def test_unknown_fields_are_left_alone(path: Path) -> None:
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "colour": ["green"]}))
    assert np.array_equal(read_cost(path).Q, a_cost().Q)


def refusal(path: Path) -> str:
    """What is said of a file, in one line, after its name."""
    with pytest.raises(InvalidInputError) as error:
        read_cost(path)
    said = str(error.value)
    assert said.startswith(f"{path}: ") and "\n" not in said and len(said) < 400
    return said.removeprefix(f"{path}: ")


def second(**changes: Any) -> Callable[[list[dict]], list[dict]]:
    """Of a list, with these fields of its second entry."""
    return lambda entries: [entries[0], {**entries[1], **changes}, *entries[2:]]


def negative(matrix: list[list[float]]) -> list[list[float]]:
    values, vectors = np.linalg.eigh(np.asarray(matrix))
    values[0] = -0.25  # beyond rounding
    return (vectors * values @ vectors.T).tolist()


ROW = [1.0] * 8


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"format": "contactgraph-model"}, "must be a cost file, whose 'format' is 'contactgr"),
        ({"format_version": 1}, "field 'format_version' must be 2, found 1"),
        ({"format_version": 3}, "field 'format_version' must be 2, found 3"),
        ({"format_version": True}, "field 'format_version' must be 2, found True"),
        ({"dimension": 3}, "field 'goal' must be 3 numbers, found 2"),
        ({"dimension": 0}, "field 'dimension' must be a whole number of at least 1, found 0"),
        ({"dimension": 2.0}, "field 'dimension' must be a whole number of at least 1, found 2.0"),
        ({"Q": None}, "field 'Q' must be 8 x 8 numbers, found None"),
        ({"Q": [ROW] * 7}, "field 'Q' must be 8 x 8 numbers, found 7 x 8"),
        ({"Q": [ROW] * 7 + [ROW[1:]]}, "field 'Q' must be 8 x 8 numbers, found 8"),
        ({"Q": [ROW] * 7 + [[*ROW[1:], "1"]]}, "field 'Q[7][7]' must be a finite number, found '1"),
        ({"Q": [[*ROW[1:], True]] + [ROW] * 7}, "field 'Q[0][7]' must be a finite number, found T"),
        ({"Q": [[10**400, *ROW[1:]]] + [ROW] * 7}, "field 'Q[0][0]' must be a finite number, foun"),
        ({"Q": [[1e31, *ROW[1:]]] + [ROW] * 7}, "field 'Q[0][0]' must be a finite number, found 1"),
        (
            {"Q": [[0.0] * 7 + [1.0]] + [[0.0] * 8] * 7},
            "field 'Q' must be symmetric, found 1 in row 0, column 7 and 0 the other way round",
        ),
        ({"Q": negative}, "field 'Q' must be positive semi-definite, but its smallest eigenvalue "),
        ({"R": []}, "field 'R' must be rows of numbers, as many as columns, found []"),
        ({"R": [[1.0, 0.0]]}, "field 'R' must be 1 x 1 numbers, found 1 x 2"),
        ({"R": [[1.0, 0.1], [0.0, 1.0]]}, "field 'R' must be symmetric, found 0.1 in row 0, colum"),
        ({"R": [[1.0, 1.0], [1.0, 1.0]]}, "field 'R' must be positive definite, but its smallest "),
        ({"R": negative}, "field 'R' must be positive definite, but its smallest eigenvalue is -0"),
        ({"goal": [0.0]}, "field 'goal' must be 2 numbers, found 1"),
        ({"goal": "here"}, "field 'goal' must be 2 numbers, found 'here'"),
        ({"nodes": [0, 0]}, "field 'nodes' must be 2 different whole numbers from 0 on, found [0,"),
        ({"nodes": [0, -1]}, "field 'nodes' must be 2 different whole numbers from 0 on, found [0"),
        ({"nodes": [0, 2**31]}, "field 'nodes' must be 2 different whole numbers from 0 on, found"),
        ({"nodes": [0]}, "field 'nodes' must be 2 different whole numbers from 0 on, found [0]"),
        ({"kept_nodes": ["a", "a"]}, "field 'kept_nodes' must be different names, at least one, f"),
        ({"kept_nodes": []}, "field 'kept_nodes' must be different names, at least one, found []"),
        ({"kept_nodes": [{}, 1]}, "field 'kept_nodes' must be different names, at least one, foun"),
        ({"kept_nodes": ["a"]}, "field 'Q' must be 4 x 4 numbers, found 8 x 8"),
        ({"task_nodes": {}}, "field 'task_nodes' must be a list of objects, found {}"),
        ({"task_nodes": [{}]}, "task_nodes[0]: field 'trajectories' is missing"),
        ({"history": []}, "field 'history' must be an object, found []"),
        ({"history": {}}, "history: field 'imitation' is missing"),
        (
            {"history": {"imitation": []}},
            "history: field 'imitation' must be 1 or more numbers, found 0",
        ),
        ({"contacts": {}}, "field 'contacts' must be a list of objects, found {}"),
        ({"contacts": [{}]}, "contacts[0]: field 'kind' is missing"),
        (
            {"contacts": second(kind="push")},
            "contacts[1]: field 'kind' must be avoid, touch, hold, found 'push'",
        ),
        (
            {"contacts": second(nodes=["gripper", "lamp"])},
            "contacts[1]: field 'nodes' must be two of gripper, Öl-Kanne, found gripper, lamp",
        ),
        (
            {"contacts": second(weight=-1)},
            "contacts[1]: field 'weight' must be at least 0, found -1",
        ),
        ({"made": "by hand"}, "field 'made' must be an object, found 'by hand'"),
        ({"task_nodes": second(name="")}, "task_nodes[1]: field 'name' must be a text, found ''"),
        (
            {"task_nodes": second(actuated=1)},
            "task_nodes[1]: field 'actuated' must be true or false, found 1",
        ),
        (
            {"task_nodes": second(trajectories=-1)},
            "task_nodes[1]: field 'trajectories' must be a whole number of at least 0, found -1",
        ),
        (
            {"task_nodes": second(first_contact_time_s=None)},
            "task_nodes[1]: field 'first_contact_time_s' must be a finite number, found None",
        ),
    ],
)
def test_wrong_fields_are_named(path: Path, change: dict[str, Any], said: str) -> None:
    content = json.loads(path.read_text())
    for name, value in change.items():
        content[name] = value(content[name]) if callable(value) else value
    path.write_text(json.dumps(content))
    assert refusal(path).startswith(said)


@pytest.mark.parametrize(
    "name",
    [
        *("format", "format_version", "dimension", "kept_nodes", "nodes"),
        *("goal", "Q", "R", "task_nodes", "contacts", "made", "history"),
    ],
)
def test_missing_fields_are_named(path: Path, name: str) -> None:
    content = json.loads(path.read_text())
    del content[name]
    path.write_text(json.dumps(content))
    assert f"'{name}'" in refusal(path)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"\x89HDF\r\n",
        b"[]",
        b"1",
        b'{"Q": NaN}',
        b"[" * 100_000,
        b"1" * 5000,
        b'{"format": "contactgraph-cost", "format_version": 2, "kept_nodes": '
        + b"[" * 900
        + b"]" * 900
        + b"}",
    ],
)
def test_other_files(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    refusal(path)


def test_no_file(tmp_path: Path) -> None:
    assert refusal(tmp_path / "none.json").startswith("does not exist")
    assert "must be a file, found a folder" in refusal(tmp_path)


def test_an_unreadable_cost_is_not_written(tmp_path: Path) -> None:
    path, cost = tmp_path / "cost.json", a_cost()
    for wrong, said in (
        (replace(cost, Q=-cost.Q), "'Q' must be positive semi-definite"),
        (replace(cost, R=cost.R.at[0, 0].set(jnp.nan)), r"'R\[0\]\[0\]' must be a finite number"),
        (replace(cost, kept_nodes=("a", "a")), "'kept_nodes' must be different names"),
    ):
        with pytest.raises(InvalidInputError, match=said):
            write_cost(path, wrong)
    for made in ({"model": object()}, {"seconds": float("nan")}, {1: "one"}, {"goal": (1, 2)}):
        with pytest.raises(InvalidInputError, match="made must hold only JSON values"):
            write_cost(path, cost, made)
    with pytest.raises(InvalidInputError, match=r"folder .* does not exist"):
        write_cost(tmp_path / "none" / "cost.json", cost)
    assert list(tmp_path.iterdir()) == []


def test_terms_in_newtons() -> None:
    """Of a cost built from its terms: 9 and 25 on positions, 4 and 0 on velocities; R = 4."""
    T = relative_basis(2, 2)
    W = np.diag([9.0, 9.0, 4.0, 4.0, 25.0, 25.0, 0.0, 0.0])
    W[0, 4] = W[4, 0] = 3.0  # what ties terms together is neither's strength
    cost = replace(a_cost(), Q=jnp.asarray(T.T @ W @ T), R=4.0 * jnp.eye(2))
    assert cost_terms(cost) == (
        CostTerm("gripper - Öl-Kanne", pytest.approx(1.5), pytest.approx(1.0)),
        CostTerm("Öl-Kanne - goal", pytest.approx(2.5), pytest.approx(0.0, abs=1e-3)),
    )
