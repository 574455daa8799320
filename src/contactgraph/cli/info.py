"""``contactgraph info``: the contents of a file or folder, or the shipped models and the tasks."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from contactgraph.control import LearnedCost
    from contactgraph.data import Dataset

_LAST_STEPS = 50
"""Steps whose mean is the final imitation loss: each step sees other windows."""


@dataclass(frozen=True)
class Info:
    """Describe a dataset, a model, a cost file or a run folder; list shipped models and tasks."""

    file: Positional[
        Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(optional)")]
    ] = None
    """A file, a folder or the name of a shipped model. Without it, all names are listed."""

    def run(self) -> None:
        """Print the description."""
        from contactgraph.data import InvalidInputError
        from contactgraph.model import shipped_models

        if self.file is None:
            _print_names()
            return
        path = Path(self.file)
        if path.is_dir():
            _print_run_folder(path)
        elif path.suffix == ".safetensors" or (not path.exists() and self.file in shipped_models()):
            _print_model(self.file)
        elif path.exists() and path.suffix.lower() == ".json":
            _print_cost(path)
        elif path.exists():
            _print_dataset(path)
        else:
            raise InvalidInputError(
                f"{self.file}: does not exist; models that ship are {', '.join(shipped_models())}"
            )


def _print_names() -> None:
    from contactgraph.data import InvalidInputError
    from contactgraph.envs.registry import task_factory, task_names, task_spec
    from contactgraph.model import shipped_model, shipped_models
    from contactgraph.model.io import describe_model

    print("models that ship with the package:")
    own_task = "module:Class"
    width = 2 + max(map(len, (*shipped_models(), *task_names(), own_task)))
    for name in shipped_models():
        summary = describe_model(shipped_model(name))
        dt = summary.config.dt
        print(f"  {name:<{width}}{summary.parameter_count} parameters, steps of {dt:g} s")
    print("tasks:")
    for name in task_names():
        try:
            task_factory(name, {})
            text = task_spec(name).summary
        except (InvalidInputError, ImportError) as error:  # a missing extra
            text = f"not available: {error}"
        print(f"  {name:<{width}}{text}")
    print(f"  {own_task:<{width}}a class of your own")


def _print_run_folder(path: Path) -> None:
    from contactgraph.train import RunFolder

    folder = RunFolder(path)
    config, rows = folder.config(), folder.metrics()
    print(f"{path}: run folder, {config.get('model')}, seed {config.get('seed')}")
    print(f"  data        {config.get('data')}")
    if rows:
        print(
            f"  trained     {rows[-1]['step']:.0f} of {config.get('steps')} steps "
            f"in {rows[-1]['seconds']:.0f} s"
        )
        best = min(row["held_out_rmse_m"] for row in rows)
        print(f"  held-out    {100 * best:.3f} cm, last {100 * rows[-1]['held_out_rmse_m']:.3f} cm")
    else:
        print("  trained     no checkpoint yet")
    for checkpoint in folder.checkpoints():
        print(f"  checkpoint  {checkpoint.name}")


def _print_model(name: str) -> None:
    from contactgraph.cli.models import contact_distance_text, model_path, stored_model
    from contactgraph.data import InvalidInputError
    from contactgraph.model.io import describe_model

    summary = describe_model(model_path(name))
    try:
        distance = contact_distance_text(stored_model(name))
    except InvalidInputError as error:  # parts of the user's own, without their preset
        distance = f"unknown ({error})"
    print(f"{name}: model, {summary.parameter_count} parameters, {summary.size} bytes")
    config = summary.config
    print(f"  preset              {summary.preset}")
    print(f"  degrees of freedom  {config.dimension} a node, control {config.control_size}")
    print(f"  dt                  {config.dt} s")
    print(f"  contact distance    {distance}")
    for key, value in summary.training.items():
        print(f"  {key:<19} {_text(value)}")


def _print_cost(path: Path) -> None:
    from contactgraph.control import describe_cost

    summary = describe_cost(path)
    cost = summary.cost
    goal = ", ".join(f"{float(number):.3g}" for number in cost.goal)
    print(f"{path}: learned cost about {', '.join(cost.kept_nodes)}")
    print(f"  degrees of freedom  {len(cost.goal)} a node, control {len(cost.R)}")
    print(f"  goal                {goal} m; control takes the scene's")
    for line in cost_lines(cost):
        print(f"  {line}")
    for name, value in summary.made.items():
        print(f"  {name:<22}{_text(value)}")


def cost_lines(cost: "LearnedCost") -> list[str]:
    """The cost's nodes, weights and imitation loss, as lines of text."""
    from contactgraph.control import cost_terms

    lines = [f"kept     {each.name}: {each.reason}" for each in cost.task_nodes if each.kept]
    dropped: dict[str, list[str]] = {}
    for each in cost.task_nodes:
        if not each.kept:
            dropped.setdefault(each.reason, []).append(each.name)
    lines += [f"dropped  {', '.join(names)}: {why}" for why, names in dropped.items()]
    terms = cost_terms(cost)
    width = max(len(term.name) for term in terms)
    lines += [
        f"{term.name:<{width}}  1 m costs as much as {term.position:.3g} N, "
        f"1 m/s as much as {term.velocity:.3g} N"
        for term in terms
    ]
    lines += [
        f"{each.kind} {' - '.join(each.nodes)}  each step "
        f"{'of contact' if each.kind == 'avoid' else 'without'} costs as much as "
        f"{each.weight**0.5:.3g} N"
        for each in cost.contacts
    ]
    loss = cost.history.imitation
    first, last = float(loss[0]), float(loss[-_LAST_STEPS:].mean())
    return [*lines, f"imitation loss  {first:.4f} at the beginning, {last:.4f} in the end"]


