"""Numbers of types that data tell before training."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from contactgraph.data.impact_fit import PLANE, Impacts
from contactgraph.model import ModelConfig, bodies
from contactgraph.model.body_head import BodyHead
from contactgraph.model.body_numbers import PACE
from contactgraph.model.body_starts import told_numbers

TYPES = ("ball", "puck", "cue")
NAMES = (*TYPES, PLANE)


def head(impacts: dict[tuple[str, str], Impacts]) -> BodyHead:
    config = ModelConfig(2, 2, 0.05, 0.1, width=4, node_types=TYPES, impacts=impacts)
    made = bodies(config, key=jax.random.key(0)).local_dynamics.head
    assert isinstance(made, BodyHead)
    return made


def sums(raw: np.ndarray, pair: tuple[str, str]) -> float:
    return PACE * float(sum(np.asarray(raw)[NAMES.index(name)] for name in pair))


SEEN = {
    ("ball", "puck"): Impacts(0.8, 0.3, 0.25),
    ("ball", PLANE): Impacts(0.5, 0.1, None),
    ("puck", PLANE): Impacts(0.5, None, None),
}


def test_pairs_start_with_what_they_show() -> None:
    made = head(SEEN)
    for pair, each in SEEN.items():
        bounce = 1.0 / (1.0 + np.exp(3.0 - sums(made.bounce_raw, pair)))
        assert bounce == pytest.approx(each.bounce, rel=1e-5), pair
        if each.friction is not None:
            friction = np.log1p(np.exp(sums(made.friction_raw, pair) - 4.0))
            assert friction == pytest.approx(each.friction, rel=1e-4), pair
    ball, puck, cue = np.exp(PACE * np.asarray(made.log_mass))
    assert ball / puck == pytest.approx(0.25, rel=1e-5)
    assert cue == pytest.approx(1.0)


def test_what_all_types_show_is_not_learned() -> None:
    slides = {"ball": (1.0, 0.0), "puck": (2.0, 0.0)}
    met = ("ball", "puck"), ("ball", "cue")
    impacts = dict.fromkeys(met, Impacts(0.8, 0.3, None))
    slowing = ("deceleration_raw", "damper_raw")
    assert told_numbers(slides, impacts, TYPES, np.inf) == (*slowing, "bounce_raw", "friction_raw")
    quick = slides | {"puck": (2.0, 50.0)}
    assert told_numbers(quick, impacts, TYPES, 10.0) == ("bounce_raw", "friction_raw")
    impacts[met[0]] = Impacts(0.8, None, None)
    assert told_numbers({"ball": (1.0, 0.0)}, impacts, TYPES, np.inf) == ("bounce_raw",)
    assert told_numbers({}, {met[0]: Impacts(0.8, 0.3, None)}, TYPES, np.inf) == ()

    def laws(head: BodyHead) -> jax.Array:
        types = jnp.eye(3)
        each = (*head.laws(types, jnp.array([0]), jnp.array([1])), *head.slowing(types))
        return jnp.stack([jnp.sum(one) for one in each]) @ jnp.ones(4)

    learned = head({})
    gradient = eqx.filter_grad(laws)
    names = (*slowing, "bounce_raw", "friction_raw")
    kept = head(dict.fromkeys(met, Impacts(0.8, 0.3, None)))
    assert all(np.any(getattr(gradient(learned), name)) for name in names)
    assert [np.any(getattr(gradient(kept), name)) for name in names] == [True, True, False, False]


def test_a_type_that_is_not_seen_is_like_the_others() -> None:
    made, fresh = head(SEEN), head({})
    between_others = sums(made.bounce_raw, ("ball", "puck"))
    assert sums(made.bounce_raw, ("cue", "cue")) == pytest.approx(between_others, rel=1e-5)
    assert sums(fresh.bounce_raw, ("cue", "cue")) == 0.0
    np.testing.assert_array_equal(fresh.log_mass, 0.0)
