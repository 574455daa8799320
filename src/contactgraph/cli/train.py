"""``contactgraph train``: fit a model to recorded runs."""

import math
import sys
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg


@dataclass(frozen=True)
class Train:
    """Fit a model to the runs of a dataset file. Contact labels in it are not read."""

    data: Positional[Annotated[Path, arg(metavar="DATA")]]
    """The dataset file (HDF5)."""
    out: Annotated[Path, arg(metavar="FOLDER")]
    """The folder of the run; new, or with --resume the one to go on with."""
    model: str = "gim-temp"
    """gim-temp, gim-non-temp, no-gim, full-ab, paper-literal or paper-literal-no-gim."""
    every: Annotated[int, arg(metavar="K")] = 1
    """Take every K-th step of the runs, with controls averaged: robots record in steps of 0.001 s,
    and models of 0.01 s are quicker and see as much."""
    seed: int = 0
    """One seed makes one result."""
    resume: bool = False
    """Go on from the last checkpoint of the run, with the settings it was begun with."""
    contact_distance: float | None = None
    """About where bodies touch, centre to centre, in m (the paper's d_th). A distance that the
    data tell is kept; another is where learning it begins. (default: the data's, or 0.085)"""
    held_out: float = 0.15
    """Share of the runs kept from training, to choose the best model by."""
    steps: int = 2000
    """Optimiser steps."""
    batch_size: int = 32
    """Windows a step."""
    window_length: int = 8
    """Steps of a window."""
    learning_rate: float = 3e-3
    """Highest learning rate."""
    event_fraction: float = 0.6
    """Share of windows that hold an impact."""
    rollout_from: float | None = None
    """Part of the steps after which whole windows are predicted too. (default: 0.5; 0 where
    bodies have weight, since only then is it told from a grasp)"""
    bystanders: int = 1
    """Resting bodies put into every window; none where what can be touched hangs on hinges."""
    prior_weight: float = 0.05
    """Weight of the KL divergence of beliefs from the distance prior; 0 leaves it out."""
    devices: Annotated[int | None, arg(metavar="INT")] = None
    """Split every batch over so many devices of this machine. (default: as many as there are and
    BATCH_SIZE divides by)"""

    def run(self) -> None:
        """Train, saving checkpoints on the way."""
        import jax

        from contactgraph.cli.models import MODELS
        from contactgraph.cli.options import check_range, check_seed, check_weight, choice
        from contactgraph.cli.output import progress, provenance, sha256
        from contactgraph.data import (
            InvalidInputError,
            check_window_length,
            read_trajectories,
            split_by_trajectory,
            subsample,
            velocity_warning,
        )
        from contactgraph.model.io import save_model
        from contactgraph.train import (
            FitProgress,
            FitState,
            FitStatus,
            LossTerms,
            RunFolder,
            TrainConfig,
            defaults_from_data,
            fit,
            initial_state,
        )

        folder = RunFolder(self.out)
        told = self._settled(folder.config()) if self.resume else self
        check_seed(told.seed)
        distance = told.contact_distance
        if distance is not None and not (distance > 0 and math.isfinite(distance)):
            raise InvalidInputError(f"--contact-distance must be positive metres, found {distance}")
        build = choice("--model", told.model, MODELS)
        check_weight("--prior-weight", told.prior_weight)
        recipe = TrainConfig(
            **{name: getattr(told, name) for name in _RECIPE},
            rollout_from=0.0 if told.rollout_from is None else told.rollout_from,
            weights=LossTerms(prior=told.prior_weight),
        )
        check_range("--every", told.every, 1, 100_000)
        dataset = subsample(read_trajectories(self.data), told.every)
        suited = defaults_from_data(dataset)
        if told.rollout_from is None:
            recipe = replace(recipe, rollout_from=suited.rollout_from)
        checksum = sha256(self.data)
        train, held_out = split_by_trajectory(dataset, told.held_out, told.seed)
        for part in (train, held_out):  # checked before a folder is created
            check_window_length(recipe.window_length, max(each.steps for each in part))
        devices = jax.local_devices()[: self._devices(len(jax.local_devices()), told.batch_size)]
        model = build(
            dataset.dimension,
            dataset.control_size,
            dataset.dt,
            suited.contact_distance if distance is None else distance,
            hinges=suited.hinges,
            weight=suited.weight,
            learned_contact_distance=suited.learned_contact_distance or distance is not None,
            key=jax.random.key(told.seed),
        )
        state = initial_state(model, recipe, told.seed)
        spent = 0.0
        if self.resume:
            spent = folder.metrics()[-1]["seconds"] if folder.metrics() else 0.0
            if folder.config().get("data_sha256") != checksum:
                raise InvalidInputError(f"{self.data}: not the data that {self.out} was begun with")
            state = folder.latest(state)
        else:
            config = {**asdict(told), "data": str(self.data), "out": str(self.out)}
            folder.create({**config, "data_sha256": checksum, **provenance()}, state)
        options = f"--model {told.model} --seed {told.seed}"
        options += "".join(
            f" --{name.replace('_', '-')} {getattr(told, name)}"
            for name in ("every", "bystanders", "prior_weight")
            if getattr(told, name) != getattr(type(told), name)
        )
        summary = {
            "command": f"contactgraph train {self.data.name} {options}",
            "seed": told.seed,
            "runs": len(train),
            "held_out_runs": len(held_out),
            "data": dataset.metadata,
            "data_sha256": checksum,
            **provenance(),
        }

        def keep_best(state: FitState, seconds: float) -> None:
            found = {
                "step": int(state.step),
                "held_out_rmse_m": float(state.best_error),
                "training_s": round(seconds, 1),
            }
            save_model(folder.model_path, state.best_model, {**summary, **found})

        warning = velocity_warning(dataset)
        if warning is not None:
            print(f"contactgraph: warning: {self.data}: {warning}", file=sys.stderr)
        with progress("training", recipe.steps) as steps:
            if math.isfinite(float(state.best_error)):
                # A run killed after its checkpoint and before its model has an older one.
                keep_best(state, spent)

            def on_check(check: FitProgress) -> None:
                check = replace(check, seconds=spent + check.seconds)
                folder.save(check)
                keep_best(check.state, check.seconds)
                best = float(check.state.best_error)
                steps.advance(check.step, f"held-out error {100 * best:.3f} cm")

            result = fit(state, train, held_out, recipe, on_check, devices)
        if result.status is FitStatus.not_finite:
            raise InvalidInputError(f"{self.out}: {result.status.value}")
        print(
            f"{folder.model_path}: held-out error {100 * result.held_out_rmse_m:.3f} cm over "
            f"{recipe.window_length} steps; {result.status.value}"
        )

    def _devices(self, there: int, batch_size: int) -> int:
        """How many devices share a batch."""
        from contactgraph.data import InvalidInputError

        even = [count for count in range(1, there + 1) if batch_size % count == 0]
        if self.devices is None:
            return even[-1]
        if self.devices not in even:
            counts = ", ".join(map(str, even))
            raise InvalidInputError(
                f"--devices must be one of {counts} (there are {there}, and each takes a like part "
                f"of {batch_size} windows), found {self.devices}"
            )
        return self.devices

    def _settled(self, config: dict) -> "Train":
        """The settings the run was begun with."""
        from contactgraph.data import InvalidInputError

        told: dict[str, Any] = {}
        for setting in fields(self):
            if setting.name in ("data", "out", "resume", "devices"):
                continue
            found, default = config.get(setting.name), setting.default
            # Without a default it is a number, or the data's choice.
            kinds = (float, type(None)) if default is None else (type(default),)
            if type(found) not in kinds:
                raise InvalidInputError(
                    f"{self.out / 'config.json'}: {setting.name} must be like "
                    f"{default!r}, found {found!r}"
                )
            told[setting.name] = found
        return Train(data=self.data, out=self.out, **told)


_RECIPE = (
    "steps",
    "batch_size",
    "window_length",
    "learning_rate",
    "event_fraction",
    "bystanders",
)
