"""``contactgraph evaluate``: prediction errors of a model on recorded trajectories."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from contactgraph.cli.options import (
    AUTO,
    BeliefOptions,
    Device,
    ModelArgument,
    OutputFile,
    check_range,
    own_functions,
)
from contactgraph.data import Dataset, InvalidInputError, read_trajectories, with_edge_labels

if TYPE_CHECKING:
    from contactgraph.evaluate import OpenLoopMetrics, Predictor
    from contactgraph.model import ContactDynamics


@dataclass(frozen=True)
class Evaluate(BeliefOptions):
    """Predict recorded trajectories from every state, and measure the errors beside baselines."""

    model: ModelArgument
    data: Positional[Annotated[Path, arg(metavar="DATA")]]
    """A dataset file (HDF5)."""
    json: OutputFile = None
    """Write the measurements to this file."""
    horizon: Annotated[
        float | None,
        arg(metavar="SECONDS", help_behavior_hint="(default: 0.5, or one step if that is longer)"),
    ] = None
    """Time ahead of each state, a multiple of the time step, s."""
    baselines: Annotated[Path | None, arg(metavar="TRAIN", help_behavior_hint="(optional)")] = None
    """Dataset file to fit least squares and an interaction network to, for as long as the model's
    own training took."""
    prediction: Annotated[
        tuple[str, ...], arg(metavar="MODULE:FUNCTION ...", help_behavior_hint="(none)")
    ] = ()
    """Predictions of your own, measured beside the model's under the functions' names."""
    growth_steps: Annotated[int | None, arg(metavar="STEPS", help_behavior_hint="(optional)")] = (
        None
    )
    """Also roll the model out over this many steps from every start, and measure its growth."""
    forced: bool = False
    """Predict under random constant forces that are simulated from states of planar tasks, in place
    of the recorded controls, which may tell what is hidden."""
    forced_every: Annotated[int, arg(metavar="STATES")] = 12
    """With --forced: states from one window to the next."""
    device: Device = AUTO

    def run(self) -> None:
        """Evaluate, and print a summary."""
        from contactgraph.cli.models import (
            contact_distance,
            contact_distance_text,
            in_steps_of,
            model_path,
            motion_evidence,
            stored_model,
            with_inference,
        )
        from contactgraph.cli.output import check_writable, write_json
        from contactgraph.evaluate import (
            evaluate_open_loop,
            forced_windows,
            horizon_steps,
            rollout_growth,
        )
        from contactgraph.evaluate.forced import recorded_task
        from contactgraph.evaluate.metrics import BASELINES, json_key
        from contactgraph.evaluate.statistics import finite_or_none
        from contactgraph.model.io import describe_model

        check_writable(self.json)
        faults = self.sensor_fault()
        own_metrics = own_functions("--metric", self.metric)
        predictions = own_functions("--prediction", self.prediction)
        if taken := sorted(predictions.keys() & set(BASELINES)):
            raise InvalidInputError(f"predictions must have new names, found {taken[0]!r}")
        if self.growth_steps is not None:
            check_range("--growth-steps", self.growth_steps, 1, 100_000)
        check_range("--forced-every", self.forced_every, 1, 100_000)
        model = with_inference(stored_model(self.model), self.inference)
        dataset = in_steps_of(model, read_trajectories(self.data), str(self.data))
        noise = motion_evidence(model, self.ignore_motion)
        steps = horizon_steps(dataset, self.horizon)  # a mistake is told before minutes of fitting
        tested, episodes = dataset, tuple[int, ...]()
        if self.forced:
            task_of = partial(recorded_task, dataset)
            tested, episodes = forced_windows(dataset, task_of, steps, self.forced_every)
        training = describe_model(model_path(self.model)).training
        fitted, effort = self._fitted(model, dataset, training)
        metrics = evaluate_open_loop(
            model,
            tested,
            horizon_s=self.horizon,
            faults=faults,
            motion_noise=noise,
            predictions={**fitted, **predictions},
            metrics=own_metrics,
            last_window_of=episodes,
        )
        growth: dict[str, float] = {}
        if self.growth_steps is not None:
            growth = rollout_growth(model, dataset, self.growth_steps)
        values = {
            "run": self.model,
            "data": str(self.data),
            "episodes": len(dataset),
            "seed": dataset.metadata.get("seed"),
            "false_alarms": self.false_alarms,
            "misses": self.misses,
            "delay": self.delay,
            "fault": self.fault,
            "infer_contacts": noise is not None,
            "inference": self.inference,
            "forced_every": self.forced_every if self.forced else None,
            "contact_distance_m": contact_distance(model),
            "training_s": training.get("training_s"),
            **metrics.to_json(),
            **effort,
            **{name: finite_or_none(value) for name, value in growth.items()},
        }
        write_json(self.json, values)
        _print_summary(values, metrics)
        for name in own_metrics:
            for which in metrics.predictions:
                if (key := json_key(which, name)) in values:
                    print(f"{key}: {values[key]}")
        if effort.get("least_squares_missing") is not None:
            print(f"least squares: {effort['least_squares_missing']}")
        print(f"contact distance: {contact_distance_text(model)}")
        if growth:
            print(
                f"over {self.growth_steps} steps the state grows {_times(growth['growth_free'])} "
                f"without control, {_times(growth['growth_driven'])} with it"
            )
        unlabelled = sum(each.contact is None for each in with_edge_labels(dataset))
        if unlabelled:
            print(
                f"edges were not scored: {unlabelled} of {len(dataset)} trajectories in "
                f"{self.data} have no contact field"
            )

    def _fitted(
        self, model: "ContactDynamics", test: Dataset, training: Mapping[str, Any]
    ) -> "tuple[dict[str, Predictor], dict[str, Any]]":
        """The baselines fitted to a dataset file, the network for as long as the model, and what
        that took, by their JSON keys; none without ``--baselines``."""
        from contactgraph.cli.models import in_steps_of
        from contactgraph.evaluate.network_fit import fit_baselines

        if self.baselines is None:
            return {}, {}
        train = in_steps_of(model, read_trajectories(self.baselines), str(self.baselines))
        took, made = training.get("training_s"), training.get("step")
        seconds = float(took) if isinstance(took, int | float) and took > 0 else _TRAINING_S
        steps = made if isinstance(made, int) and made > 0 else _TRAINING_STEPS
        least_squares, network = fit_baselines(train, test, seconds, steps)
        print(
            f"interaction network: {network.steps} steps of training in {network.seconds:.0f} s, "
            f"at least the model's {steps} in {seconds:.0f} s"
        )
        effort = {
            "gnn_training_s": round(network.seconds, 1),
            "gnn_training_steps": network.steps,
            "least_squares_missing": least_squares.missing(test),
        }
        return {"least_squares": least_squares, "gnn": network}, effort


_TRAINING_S = 60.0
"""Time for the network where the model's own is not known, s."""
_TRAINING_STEPS = 2000
"""Least optimiser steps of the network where the model's own are not known."""
_TEXTS = {
    "n_step": "the model",
    "n_step_unmeasured": "  nothing measured",
    "n_step_inferred": "  contacts inferred",
    "constant_velocity": "constant velocity",
    "standing_still": "standing still",
    "least_squares": "least squares",
    "gnn": "interaction network",
    "frozen_contact": "fixed contact (oracle)",
}
"""Of the predictions, in the order of their table; others stand below by their names."""
_CONTACTS = {"": "measured", "_unmeasured": "not measured", "_inferred": "inferred from motion"}
_FURTHER = (
    ("error of all bodies where a contact changes", "n_step_rmse_contact_m", 100.0, "cm"),
    ("error of the start of contact, mean", "switch_time_error_s", 1000.0, "ms"),
    ("angles of bodies that turn", "angle_rmse_rad", 1.0, "rad"),
    ("angles by constant velocity", "constant_velocity_angle_rmse_rad", 1.0, "rad"),
    ("as many bodies as recorded turn over, of windows", "turned_over_accuracy", 100.0, "%"),
    ("largest error where nothing moves", "rest_drift_m", 1000.0, "mm"),
    ("largest gap of a pin", "pin_drift_m", 1000.0, "mm"),
    ("masses after one contact, median error", "mass_error_median", 100.0, "%"),
    ("masses after one contact, 90 % quantile", "mass_error_p90", 100.0, "%"),
    ("masses within their 90 % interval", "mass_interval_coverage", 100.0, "%"),
)
"""Lines of the summary, of numbers that are known: text, JSON key, factor and unit."""


