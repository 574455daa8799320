"""Whether a model can say anything about a task or about data at all."""

import math

from contactgraph.data import InvalidInputError, Scene
from contactgraph.model.contact_dynamics import ContactDynamics


def check_fit(model: object, scene: Scene, control_size: int, other: str) -> None:
    """Raises `InvalidInputError` where a scene or its control are not of the kind the model is for.

    ``other`` names what does not fit, e.g. ``"the data"``. Models other than `ContactDynamics` do
    not say what they are for.
    """
    if not isinstance(model, ContactDynamics):
        return
    if model.neighbours is not None:
        raise InvalidInputError(
            f"beliefs about {other} are asked for over all pairs, so the model must have no "
            "neighbour lists (neighbours=None)"
        )
    for what, found, wanted in (
        ("dimension D", scene.dimension, model.dimension),
        ("control size U", control_size, model.control_size),
    ):
        if found != wanted:
            raise InvalidInputError(
                f"the model is for {what} {wanted}, but {other} has {found}; they must agree"
            )
    if not math.isclose(scene.dt, model.dt, rel_tol=1e-6):
        raise InvalidInputError(
            f"the model is for dt {model.dt:g} s, but {other} has {scene.dt:g} s; they must agree"
        )
    if model.features.hinges and not scene.has_hinges:
        raise InvalidInputError(
            f"the model is for bodies on hinges, but {other} has no anchor; it must say where a "
            "hinge is"
        )
    if scene.has_hinges and not model.features.hinges:
        raise InvalidInputError(
            f"the model knows no hinges, but {other} has an anchor; train one on data that has"
        )
