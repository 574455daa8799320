"""How a cost is learned: all numbers there are to choose."""

from dataclasses import dataclass

from contactgraph.data import InvalidInputError


@dataclass(frozen=True)
class CostRecipe:
    """How a cost is learned."""

    horizon: int = 20
    """H, steps that the policy looks ahead."""
    steps: int = 400
    """Of Adam."""
    batch: int = 256
    """Windows a step."""
    learning_rate: float = 0.1
    discount: float = 0.95
    """Weight of each step of a window against the one before."""
    prior_weight: float = 3.0
    """0: only what the demonstrations say."""

    def __post_init__(self) -> None:
        for name in ("horizon", "steps", "batch"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} must be at least 1, found {getattr(self, name)}")
        if not self.learning_rate > 0.0:
            raise InvalidInputError(f"learning_rate must be positive, found {self.learning_rate}")
        if not 0.0 < self.discount <= 1.0:
            raise InvalidInputError(f"discount must be above 0, at most 1, found {self.discount}")
        if not self.prior_weight >= 0.0:
            raise InvalidInputError(f"prior_weight must be 0 or more, found {self.prior_weight}")
