"""Whether a model can say anything about a task or about data at all."""

import math

from contactgraph.control import StepModel
from contactgraph.data import InvalidInputError
from contactgraph.model import ContactDynamics


def check_fit(model: StepModel, dimension: int, control_size: int, dt: float, other: str) -> None:
    """Raises `InvalidInputError` where sizes or time step [s] are not those the model is for.

    ``other`` names what does not fit, e.g. ``"the data"``. Models other than `ContactDynamics` do
    not say what they are for.
    """
    if not isinstance(model, ContactDynamics):
        return
    for what, found, wanted in (
        ("dimension D", dimension, model.dimension),
        ("control size U", control_size, model.control_size),
    ):
        if found != wanted:
            raise InvalidInputError(
                f"the model is for {what} {wanted}, but {other} has {found}; they must agree"
            )
    if not math.isclose(dt, model.dt, rel_tol=1e-6):
        raise InvalidInputError(
            f"the model is for dt {model.dt:g} s, but {other} has {dt:g} s; they must agree"
        )
