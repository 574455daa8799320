"""Recorded runs, in the steps of the model that is to read them."""

from contactgraph.cli.output import say
from contactgraph.data import Dataset, subsample

_WHOLE = 1e-6


def in_steps_of(model: object, dataset: Dataset, name: str) -> Dataset:
    """The runs of ``dataset``, in longer steps where the model's step is a multiple of theirs.

    ``name`` is the data set's, for the line that says so. Where it is none, they are left as they
    are, for whoever compares the two to refuse.
    """
    dt = getattr(model, "dt", dataset.dt)
    every = round(dt / dataset.dt)
    if every < 2 or abs(every * dataset.dt - dt) > _WHOLE * dt:
        return dataset
    say(f"{name}: every {every}th step is taken, since the model's are {dt:g} s long")
    return subsample(dataset, every)