def _print_summary(values: dict[str, Any], metrics: "OpenLoopMetrics") -> None:
    from contactgraph.evaluate.metrics import json_key

    texts = {**_TEXTS, **{name: name for name in metrics.predictions if name not in _TEXTS}}

    def centimetres(value: float | None) -> str:
        return "unknown" if value is None else f"{100 * value:.3f} cm"

    def score(name: str) -> str:
        value = values[name]
        return "unknown" if value is None else f"{value:.4f}"

    if values["forced_every"] is not None:
        print(
            f"{values['windows']} windows under random constant forces, one every "
            f"{values['forced_every']} states of {values['episodes']} episodes"
        )
    title = f"error over {values['n_steps']} steps"
    print(f"{title:<23}{'bodies that move':>16}  {'all bodies':>16}")
    for name, text in texts.items():
        found = [values[json_key(name, f"n_step_rmse{bodies}_m")] for bodies in ("_moving", "")]
        if found != [None, None]:
            print(f"{text:<23}{'  '.join(f'{centimetres(each):>16}' for each in found)}")
    print(f"verdict: {values['verdict'] or 'none, since nothing moves'}")
    if metrics.unbeaten:
        worse = ", ".join(text for name, text in texts.items() if name in metrics.unbeaten)
        print(f"  by the error of bodies that move it is not better than {worse}")
    for beliefs, text in _CONTACTS.items():
        if beliefs == "_inferred" and not values["infer_contacts"]:
            continue
        print(f"contacts {text}:")
        if (mean := values.get(f"n_step_mean_moving{beliefs}_m")) is not None:
            low, high = (
                f"{100 * each:.3f}" for each in values[f"n_step_rmse_interval_moving{beliefs}_m"]
            )
            print(
                f"  bodies that move: {low} to {high} cm in 95 % of resampled episodes; mean of "
                f"the windows' errors {100 * mean:.3f} cm"
            )
        now, coming = score(f"edge_f1_now{beliefs}"), score(f"edge_f1{beliefs}")
        print(f"  edges: F1 {now} (step just made), {coming} (steps to come)")
        next_step, last = (score(f"calibration_error{each}{beliefs}") for each in ("", "_ahead"))
        print(f"  calibration error: {next_step} (next step), {last} (end of the window)")
    for text, name, factor, unit in _FURTHER:
        if values[name] is not None:
            print(f"{text}: {factor * values[name]:.3f} {unit}")


def _times(growth: float) -> str:
    return f"{growth:.3g} times" if math.isfinite(growth) else "without bound"
