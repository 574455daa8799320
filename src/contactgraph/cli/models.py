"""Models by the names a user types."""

from pathlib import Path

from contactgraph.data import Dataset, InvalidInputError, subsample
from contactgraph.model import (
    Preset,
    full_ab,
    gim_non_temp,
    gim_temp,
    no_gim,
    paper_literal,
    paper_literal_no_gim,
    shipped_model,
    shipped_models,
)

MODELS: dict[str, Preset] = {
    "gim-temp": gim_temp,
    "gim-non-temp": gim_non_temp,
    "no-gim": no_gim,
    "full-ab": full_ab,
    "paper-literal": paper_literal,
    "paper-literal-no-gim": paper_literal_no_gim,
}


def model_path(run: str) -> Path:
    """The model file of a run folder, a model file itself, or a model that ships with the package.

    Raises `InvalidInputError` where there is none.
    """
    path = Path(run)
    if path.is_file():
        return path
    if path.is_dir():
        inside = path / "model.safetensors"
        if inside.is_file():
            return inside
        raise InvalidInputError(
            f"{run}: has no model.safetensors; it must be a folder that train has made"
        )
    if run in shipped_models():
        return shipped_model(run)
    raise InvalidInputError(
        f"{run}: no such run folder or model file; models that ship are "
        f"{', '.join(shipped_models())}"
    )


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
    print(f"{name}: every {every}th step is taken, since the model's are {dt:g} s long")
    return subsample(dataset, every)
