"""``contactgraph train``: fit a model to recorded trajectories."""

import math
import sys
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from contactgraph.cli import CommandError
from contactgraph.cli.options import AUTO, Device, check_range, check_seed, check_weight
from contactgraph.data import (
    Dataset,
    InvalidInputError,
    check_window_length,
    read_trajectories,
    split_by_trajectory,
    subsample,
    without_turns,
)
from contactgraph.data.lookup import choice

if TYPE_CHECKING:
    from contactgraph.identify import Facts
    from contactgraph.model import ContactSensor
    from contactgraph.train import HeldOutBaselines


@dataclass(frozen=True)
class Train:
    """Fit a model to the trajectories of a dataset file, by default without its contact labels."""

    data: Positional[Annotated[Path, arg(metavar="DATA")]]
    """The dataset file (HDF5)."""
    out: Annotated[Path, arg(metavar="FOLDER")]
    """The run folder: a new one, or with --resume the one to continue."""
    model: Annotated[
        str,
        arg(
            metavar="NAME",
            help="ours, its ablations (ours-recurrent, ours-memoryless, ours-no-inference, "
            "ours-full-ab), relations, the paper's forms (paper-literal and paper-local, each also "
            "with -non-temp, -no-gim or -full-ab), or module:factory.",
        ),
    ] = "ours"
    edge_types: Annotated[
        int | None, arg(metavar="K", help_behavior_hint="(default: 3; relations: 2)")
    ] = None
    """Types of an edge: 0 free, 1 touch, and all further ones hold. Of 2 types the other holds."""
    graph: Annotated[str, arg(metavar="NAME")] = "full"
    """Edges of the paper's forms: full, or star, those of actuated bodies alone."""
    sampling: Annotated[str, arg(metavar="NAME")] = "likeliest"
    """Edges of the paper's forms in training: likeliest, or gumbel, drawn by their probability."""
    temperature: float = 0.15
    """Divides the recurrent state of the paper's forms; at 1, as the paper's, none is certain."""
    every: Annotated[int, arg(metavar="N")] = 1
    """Use every N-th step of the trajectories, with the mean of the controls in between."""
    turns: bool = True
    """Whether bodies with orientations and outlines turn; else they are balls or boxes, which are
    planned for many times as fast."""
    seed: int = 0
    """Random seed; the same seed gives the same model."""
    resume: bool = False
    """Continue from the last checkpoint of the run folder, with the options it was started with."""
    contact_distance: Annotated[
        float | None, arg(metavar="M", help_behavior_hint="(default: the data's, or 0.085)")
    ] = None
    """Distance of the centres of touching bodies, m (d_th); a first guess where it is learned."""
    held_out: float = 0.15
    """Share of the trajectories kept from training, to choose the best model by."""
    steps: Annotated[
        int | None, arg(metavar="INT", help_behavior_hint="(default: 750; of other models 2000)")
    ] = None
    """Optimiser steps; a filter takes twice as many of its own."""
    batch_size: int = 32
    """Windows in a batch."""
    window_length: int = 8
    """Steps in a window."""
    learning_rate: float = 3e-3
    """Highest learning rate."""
    event_fraction: float = 0.6
    """Share of windows that contain an impact."""
    rollout_from: Annotated[
        float | None,
        arg(metavar="SHARE", help_behavior_hint="(default: 0.5; for bodies with weight 0)"),
    ] = None
    """Share of the steps after which the loss includes the rollout of whole windows."""
    bystanders: int = 1
    """Resting distractors added to every window of an ablation or a form of the paper, unless no
    passive body of the data ever rests."""
    prior_weight: float = 0.05
    """Weight, for these, of the KL divergence of beliefs from the distance prior."""
    use_contacts: bool = False
    """Recorded contacts are evidence of training, too, beside the motion."""
    sensor: Annotated[str, arg(metavar="NAME")] = "exact"
    """Contact sensor that is stored in the model: exact, or estimate, by the trained filter from
    the recorded contacts."""
    device: Device = AUTO

    def run(self) -> None:
        """Train, saving checkpoints on the way."""
        import jax

        from contactgraph.cli.models import (
            contact_distance_text,
            facts_text,
            held_out_text,
            model_preset,
            sensor_text,
        )
        from contactgraph.cli.output import progress, provenance, sha256
        from contactgraph.identify import in_units
        from contactgraph.interchange import pull_warning, velocity_warning
        from contactgraph.large_scenes import ReallocatingModel
        from contactgraph.model import PAPER_PRESETS, PRESETS
        from contactgraph.model.io import save_model
        from contactgraph.model.scene import check_controls
        from contactgraph.train import (
            FitProgress,
            FitState,
            FitStatus,
            LossTerms,
            RunFolder,
            TrainConfig,
            check_contacts,
            estimate_sensor,
            fit,
            initial_state,
        )

        folder = RunFolder(self.out)
        options = self._started_with(folder.config()) if self.resume else self
        check_seed(options.seed)
        distance = options.contact_distance
        if distance is not None and not (0 < distance < math.inf):
            raise InvalidInputError(f"--contact-distance must be positive metres, found {distance}")
        if not 0.0 < options.temperature < math.inf:
            raise InvalidInputError(f"--temperature must be positive, found {options.temperature}")
        choice("--graph", options.graph, dict.fromkeys(("full", "star")))
        choice("--sampling", options.sampling, dict.fromkeys(("likeliest", "gumbel")))
        estimates = choice("--sensor", options.sensor, {"exact": False, "estimate": True})
        if options.steps is None:
            # Multiples of `check_every`: a shorter last round would be a second program to compile.
            options = replace(options, steps=750 if options.model == "ours" else 2000)
        preset = model_preset(options.model)
        for names, models, known in (
            (("edge_types",), {"ours", "relations"}, "ours and relations"),
            (("graph", "sampling", "temperature"), PAPER_PRESETS, "the paper's forms"),
            (("bystanders", "prior_weight"), PRESETS.keys() - {"ours"}, _OTHERS),
        ):
            given = [name for name in names if getattr(options, name) != getattr(Train, name)]
            if given and options.model not in models and ":" not in options.model:
                flags = " and ".join(f"{_flag(name)} {getattr(options, name)}" for name in given)
                raise InvalidInputError(f"{flags}: only for {known}, not for {options.model}")
        check_weight("--prior-weight", options.prior_weight)
        config = TrainConfig(
            **{name: getattr(options, name) for name in _CONFIG},
            rollout_from=0.0 if options.rollout_from is None else options.rollout_from,
            weights=LossTerms(prior=options.prior_weight),
        )
        check_range("--every", options.every, 1, 100_000)
        recorded = subsample(read_trajectories(self.data), options.every)
        recorded = recorded if options.turns else without_turns(recorded)
        facts = options._facts(recorded)
        dataset, length = in_units(recorded, facts.units), facts.units.length
        config = replace(config, rollout_from=facts.rollout_from)
        checksum = sha256(self.data)
        train, held_out = split_by_trajectory(dataset, options.held_out, options.seed)
        for part in (train, held_out):  # checked before a folder is created
            check_window_length(config.window_length, max(each.steps for each in part))
        devices = jax.local_devices()
        while options.batch_size % len(devices):  # which share a batch
            devices = devices[:-1]
        model = preset(facts.config, key=jax.random.key(options.seed))
        for each in dataset:
            check_controls(model, each.scene, each.control_size, str(self.data))
        for flag, used in (("--use-contacts", options.use_contacts), ("--sensor", estimates)):
            if used:
                check_contacts(model, dataset, f"{flag}: {self.data}")
        state = initial_state(model, config, options.seed)
        spent = 0.0
        if self.resume:
            spent = folder.metrics()[-1]["seconds"] if folder.metrics() else 0.0
            if folder.config().get("data_sha256") != checksum:
                raise InvalidInputError(f"{self.data}: not the data that {self.out} was begun with")
            state = folder.latest(state)
        else:
            saved = {**asdict(options), "data": str(self.data), "out": str(self.out)}
            folder.create({**saved, "data_sha256": checksum, **provenance()}, state)
        flags = f"--model {options.model} --seed {options.seed}"
        flags += "".join(
            f" {_flag(name)} {getattr(options, name)}"
            for name in (*_SHOWN, "sensor")
            if getattr(options, name) != getattr(type(options), name)
        ) + (" --use-contacts" if options.use_contacts else "")
        flags += "" if options.turns else " --no-turns"
        summary = {
            "command": f"contactgraph train {self.data.name} {flags}",
            "seed": options.seed,
            "runs": len(train),
            "held_out_runs": len(held_out),
            "data": dataset.metadata,
            "data_sha256": checksum,
            **provenance(),
        }

        def keep_best(
            state: FitState,
            seconds: float,
            baselines: "HeldOutBaselines | None" = None,
            sensor: "ContactSensor | None" = None,
        ) -> None:
            result = {
                "step": int(state.step),
                "held_out_rmse_m": length * float(state.best_error),
                "training_s": round(seconds, 1),
            }
            if baselines is not None:
                result |= {f"held_out_{name}": value for name, value in asdict(baselines).items()}
            best = replace(facts.in_data_units(state.best_model, preset), sensor=sensor)
            record = {**summary, **result}
            save_model(folder.model_path, best, options.model, facts.in_data, record)

        print(f"chosen by data and options:\n{facts_text(options.model, facts)}", flush=True)
        for warning in filter(None, (velocity_warning(recorded), pull_warning(recorded))):
            _warn(f"{self.data}: {warning}")
        with progress("training", config.steps) as bar:
            if math.isfinite(float(state.best_error)):
                # A process killed between the two has a newer checkpoint than model.
                keep_best(state, spent)

            def on_check(check: FitProgress) -> None:
                check = replace(
                    check,
                    seconds=spent + check.seconds,
                    held_out_rmse_m=length * check.held_out_rmse_m,
                    baselines=check.baselines.in_lengths(length),
                )
                folder.save(check)
                keep_best(check.state, check.seconds, check.baselines)
                best = length * float(check.state.best_error)
                bar.advance(check.step, held_out_text(check.held_out_rmse_m, check.baselines, best))

            result = fit(state, train, held_out, config, on_check, devices, ReallocatingModel)
        seconds, baselines = spent + result.seconds, result.baselines.in_lengths(length)
        sensor = estimate_sensor(result.model, train) if estimates else None
        if math.isfinite(result.held_out_rmse_m):
            keep_best(result.state, seconds, baselines, sensor)
        if result.status is FitStatus.not_finite:
            raise InvalidInputError(f"{self.out}: {result.status.value}")
        if result.status in (FitStatus.dead_units, FitStatus.constant_velocity):
            raise CommandError(
                f"{self.out}: {result.status.value}; try another --seed, a lower --learning-rate, "
                f"more data or another --model"
            )
        error = length * result.held_out_rmse_m
        print(
            f"{folder.model_path}: {held_out_text(error, baselines)} over "
            f"{config.window_length} steps; {result.status.value}"
        )
        print(
            f"trained for {seconds:.0f} s, compilation included; contact distance "
            f"{contact_distance_text(facts.in_data_units(result.model, preset))}"
            + ("" if sensor is None else f"; contact sensor: {sensor_text(sensor)}")
        )
        if not result.baselines.moving:
            _warn(
                f"{self.data}: no body moves more than 1 mm in the held-out windows; the error is "
                "over all bodies"
            )
        if not result.is_better:
            _warn(
                f"{self.out}: the model is no better than constant velocity or standing still on "
                "the held-out trajectories; try more data, more steps or another --model"
            )

    def _facts(self, dataset: Dataset) -> "Facts":
        """What the dataset tells, and the options that override it.

        Raises `InvalidInputError` where data and options do not fit.
        """
        from contactgraph.bodies.graph import usual_edge_types
        from contactgraph.identify import identify, relation_facts, scene_facts

        if self.model.startswith("ours") and self.model != "ours-full-ab":
            facts = identify(dataset, self.contact_distance)
        else:
            related = self.model == "relations"
            facts = relation_facts(dataset) if related else scene_facts(dataset)
            if facts.config.hinges and related:
                raise InvalidInputError("--model relations: it has no hinges, but some bodies have")
            if self.contact_distance is not None:
                facts = facts.with_contact_distance(self.contact_distance)
        star, gumbel = self.graph == "star", self.sampling == "gumbel"
        config = replace(facts.config, star=star, gumbel=gumbel, temperature=self.temperature)
        if self.edge_types is not None:
            config = replace(config, edge_types=usual_edge_types(self.edge_types))
        share = facts.rollout_from if self.rollout_from is None else self.rollout_from
        return replace(facts, config=config, rollout_from=share)

    def _started_with(self, config: dict[str, Any]) -> "Train":
        """The options that the run folder was started with."""
        options: dict[str, Any] = {}
        for option in fields(self):
            if option.name in ("data", "out", "resume", "device"):
                continue
            # An option may be younger than the run. One without a default is a number or null.
            value, default = config.get(option.name, option.default), option.default
            types = (int, float, type(None)) if default is None else (type(default),)
            if type(value) not in types:
                like = "a number" if default is None else f"like {default!r}"
                raise InvalidInputError(
                    f"{self.out / 'config.json'}: {option.name} must be {like}, found {value!r}"
                )
            options[option.name] = value
        return Train(data=self.data, out=self.out, **options)


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _warn(text: str) -> None:
    print(f"contactgraph: warning: {text}", file=sys.stderr)


_OTHERS = "ablations and the paper's forms"
_SHOWN = ("edge_types", "graph", "sampling", "temperature", "every", "bystanders", "prior_weight")
_CONFIG = (
    *("steps", "batch_size", "window_length", "learning_rate"),
    *("event_fraction", "bystanders", "use_contacts"),
)
