"""``contactgraph info``: what is in a dataset, a model, a run or a learned cost."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg


@dataclass(frozen=True)
class Info:
    """Say what is in a dataset, a model, a cost file, a run folder, or a model that ships."""

    file: Positional[Annotated[str, arg(metavar="FILE")]]
    """The file or folder, or the name of a model that ships with the package."""

    def run(self) -> None:
        """Look and say."""
        from contactgraph.data import InvalidInputError
        from contactgraph.model import shipped_models

        path = Path(self.file)
        if path.is_dir():
            self._run_folder(path)
        elif path.suffix == ".safetensors" or (not path.exists() and self.file in shipped_models()):
            self._model()
        elif path.exists() and path.suffix.lower() == ".json":
            self._cost(path)
        elif path.exists():
            self._dataset(path)
        else:
            raise InvalidInputError(
                f"{self.file}: does not exist; models that ship are {', '.join(shipped_models())}"
            )

    def _run_folder(self, path: Path) -> None:
        from contactgraph.train import RunFolder

        folder = RunFolder(path)
        config, rows = folder.config(), folder.metrics()
        print(f"{path}: run folder, {config.get('model')}, seed {config.get('seed')}")
        print(f"  data        {config.get('data')}")
        if rows:
            last = rows[-1]
            print(f"  trained     {last['step']:.0f} of {config.get('steps')} steps")
            best = min(row["held_out_rmse_m"] for row in rows)
            print(f"  held-out    {100 * best:.3f} cm")
        else:
            print("  trained     no checkpoint yet")
        for checkpoint in folder.checkpoints():
            print(f"  checkpoint  {checkpoint.name}")

    def _model(self) -> None:
        from contactgraph.cli.models import model_path
        from contactgraph.model.io import describe_model

        path = model_path(self.file)
        summary = describe_model(path)
        print(f"{self.file}: model, {summary.parameter_count} parameters, {summary.size} bytes")
        print(f"  degrees of freedom  {summary.dimension} a node, control {summary.control_size}")
        print(f"  dt                  {summary.dt} s")
        for name, value in summary.training.items():
            print(f"  {name:<19} {_text(value)}")
        print(f"  parts               {_text(summary.model)}")

    def _cost(self, path: Path) -> None:
        from contactgraph.cli.cost_words import participant_lines, term_lines
        from contactgraph.control import describe_cost

        summary = describe_cost(path)
        cost = summary.cost
        goal = ", ".join(f"{float(number):.3g}" for number in cost.goal)
        print(f"{path}: learned cost about {', '.join(cost.kept_nodes)}")
        print(f"  degrees of freedom  {len(cost.goal)} a node, control {len(cost.R)}")
        print(f"  goal                {goal} m; control takes the scene's")
        for line in (*participant_lines(cost), *term_lines(cost)):
            print(f"  {line}")
        for name, value in summary.made.items():
            print(f"  {name:<22}{_text(value)}")

    def _dataset(self, path: Path) -> None:
        from contactgraph.data import describe_file

        summary = describe_file(path)
        nodes = [len(names) for names in summary.node_name]
        print(f"{path}: dataset, {len(summary.steps)} runs, {summary.size} bytes")
        print(f"  steps     {_span(summary.steps)} of {summary.dt[0]} s")
        print(f"  nodes     {_span(nodes)}: {', '.join(summary.node_name[0])}")
        print(f"  control   {_span(summary.control_size)}")
        labelled = sum(bool(has) for has in summary.has_contact)
        print(f"  contacts  in {labelled} of {len(summary.steps)} runs")
        for name, value in summary.metadata.items():
            print(f"  {name:<9} {_text(value)}")


def _span(values: Any) -> str:
    low, high = min(values), max(values)
    return str(low) if low == high else f"{low} to {high}"


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
