"""Controls of other sizes than the degrees of freedom: none at all, and a switch besides forces."""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model_scenes import DT, PRESETS, compiled, crowd, hinged, nodes_of, preset

from contactgraph.data import InvalidInputError, Scene
from contactgraph.model import ContactDynamics, LinearDynamics, ModelConfig, ModelState
from contactgraph.model.scene import check_fit

pytestmark = pytest.mark.usefixtures("double_precision")
CASES = [("recurrent", True), ("paper_literal", False)]


@cache
def stepped(name: str, hinges: bool, control: tuple[float, ...]) -> tuple[np.ndarray, ...]:
    """B of a step of a crowd under a control of this size, then the positions and velocities."""
    config = ModelConfig(2, len(control), DT, width=8, hinges=hinges)
    model = PRESETS[name](config, key=jax.random.key(0))
    nodes = hinged(nodes_of(3), (0.3, 0.2)) if hinges else nodes_of(3)
    state = crowd(model, nodes)

    def both(
        model: ContactDynamics, state: ModelState, control: jax.Array
    ) -> tuple[LinearDynamics, ModelState]:
        return model.linear_step(state, control, nodes)[0], model.step(state, control, nodes)

    linear, after = compiled(both, model, state, jnp.asarray(control))
    return np.asarray(linear.B), np.asarray(after.position), np.asarray(after.velocity)


@pytest.mark.parametrize(("name", "hinges"), CASES)
def test_components_beyond_the_degrees_of_freedom_move_nothing(name: str, hinges: bool) -> None:
    B, *alone = stepped(name, hinges, (3.0, -2.0))
    further, *with_switch = stepped(name, hinges, (3.0, -2.0, 1.0, 50.0))
    assert further.shape == (3, 2, 2, 4) and not np.any(further[..., 2:])
    np.testing.assert_allclose(further[..., :2], B, rtol=1e-12)
    assert np.any(B[0, 0, :, 0]) and np.any(B[0, 1, :, 1])
    np.testing.assert_allclose(with_switch, alone, rtol=1e-12)


@pytest.mark.parametrize(("name", "hinges"), CASES)
def test_without_control_all_moves_as_under_a_control_of_zero(name: str, hinges: bool) -> None:
    B, *passive = stepped(name, hinges, ())
    _, *still = stepped(name, hinges, (0.0, 0.0))
    _, *driven = stepped(name, hinges, (3.0, -2.0))
    assert B.shape == (3, 2, 2, 0)
    np.testing.assert_allclose(passive, still, rtol=1e-12)
    assert np.abs(np.subtract(driven, still)).max() > 1e-4


@pytest.mark.parametrize(
    ("name", "actuated", "size", "accepted"),
    [
        ("recurrent", True, 1, False),
        ("recurrent", True, 0, False),
        ("recurrent", False, 1, True),
        ("recurrent", False, 0, True),
        ("recurrent", True, 3, True),
        ("full_ab", True, 1, True),
    ],
)
def test_a_control_must_reach_every_degree_of_freedom_of_actuated_nodes(
    name: str, actuated: bool, size: int, accepted: bool
) -> None:
    model = dataclasses.replace(preset(name, width=8), control_size=size)
    scene = Scene(("a", "b"), ("a", "b"), np.array([actuated, False]), model.dt)
    if accepted:
        check_fit(model, scene, size, "the data")
    else:
        with pytest.raises(InvalidInputError, match=rf"control size U {size}; .* at least D = 2,"):
            check_fit(model, scene, size, "the data")
