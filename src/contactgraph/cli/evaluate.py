"""``contactgraph evaluate``: how well a model predicts recorded runs."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


@dataclass(frozen=True)
class Evaluate:
    """Predict recorded runs half a second ahead from every state, and measure the errors."""

    model: Positional[Annotated[str, arg(metavar="MODEL")]]
    """A run folder, a model file, or a model that ships with the package (pickup)."""
    data: Positional[Annotated[Path, arg(metavar="DATA")]]
    """A dataset file (HDF5)."""
    json: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write the measurements to this file."""
    false_alarms: Annotated[float, arg(metavar="RATE")] = 0.0
    """Share of free edges that a lying sensor reports as touching, at every step."""
    misses: Annotated[float, arg(metavar="RATE")] = 0.0
    """Share of touching edges that it reports as free."""
    delay: Annotated[int, arg(metavar="STEPS")] = 0
    """Steps by which the sensor is late."""
    infer_contacts: bool = False
    """Predict by beliefs, too, that are corrected by the motion seen and by no measured contact."""
    growth_steps: Annotated[int | None, arg(metavar="STEPS")] = None
    """Roll the model out so many steps from the start of every run too: does it stay bounded?"""

    def run(self) -> None:
        """Evaluate and say."""
        from contactgraph.cli.models import in_steps_of, model_path
        from contactgraph.cli.options import check_range, sensor_faults
        from contactgraph.cli.output import check_writable, write_json
        from contactgraph.data import read_trajectories
        from contactgraph.evaluate import evaluate_open_loop, rollout_growth
        from contactgraph.model import MotionNoise
        from contactgraph.model.io import load_model

        check_writable(self.json)
        faults = sensor_faults(self.false_alarms, self.misses, self.delay, seed=0)
        if self.growth_steps is not None:
            check_range("--growth-steps", self.growth_steps, 1, 100_000)
        model = load_model(model_path(self.model)).model
        dataset = in_steps_of(model, read_trajectories(self.data), str(self.data))
        motion_noise = MotionNoise() if self.infer_contacts else None
        measured = evaluate_open_loop(model, dataset, faults=faults, motion_noise=motion_noise)
        metrics = measured.to_json()
        values = {
            "run": self.model,
            "data": str(self.data),
            "episodes": len(dataset),
            "seed": dataset.metadata.get("seed"),
            "false_alarms": self.false_alarms,
            "misses": self.misses,
            "delay": self.delay,
            "infer_contacts": self.infer_contacts,
            **metrics,
        }
        if self.growth_steps is not None:
            growth = rollout_growth(model, dataset, self.growth_steps)
            values.update(growth.to_json())
        write_json(self.json, values)
        for line in _lines(values):
            print(line)
        if self.growth_steps is not None:
            print(
                f"over {self.growth_steps} steps the state grows {_times(growth.growth_free)} "
                f"without control, {_times(growth.growth_driven)} with it"
            )
        lacking = sum(run.contact is None for run in dataset)
        if lacking:
            print(
                f"edges were not scored: {lacking} of {len(dataset)} runs in {self.data} have no "
                "contact field"
            )


def _times(growth: float) -> str:
    return f"{growth:.3g} times" if math.isfinite(growth) else "without bound"


def _lines(values: dict) -> list[str]:
    def centimetres(name: str) -> str:
        value = values.get(name)
        return "unknown" if value is None else f"{100 * value:.3f} cm"

    def share(name: str) -> str:
        value = values.get(name)
        return "unknown" if value is None else f"{value:.4f}"

    switch = values.get("switch_time_error_s")
    return [
        f"error over {values['n_steps']} steps      {centimetres('n_step_rmse_m')}",
        f"  bodies that move         {centimetres('n_step_rmse_moving_m')}",
        f"  contact changes          {centimetres('n_step_rmse_contact_m')}",
        f"  contact does not change  {centimetres('n_step_rmse_free_m')}",
        f"floor: frozen contact      {centimetres('frozen_contact_rmse_m')}",
        f"floor: constant velocity   {centimetres('constant_velocity_rmse_m')}",
        f"edges: precision {share('edge_precision')}, recall {share('edge_recall')}, "
        f"F1 {share('edge_f1')}",
        f"edges without measured contacts: F1 {share('edge_f1_unmeasured')}",
        *(
            [f"edges inferred from motion: F1 {share('edge_f1_inferred')}"]
            if values["infer_contacts"]
            else []
        ),
        "contact begins             "
        + ("unknown" if switch is None else f"{1000 * switch:.1f} ms off, mean"),
    ]
