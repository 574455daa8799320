"""The baselines that are fitted to training data: least squares and an interaction network."""

from collections.abc import Mapping
from dataclasses import dataclass

from contactgraph.data import Dataset, InvalidInputError
from contactgraph.evaluate.baselines import Baseline
from contactgraph.evaluate.least_squares import LeastSquares, fit_least_squares
from contactgraph.evaluate.network_fit import FittedNetwork, fit_interaction_network


@dataclass(frozen=True)
class FittedBaselines:
    """Both baselines, for `evaluate_open_loop`."""

    least_squares: LeastSquares
    network: FittedNetwork
    least_squares_missing: str | None
    """The reason why least squares cannot predict the test data; None if it can."""

    @property
    def predictions(self) -> Mapping[str, Baseline]:
        """The baselines by the names of their JSON keys."""
        return {"least_squares": self.least_squares, "gnn": self.network}

    def to_json(self) -> dict[str, float | int | str | None]:
        """The effort of training, and the reason for numbers that are null."""
        return {
            "gnn_training_s": round(self.network.seconds, 1),
            "gnn_training_steps": self.network.steps,
            "least_squares_missing": self.least_squares_missing,
        }


def fit_baselines(
    train: Dataset, test: Dataset, seconds: float, least_steps: int
) -> FittedBaselines:
    """Fit to ``train``, the network for ``seconds`` and ``least_steps`` of its optimiser.

    Raises `InvalidInputError` where the two datasets differ in dimension, control size or time
    step, or where ``train`` has fewer than two trajectories.
    """
    for name in ("dimension", "control_size", "dt"):
        found, wanted = getattr(train, name), getattr(test, name)
        if abs(found - wanted) > 1e-6 * wanted:
            raise InvalidInputError(
                f"training data of baselines must have the {name} of the test data, {wanted:g}, "
                f"found {found:g}"
            )
    least_squares = fit_least_squares(train)
    return FittedBaselines(
        least_squares=least_squares,
        network=fit_interaction_network(train, seconds, least_steps),
        least_squares_missing=least_squares.missing(test),
    )
