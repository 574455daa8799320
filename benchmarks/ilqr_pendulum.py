"""Time of iLQR for a pendulum's swing-up, compared with mpc.pytorch and crocoddyl.

Usage: python benchmarks/ilqr_pendulum.py [--quick] [--json FILE]

One start, and 64 starts at once (crocoddyl: in turn), on one core. Every solver gets the
fewest iterations, of a few numbers tried, with which its cost is within 1e-4 of the least, so that
times compare convergence to the same optimum, not stopping criteria. Ours counts rollouts, rejected
ones included. The costs, summed alike for all, are compared.
"""

import one_core  # noqa: F401, I001  before JAX

import numpy as np
from measuring import Missing, Row, Method, arguments, compare, report
from pendulum import (
    MANY,
    OURS,
    Solver,
    enough_iterations,
    method,
    total_cost,
    with_crocoddyl,
    with_mpc,
)

BATCH = 64


def rows(what: str, starts: np.ndarray, peers: list[Solver | Missing], quick: bool) -> list[Row]:
    """One row per peer."""
    least = total_cost(starts, OURS.controls(OURS.prepared(starts, MANY)()))
    count = enough_iterations(OURS, starts, least)
    assert count is not None, "ours needs more iterations than are tried"

    def measured(peer: Solver | Missing) -> Method | Missing:
        if isinstance(peer, Missing):
            return peer
        count = enough_iterations(peer, starts, least)
        if count is None:
            return Missing(peer.name, "does not come to the same optimum")
        return method(peer, starts, count)

    ours = method(OURS, starts, count)
    return compare(f"{what}, {count} it.", ours, [measured(peer) for peer in peers], quick)


def main() -> None:
    """Measure and print."""
    options = arguments("Time of iLQR for a swing-up, beside mpc.pytorch and crocoddyl.")
    mpc, (written, *others) = with_mpc(), with_crocoddyl()
    one = np.zeros((1, 2))
    many = np.random.default_rng(0).uniform(-0.3, 0.3, (4 if options.quick else BATCH, 2))
    found = rows("iLQR swing-up, T = 100", one, [mpc, written, *others], options.quick)
    what = f"iLQR swing-up, T = 100, {len(many)} starts"
    report("ilqr_pendulum", found + rows(what, many, [mpc, written], options.quick), options)


if __name__ == "__main__":
    main()
