"""How long iLQR takes for a pendulum's swing-up, beside mpc.pytorch and crocoddyl.

Usage: python benchmarks/ilqr_pendulum.py [--quick] [--json FILE]

One start, and 64 starts at once (crocoddyl: in turn), on one core. Every solver, ours too, is given
the fewest iterations, of a few numbers tried, with which its cost is within 1e-4 of the least: what
is timed is the way to the same optimum, not the care with which a solver makes sure of it. Ours
counts rollouts, rejected ones included. What is compared is the cost, summed alike for all.
"""

import one_core  # noqa: F401, I001  before JAX

import numpy as np
from comparing import Missing, Row, Way, compared
from measuring import arguments, report
from pendulum import MANY, OURS, Solver, enough_iterations, total_cost, way
from pendulum_peers import with_crocoddyl, with_mpc

BATCH = 64


def rows(what: str, starts: np.ndarray, peers: list[Solver | Missing], quick: bool) -> list[Row]:
    """One a peer."""
    least = total_cost(starts, OURS.controls(OURS.prepared(starts, MANY)()))
    count = enough_iterations(OURS, starts, least)
    assert count is not None, "ours needs more iterations than are tried"

    def measured(peer: Solver | Missing) -> Way | Missing:
        if isinstance(peer, Missing):
            return peer
        count = enough_iterations(peer, starts, least)
        if count is None:
            return Missing(peer.name, "does not come to the same optimum")
        return way(peer, starts, count)

    ours = way(OURS, starts, count)
    return compared(f"{what}, {count} it.", ours, [measured(peer) for peer in peers], quick)


def main() -> None:
    """Measure and say."""
    told = arguments("Time of iLQR for a swing-up, beside mpc.pytorch and crocoddyl.")
    mpc, (compiled, *interpreted) = with_mpc(), with_crocoddyl()
    one = np.zeros((1, 2))
    many = np.random.default_rng(0).uniform(-0.3, 0.3, (4 if told.quick else BATCH, 2))
    found = rows("iLQR swing-up, T = 100", one, [mpc, compiled, *interpreted], told.quick)
    what = f"iLQR swing-up, T = 100, {len(many)} starts"
    report("ilqr_pendulum", found + rows(what, many, [mpc, compiled], told.quick), told)


if __name__ == "__main__":
    main()
