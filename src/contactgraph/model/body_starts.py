"""Numbers of the types of a `ContactLaw` that trajectories tell before any training."""

from collections.abc import Iterable, Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from contactgraph.data.impact_fit import PLANE, Impacts
from contactgraph.model.body_types import DECELERATION, PACE
from contactgraph.model.contact_law import ContactLaw

_LEAST, _MOST = 1e-3, 0.99
"""Of bounce and friction."""


def with_shapes(
    head: ContactLaw,
    plane_distance: Mapping[str, float],
    inertia: Mapping[str, float | Sequence[float]],
    types: Sequence[str],
) -> ContactLaw:
    """With this ``plane_distance`` and ``inertia``, see `ModelConfig`."""
    near = [plane_distance.get(name, 0.5 * head.length) for name in types]
    head = eqx.tree_at(lambda each: each.plane_distance, head, jnp.array(near))
    if head.log_inertia is None:
        return head
    known = [np.broadcast_to(inertia.get(name, 1.0), head.log_inertia.shape[1:]) for name in types]
    return eqx.tree_at(lambda each: each.log_inertia, head, jnp.log(jnp.array(known)) / PACE)


def with_slowing(head: ContactLaw, slowing: Sequence[tuple[float, float]]) -> ContactLaw:
    """With these decelerations, m/s^2, and dampers, 1/s, by the ground, of each type."""
    by_unit = np.array(slowing) / [DECELERATION * head.speed, 1.0]
    raw = _inverse_softplus(np.maximum(by_unit, np.log1p(np.exp(-6.0)))) + 6.0
    deceleration, damper = raw.T / PACE
    return _with(head, deceleration_raw=deceleration, damper_raw=damper)


def with_impacts(
    head: ContactLaw, impacts: Mapping[tuple[str, str], Impacts], types: tuple[str, ...]
) -> ContactLaw:
    """With masses, bounce and friction that fit what pairs of types show, by least squares.

    Those of pairs are sums of what each type has, and a type that is not seen has what the others
    have on average.
    """
    names = (*types, PLANE)
    pairs = {pair: each for pair, each in impacts.items() if set(pair) <= set(names)}
    ratios = {pair: np.log(each.mass_ratio) for pair, each in pairs.items() if each.mass_ratio}
    bounce = {pair: _logit(each.bounce) + 3.0 for pair, each in pairs.items()}
    friction = {
        pair: float(_inverse_softplus(max(each.friction, _LEAST))) + 4.0
        for pair, each in pairs.items()
        if each.friction is not None
    }
    start = PACE * np.append(head.log_mass, 0.0)
    log_mass = _fitted(start, _rows(ratios, names, -1.0), ratios.values())[:-1]
    log_mass = log_mass - log_mass.min()  # Ratios alone are seen: the lightest has the start's.
    return _with(
        head,
        log_mass=log_mass / PACE,
        bounce_raw=_shares(PACE * np.asarray(head.bounce_raw), bounce, names) / PACE,
        friction_raw=_shares(PACE * np.asarray(head.friction_raw), friction, names) / PACE,
    )


def told_numbers(
    slowing: Mapping[str, tuple[float, float]],
    impacts: Mapping[tuple[str, str], Impacts],
    types: Sequence[str],
    most_damped: float,
) -> tuple[str, ...]:
    """`ContactLaw.told`: of ``slowing`` seen of all ``types`` but the last, which is actuated, by
    dampers below ``most_damped`` [1/s], and of ``impacts`` that all take part in."""
    seen = {name for name, (_, damper) in slowing.items() if damper < most_damped}
    slides = bool(seen) and seen >= set(types[:-1])
    met = {name for pair in impacts for name in pair}
    rubbed = {name for pair, each in impacts.items() if each.friction is not None for name in pair}
    return (
        *(("deceleration_raw", "damper_raw") if slides else ()),
        *(("bounce_raw",) if met and met >= set(types) else ()),
        *(("friction_raw",) if rubbed and rubbed >= set(types) else ()),
    )


def _shares(
    start: np.ndarray, sums: Mapping[tuple[str, str], float], names: tuple[str, ...]
) -> np.ndarray:
    """[types+1] whose sums are those of the pairs, from a start that is the mean of bodies'."""
    of_bodies = [each for pair, each in sums.items() if PLANE not in pair]
    if of_bodies:
        mean = 0.5 * float(np.mean(of_bodies))
        start = np.append(np.full(len(start) - 1, mean), start[-2] + start[-1] - mean)
    return _fitted(start, _rows(sums, names, 1.0), sums.values())


def _rows(pairs: Iterable[tuple[str, str]], names: tuple[str, ...], second: float) -> np.ndarray:
    """[pairs, types+1]: 1 for the first type of each pair, plus ``second`` for the second."""
    each = np.eye(len(names))
    rows = [each[names.index(a)] + second * each[names.index(b)] for a, b in pairs]
    return np.reshape(rows, (-1, len(names)))


def _fitted(start: np.ndarray, rows: np.ndarray, values: Iterable[float]) -> np.ndarray:
    """The least squares solution nearest to ``start``."""
    missing = np.array(list(values)) - rows @ start
    return np.asarray(start + np.linalg.pinv(rows) @ missing)


def _with(head: ContactLaw, **values: np.ndarray) -> ContactLaw:
    typed = {name: jnp.asarray(each, head.log_mass.dtype) for name, each in values.items()}
    return eqx.tree_at(
        lambda each: [getattr(each, name) for name in typed], head, list(typed.values())
    )


def _logit(share: float) -> float:
    share = min(max(share, _LEAST), _MOST)
    return float(np.log(share / (1.0 - share)))


def _inverse_softplus(value: np.ndarray | float) -> np.ndarray:
    return np.asarray(np.log(np.expm1(value)))
