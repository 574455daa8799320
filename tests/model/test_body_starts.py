"""Numbers of types that data tell before training."""

import jax
import numpy as np
import pytest

from contactgraph.data.impact_fit import PLANE, Impacts
from contactgraph.model import ModelConfig, bodies
from contactgraph.model.body_head import PACE, BodyHead

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


def test_a_type_that_is_not_seen_is_like_the_others() -> None:
    made, fresh = head(SEEN), head({})
    between_others = sums(made.bounce_raw, ("ball", "puck"))
    assert sums(made.bounce_raw, ("cue", "cue")) == pytest.approx(between_others, rel=1e-5)
    assert sums(fresh.bounce_raw, ("cue", "cue")) == 0.0
    np.testing.assert_array_equal(fresh.log_mass, 0.0)