def _print_dataset(path: Path) -> None:
    from contactgraph.data import read_trajectories
    from contactgraph.data.schema import given_fields
    from contactgraph.interchange.motion import body_motions, motion_warnings

    dataset = read_trajectories(path)
    scenes = [each.scene for each in dataset]
    print(f"{path}: dataset, {len(dataset)} trajectories, {path.stat().st_size} bytes")
    nodes = [scene.node_count for scene in scenes]
    kinds = " or ".join(
        sorted({", ".join(each.control_kind) for each in scenes if each.control_kind})
    )
    static = [int(each.static.sum()) for each in scenes]
    recorded = {"contacts": "contact", "holding": "holding", "orientation": "orientation"}
    rows = {
        "steps": f"{_span([each.steps for each in dataset])} of {dataset.dt} s",
        "nodes": f"{_span(nodes)}: {', '.join(scenes[0].node_name)}",
        "control": f"{dataset.control_size}{f': {kinds}' if kinds else ''}",
        **{
            label: f"in {sum(name in given_fields(each) for each in dataset)} of "
            f"{len(dataset)} trajectories"
            for label, name in recorded.items()
        },
        "static": _span(static),
        **_actuation(dataset),
        **{name: _text(value) for name, value in dataset.metadata.items()},
    }
    for name, text in rows.items():
        print(f"  {name:<11} {text}")
    motions = body_motions(dataset)
    for each in motions:
        print(f"  {each}")
    for warning in motion_warnings(motions):
        print(f"  {warning}")


def _actuation(dataset: "Dataset") -> dict[str, str]:
    """A row that says how the control drives each actuated type; none without a control."""
    from contactgraph.data import InvalidInputError
    from contactgraph.identify import identify

    try:
        fits = identify(dataset).in_data.actuation
    except InvalidInputError as error:
        return {"actuation": f"unknown ({error})"}
    return {"actuation": "; ".join(f"{name}: {fit}" for name, fit in fits.items())} if fits else {}


def _span(values: Any) -> str:
    low, high = min(values), max(values)
    return str(low) if low == high else f"{low} to {high}"


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
