"""The cells of the rehearsed experiment: record, learn, follow, control."""

from dataclasses import dataclass

from contactgraph_studies.cell import Cell
from contactgraph_studies.measurement import Measurement
from contactgraph_studies.sim.declared import (
    CONTROL_SEED,
    EVERY,
    IN_PASSING,
    TRAINED_SEED,
    TRAINING_SEED,
    VALIDATION_SEED,
    WAYS,
    Knowing,
    RehearsalAmounts,
)


@dataclass(frozen=True)
class Recorded:
    """What a number is of: recorded runs."""

    name: str


@dataclass(frozen=True)
class Followed:
    """What a number is of: predictions of the validation runs."""

    live: bool
    """From states as they were known then; else smoothed by what was seen later."""


@dataclass(frozen=True)
class Controlled:
    """What a number is of: pickups by MPC."""

    way: Knowing


_ENDS = (".json", ".h5", ".truth.h5", ".live.h5")

Place = Recorded | Followed | Controlled

TRAINING, VALIDATION = Recorded("training"), Recorded("validation")


def rehearsal_measurements(amounts: RehearsalAmounts) -> list[Measurement[Place]]:
    """All of the study."""
    training = recording(TRAINING, TRAINING_SEED, amounts.training_runs, amounts)
    validation = recording(
        VALIDATION, VALIDATION_SEED, amounts.validation_runs, amounts, IN_PASSING
    )
    model = learning(training, amounts)
    found: list[Measurement[Place]] = [
        Measurement(TRAINING, TRAINING_SEED, training),
        Measurement(VALIDATION, VALIDATION_SEED, validation),
    ]
    for live in (False, True):
        cell = following(model, validation, live)
        found.append(Measurement(Followed(live), VALIDATION_SEED, cell))
    for way in WAYS:
        found.append(Measurement(Controlled(way), CONTROL_SEED, control(model, way, amounts)))
    return found


def recording(
    what: Recorded,
    seed: int,
    runs: int,
    amounts: RehearsalAmounts,
    options: tuple[str, ...] = (),
) -> Cell:
    """Runs through server and camera, in a file beside their numbers."""
    output, *files = (f"cells/{what.name}{end}" for end in _ENDS)
    arguments = (
        *("robot", "rehearse-record", "--out", files[0], "--json", output),
        *("--runs", str(runs), "--seconds", f"{amounts.seconds:g}"),
        *("--seed", str(seed), "--pace", f"{amounts.pace:g}"),
        *options,
    )
    return Cell(output, arguments, "rehearse-record", beside=tuple(files))


def learning(data: Cell, amounts: RehearsalAmounts) -> Cell:
    """The model."""
    output = "cells/model"
    arguments = (
        *("train", data.beside[0], "--every", str(EVERY), "--out", output),
        *("--seed", str(TRAINED_SEED), *amounts.training_options),
    )
    return Cell(output, arguments, "train", (data,), checkpoints="checkpoint-*.safetensors")


def following(model: Cell, data: Cell, live: bool) -> Cell:
    """Predictions of runs that the model has not seen, with and without contacts known."""
    runs, _, as_known = data.beside
    output = f"cells/followed{'-live' if live else ''}.json"
    arguments = ("evaluate", model.output, as_known if live else runs, "--infer-contacts")
    return Cell(output, (*arguments, "--json", output), "evaluate", (model, data))


def control(model: Cell, way: Knowing, amounts: RehearsalAmounts) -> Cell:
    """Pickups."""
    output, runs = (f"cells/control-{way.slug}{end}" for end in (".json", ".h5"))
    arguments = (
        *("robot", "rehearse-control", model.output, *way.options),
        *("--episodes", str(amounts.episodes), "--seed", str(CONTROL_SEED)),
        *("--pace", f"{amounts.pace:g}", "--save", runs, "--json", output),
    )
    return Cell(output, arguments, "rehearse-control", (model,), beside=(runs,))
