"""Trained models that come with the package, by name."""

from pathlib import Path

from contactgraph.data.errors import InvalidInputError

_FOLDER = Path(__file__).resolve().parent.parent / "pretrained"


def shipped_models() -> tuple[str, ...]:
    """Names of the models that come with the package, e.g. ``("pickup",)``."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.safetensors")))


def shipped_model(name: str) -> Path:
    """The file of a model that comes with the package: ``load_model(shipped_model("pickup"))``.

    Raises `InvalidInputError` where there is none of that name.
    """
    if name not in shipped_models():
        raise InvalidInputError(
            f"no model {name!r} comes with the package; those that do are "
            f"{', '.join(shipped_models()) or 'none'}"
        )
    return _FOLDER / f"{name}.safetensors"
