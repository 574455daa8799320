"""A metric of one's own: the error at the end of the horizon that 95 % of the windows stay below.

Usage: python examples/extend_metric.py

A metric is a function of all predicted windows (`OpenLoopDetail`). It is passed to
`evaluate_open_loop` by name, and its value stands beside the built-in ones in `to_json`. In this
folder also: contactgraph evaluate RUN DATA --metric extend_metric:late_touches
"""

import numpy as np

from contactgraph.data import Dataset
from contactgraph.envs import PickupExpert, PickupTask
from contactgraph.evaluate import OpenLoopDetail, collect, evaluate_open_loop
from contactgraph.model import load_model, shipped_model


def final_error_p95(detail: OpenLoopDetail) -> float:
    """m; over the nodes that exist, at the last step of each window."""
    last = np.sqrt(detail.measured.squared_error[:, -1])
    return float(np.percentile(last[detail.exists], 95))


def late_touches(detail: OpenLoopDetail) -> float | None:
    """Share of the touches whose very step was not predicted; None without any touch."""
    on_time = detail.measured.touch_on_time
    return 1.0 - float(on_time.mean()) if len(on_time) else None


if __name__ == "__main__":
    metrics = evaluate_open_loop(
        load_model(shipped_model("pickup")).model,
        Dataset(tuple(collect([PickupTask], [PickupExpert()], episodes=3, seed=0))),
        metrics={"final_error_p95_m": final_error_p95, "late_touches": late_touches},
    )
    numbers = metrics.to_json()
    print(f"RMSE {1e3 * metrics['n_step_rmse_moving_m']:.3f} mm over {metrics.windows} windows")
    print(f"95 % of the final errors are below {1e3 * numbers['final_error_p95_m']:.3f} mm")
    print(f"touches not predicted on time: {100 * numbers['late_touches']:.0f} %")
