"""``contactgraph info``: the contents of a file or folder, or the shipped models and the tasks."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from contactgraph.data import Dataset, InvalidInputError, read_trajectories
from contactgraph.data.schema import given_fields

if TYPE_CHECKING:
    from contactgraph.control import LearnedCost

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
    config, checks = folder.config(), folder.metrics()
    rows = {"data": config.get("data"), "trained": "no checkpoint yet"}
    if checks:
        best, last = min(each["held_out_rmse_m"] for each in checks), checks[-1]
        rows["trained"] = (
            f"{last['step']:.0f} of {config.get('steps')} steps in {last['seconds']:.0f} s"
        )
        rows["held-out"] = f"{100 * best:.3f} cm, last {100 * last['held_out_rmse_m']:.3f} cm"
    title = f"{path}: run folder, {config.get('model')}, seed {config.get('seed')}"
    _print(title, {**rows, "checkpoints": ", ".join(each.name for each in folder.checkpoints())})


def _print_model(name: str) -> None:
    from contactgraph.cli.models import contact_distance_text, model_path, stored_model
    from contactgraph.model.io import describe_model

    summary = describe_model(model_path(name))
    try:
        distance = contact_distance_text(stored_model(name))
    except InvalidInputError as error:  # parts of the user's own, without their preset
        distance = f"unknown ({error})"
    config = summary.config
    rows = {
        "preset": summary.preset,
        "degrees of freedom": f"{config.dimension} a node, control {config.control_size}",
        "dt": f"{config.dt} s",
        "contact distance": distance,
    }
    title = f"{name}: model, {summary.parameter_count} parameters, {summary.size} bytes"
    _print(title, {**rows, **summary.training})


def _print_cost(path: Path) -> None:
    from contactgraph.control import describe_cost

    cost, made = describe_cost(path)
    goal = ", ".join(f"{float(number):.3g}" for number in cost.goal)
    rows = {
        "degrees of freedom": f"{len(cost.goal)} a node, control {len(cost.R)}",
        "goal": f"{goal} m; control takes the scene's",
        **made,
    }
    _print(f"{path}: learned cost about {', '.join(cost.kept_nodes)}", rows)
    print("\n".join(cost_lines(cost)))


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
        f"{(each.weight if isinstance(each.weight, float) else each.weight[0]) ** 0.5:.3g} N"
        for each in cost.contacts
    ]
    loss = cost.imitation_loss
    first, last = float(loss[0]), float(loss[-_LAST_STEPS:].mean())
    return [*lines, f"imitation loss  {first:.4f} at the beginning, {last:.4f} in the end"]


def _print_dataset(path: Path) -> None:
    from contactgraph.interchange.motion import body_motions, motion_warnings

    dataset = read_trajectories(path)
    scenes = [each.scene for each in dataset]
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
        **dataset.metadata,
    }
    _print(f"{path}: dataset, {len(dataset)} trajectories, {path.stat().st_size} bytes", rows)
    motions = body_motions(dataset)
    for each in (*motions, *motion_warnings(motions)):
        print(f"  {each}")


def _actuation(dataset: Dataset) -> dict[str, str]:
    """A row that says how the control drives each actuated type; none without a control."""
    from contactgraph.identify import identify

    try:
        fits = identify(dataset).in_data.actuation
    except InvalidInputError as error:
        return {"actuation": f"unknown ({error})"}
    return {"actuation": "; ".join(f"{name}: {fit}" for name, fit in fits.items())} if fits else {}


def _span(values: Any) -> str:
    low, high = min(values), max(values)
    return str(low) if low == high else f"{low} to {high}"


def _print(title: str, rows: Mapping[str, Any]) -> None:
    """A title, and below it a line for each value by its name."""
    print(title)
    for name, value in rows.items():
        print(f"  {name:<19} {value if isinstance(value, str) else json.dumps(value)}")
