"""A metric and a prediction of one's own: errors that 95 % of the windows stay below; slowing down.

Usage: python examples/extend_metric.py

A metric is a function of the recorded windows and one prediction of them. It is passed to
`evaluate_open_loop` by name and computed for every prediction that it is known for: the model's,
the baselines', and those of your own. In this folder also:
contactgraph evaluate RUN DATA --metric extend_metric:late_touches
    --prediction extend_metric:slowing
"""

import numpy as np

from contactgraph.data import Dataset, Trajectory
from contactgraph.envs import PickupExpert, PickupTask
from contactgraph.evaluate import Prediction, RecordedWindows, collect, evaluate_open_loop
from contactgraph.model import load_model, shipped_model


def final_error_p95(windows: RecordedWindows, prediction: Prediction) -> float:
    """m; over the nodes that exist, at the last step of each window."""
    last = np.sqrt(prediction.squared_error[:, -1])
    return float(np.percentile(last[windows.exists], 95))


def late_touches(windows: RecordedWindows, prediction: Prediction) -> float | None:
    """Share of the touches whose very step was not predicted; None without any touch."""
    if prediction.edge_active is None or windows.contact is None:
        return None
    begins = windows.contact[:, 1:] & ~windows.contact[:, :-1]
    return 1.0 - float(prediction.edge_active[begins].mean()) if begins.any() else None


def slowing(trajectory: Trajectory, steps: int) -> np.ndarray:
    """[S, H, N, 2] m: all speeds fall by a fifth with every step."""
    starts = trajectory.steps - steps + 1
    moved = trajectory.scene.dt * np.cumsum(0.8 ** np.arange(1, steps + 1))[:, None, None]
    return trajectory.position[:starts, None] + moved * trajectory.velocity[:starts, None]


if __name__ == "__main__":
    metrics = evaluate_open_loop(
        load_model(shipped_model("pickup")).model,
        Dataset(tuple(collect([PickupTask], [PickupExpert()], episodes=3, seed=0))),
        predictions={"slowing": slowing},
        metrics={"final_error_p95_m": final_error_p95, "late_touches": late_touches},
    )
    numbers = metrics.to_json()
    print(f"RMSE {1e3 * metrics['n_step_rmse_moving_m']:.3f} mm over {metrics['windows']} windows")
    for whose, name in (("the model's", ""), ("slowing down's", "slowing_")):
        error = 1e3 * numbers[f"{name}final_error_p95_m"]
        print(f"95 % of {whose} final errors are below {error:.3f} mm")
    print(f"touches not predicted on time: {100 * numbers['late_touches']:.0f} %")
