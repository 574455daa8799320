"""Output of ``contactgraph control``: keys that are null for scripted policies, and the summary."""

from collections.abc import Mapping
from typing import Any

from contactgraph.evaluate import ClosedLoopMetrics, EstimatedContacts, PlanTrackingError

_PREDICTIONS = ("n_step", "constant_velocity", "standing_still", "frozen_contact")
NOT_PREDICTED: Mapping[str, None] = dict.fromkeys(
    (
        *(
            f"{name}_rmse{of}_m"
            for of in ("_moving", "", "_free", "_contact")
            for name in _PREDICTIONS
        ),
        *(f"edge_{score}" for score in ("precision", "recall", "f1", "accuracy")),
        *("edge_f1_now", "switch_time_error_s", "verdict", "n_steps"),
    )
)
"""The predictions of executed episodes, which need a model."""
NOT_PLANNED: Mapping[str, None] = dict.fromkeys(
    (*PlanTrackingError().to_json(), *EstimatedContacts().to_json())
)
"""What is measured on plans and beliefs alone."""


def print_summary(metrics: ClosedLoopMetrics, predicted: Mapping[str, Any]) -> None:
    """Print the results of episodes; nothing about plans where there are none."""
    low, high = metrics.success_interval
    speed, f1 = metrics.contact_speed_m_s, metrics.estimated.edges.f1
    distance = metrics.goal_distance_m_median
    print(
        f"success                    {100 * metrics.success_rate:.0f} % of "
        f"{metrics.episodes} episodes (95 %: {100 * low:.0f} to {100 * high:.0f})"
    )
    if distance is not None:
        print(f"end to goal, median        {100 * distance:.2f} cm")
    print(f"speed at contact, median   {'no contact' if speed is None else f'{speed:.2f} m/s'}")
    print(f"touched a distractor       {metrics.touched_bystanders} episodes")
    if metrics.plan_ms_p50 is None:
        return
    print(
        f"control step               {metrics.plan_ms_p50:.2f} ms median, "
        f"{metrics.plan_ms_p99:.2f} ms 99 %"
    )
    print(f"contact estimate, F1       {'no contact' if f1 is None else f'{f1:.4f}'}")
    lost = metrics.estimated.to_json()
    if lost["breaks"]:
        noticed = [lost[f"break_delay_ms_p{share}"] for share in (50, 95)]
        late = ["not" if each is None else f"{each:.0f} ms" for each in noticed]
        print(f"lost contact, noticed      {late[0]} median, {late[1]} 95 %")
    planned = metrics.planned
    if predicted["n_steps"] is not None:
        errors = predicted["n_step_rmse_moving_m"], predicted["n_step_rmse_m"]
        title = f"predicted, {predicted['n_steps']} steps ahead"
        print(f"{title:<27}{_moving_and_all(*errors)}")
    if planned.moved_objects:
        print(f"planned, 0.5 s ahead       {_moving_and_all(planned.rmse_moving, planned.rmse)}")
    elif planned.windows:
        print("planned, 0.5 s ahead       no object moved")


def _moving_and_all(moving: float | None, every: float | None) -> str:
    """Errors, m, in words; None is an error that is not finite or not known."""
    texts = ["not known" if each is None else f"{100 * each:.3f} cm" for each in (moving, every)]
    return f"{texts[0]} (bodies that move), {texts[1]} (all)"
