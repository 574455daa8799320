import json
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evaluation_worlds import DT, Explodes, Fades, GluedBodies, random_run

from contactgraph.data import Dataset, InvalidInputError, Scene, Trajectory, strip_contacts
from contactgraph.envs import PickupExpert, PickupTask
from contactgraph.evaluate import (
    Prediction,
    RecordedWindows,
    collect,
    evaluate_open_loop,
    model_diagnostics,
)
from contactgraph.model import PRESETS, ModelConfig, ours
from contactgraph.policies import SensorFaults


@pytest.fixture(scope="module")
def pickups() -> Dataset:
    return Dataset(tuple(collect([lambda: PickupTask(1)], [PickupExpert()], 2, 0)))


@pytest.fixture(scope="module")
def glued(pickups):
    return evaluate_open_loop(GluedBodies(), pickups)


@pytest.fixture(scope="module")
def untrained():
    return PRESETS["ours-recurrent"](ModelConfig(2, 2, DT, width=8), key=jax.random.key(0))


def test_corrected_by_contacts_the_frozen_contact_world_is_its_floor(glued):
    assert glued["n_step_rmse_m"] == pytest.approx(glued["frozen_contact_rmse_m"], rel=1e-3)
    model, oracle = (glued.predictions[name] for name in ("n_step", "frozen_contact"))
    assert np.allclose(model.squared_error, oracle.squared_error, atol=1e-5)
    assert (
        glued["frozen_contact_rmse_free_m"] < 1e-4 < 0.01 < glued["constant_velocity_rmse_free_m"]
    )
    assert glued["frozen_contact_rmse_contact_m"] == pytest.approx(
        glued["n_step_rmse_contact_m"], 1e-3
    )
    assert glued["constant_velocity_rmse_contact_m"] > 0.03
    assert glued["n_step_rmse_free_m"] < 1e-4 and glued["n_step_rmse_contact_m"] > 0.03
    assert glued["edge_precision"] == 1.0
    assert (glued["runs"], glued["windows"], glued["n_steps"]) == (2, 2 * 191, 10)


def test_errors_by_type_and_by_run_are_those_of_the_moving_bodies(glued):
    windows, found = glued.recorded, glued.to_json()
    squared = glued.predictions["n_step"].squared_error.transpose(0, 2, 1)

    def rms(chosen):
        return pytest.approx(np.sqrt(squared[windows.moves & chosen].mean()))

    for node, name in enumerate(("gripper", "object")):
        assert found["n_step_rmse_moving_by_type_m"][name] == rms(np.arange(3) == node)
    of_runs = [rms((windows.trajectory == run)[:, None]) for run in (0, 1)]
    assert found["n_step_rmse_moving_by_run_m"] == of_runs and of_runs[0] != of_runs[1]


def test_drift_is_the_largest_error_where_nothing_moves(pickups):
    """Of the recordings at rest, one has velocities that a model takes at their word."""
    moves = pickups.trajectories[0]
    still = np.broadcast_to(moves.position[:1], moves.position.shape)
    at_rest = replace(moves, position=still, velocity=0.0 * still, control=0.0 * moves.control)
    slow = replace(at_rest, velocity=np.full_like(still, 0.005 / 2**0.5))
    found = evaluate_open_loop(GluedBodies(), Dataset((moves, at_rest, slow)))
    assert found["rest_drift_m"] == pytest.approx(0.005 * 10 * DT, rel=1e-4)
    assert evaluate_open_loop(GluedBodies(), Dataset((moves,)))["rest_drift_m"] is None


def test_edges_are_labelled_by_holding_where_it_is_recorded(pickups):
    touching = [
        replace(each, contact=np.ones_like(each.contact), holding=each.contact) for each in pickups
    ]
    found, expected = (
        evaluate_open_loop(GluedBodies(), data, faults=SensorFaults(miss_rate=0.2)).numbers
        for data in (Dataset(tuple(touching)), pickups)
    )
    # Of two types `holding` and `probability` differ by rounding.
    known = {name: value for name, value in expected.items() if isinstance(value, float)}
    assert {name: found[name] for name in known} == pytest.approx(known, rel=1e-5)
    assert {name for name in found if found[name] is None} == {
        name for name in expected if expected[name] is None
    }


@pytest.mark.slow
def test_a_switch_and_the_lack_of_a_control_change_no_prediction(untrained):
    run = random_run(2, 5, 0)
    passive = replace(run, scene=replace(run.scene, actuated=np.zeros(2, bool)))

    def errors(trajectory: Trajectory, control: np.ndarray) -> np.ndarray:
        model = replace(untrained, control_size=control.shape[1])
        data = Dataset((replace(trajectory, control=control),))
        found = evaluate_open_loop(model, data, horizon_s=2 * DT)
        return found.predictions["n_step"].squared_error

    still = errors(passive, np.zeros((5, 2)))
    np.testing.assert_allclose(errors(passive, np.zeros((5, 0))), still, rtol=1e-5)
    switched = np.column_stack([run.control, np.ones(5)])
    np.testing.assert_allclose(errors(run, switched), errors(run, run.control), rtol=1e-5)


def test_without_measured_contacts_it_predicts_none(glued):
    assert glued["edge_recall_unmeasured"] == 0.0 and glued["edge_precision_unmeasured"] is None
    assert glued["edge_recall"] > 0.9
    assert glued["n_step_rmse_unmeasured_m"] > 2 * glued["n_step_rmse_m"]


def test_a_missed_onset_costs_what_remains_of_its_window(glued):
    # An onset in every step of the window, as often as every other: 10 … 1 steps remain.
    assert glued["switch_time_error_s"] == pytest.approx(5.5 * DT)


def test_a_predicted_contact_is_on_time(pickups, glued):
    seer = evaluate_open_loop(GluedBodies(reach=0.081), pickups)
    assert seer["switch_time_error_s"] < glued["switch_time_error_s"]
    assert seer["edge_recall"] > glued["edge_recall"]
    assert seer["n_step_rmse_contact_m"] < glued["n_step_rmse_contact_m"]


def test_metrics_against_a_loop():
    """Every window of a run in which nothing holds, in numpy alone."""
    run = random_run(3, 12, 2)
    found = evaluate_open_loop(GluedBodies(), Dataset((run,)), horizon_s=3 * DT)
    errors, moving, free, changed, cells = [], [], [], [], np.zeros((2, 2), int)
    for start in range(10):
        joined = run.contact[start] | np.eye(3, dtype=bool)
        joined = np.linalg.matrix_power(joined.astype(int), 3) > 0
        window = run.contact[start : start + 4]
        is_free = (window == window[0]).all()
        position, velocity = run.position[start].copy(), run.velocity[start].copy()
        travel = np.zeros(3)
        squared = []
        for step in range(3):
            velocity = np.array([velocity[group].mean(axis=0) for group in joined])
            push = np.array([group[0] / group.sum() for group in joined])[:, None]
            acceleration = push * run.control[start + step]
            # GluedBodies moves with the old velocity in the step of an impact.
            old = position + 0.55 * DT**2 * acceleration
            before = run.velocity[start] if step == 0 else velocity
            position, velocity = old + DT * before, velocity + DT * acceleration
            truth = run.position[start + step + 1]
            squared.append(np.sum((position - truth) ** 2, axis=1))
            travel = np.maximum(travel, np.linalg.norm(truth - run.position[start], axis=1))
            for first, second in ((0, 1), (0, 2), (1, 2)):
                active = run.contact[start, first, second]
                cells[int(active), int(run.contact[start + step + 1, first, second])] += 1
        errors.append(squared)
        moving.append(np.array(squared)[:, travel > 1e-3])
        (free if is_free else changed).append(squared)

    def rms(values):
        return pytest.approx(np.sqrt(np.mean(np.concatenate([np.ravel(v) for v in values]))), 1e-4)

    assert len(free) and len(changed)
    assert found["n_step_rmse_m"] == rms(errors) and found["n_step_rmse_moving_m"] == rms(moving)
    assert found["n_step_rmse_free_m"] == rms(free) and found["n_step_rmse_contact_m"] == rms(
        changed
    )
    assert found["edge_precision"] == pytest.approx(cells[1, 1] / cells[1].sum())
    assert found["edge_recall"] == pytest.approx(cells[1, 1] / cells[:, 1].sum())
    assert found["edge_accuracy"] == pytest.approx(np.trace(cells) / cells.sum())
    assert np.allclose(found.predictions["n_step"].squared_error, errors, atol=1e-7)


def test_the_belief_is_carried_once_for_every_step():
    found = evaluate_open_loop(Fades(), Dataset((random_run(2, 8, 2),)), horizon_s=3 * DT)
    # Step h of a window that starts from state t is the (t + h + 1)-th; 0.8^3 > 1/2 > 0.8^4.
    made = found.recorded.start[:, None] + np.arange(3) + 1
    active = found.predictions["n_step_unmeasured"].edge_active
    assert np.array_equal(active[:, :, 0], made <= 3)


def test_unrecorded_values_are_none_and_the_rest_is_the_same(untrained):
    dataset = Dataset((random_run(3, 8, 0, goal=np.ones(2)), random_run(3, 8, 1)))
    full = evaluate_open_loop(untrained, dataset, horizon_s=3 * DT)
    bare = evaluate_open_loop(untrained, strip_contacts(dataset), horizon_s=3 * DT)
    for name in ("frozen_contact_rmse_m", "n_step_rmse_free_m", "n_step_rmse_contact_m"):
        assert full[name] is not None and bare[name] is None
    assert all(value is None for name, value in bare.numbers.items() if name.startswith("edge_"))
    assert bare["switch_time_error_s"] is bare["switch_time_error_unmeasured_s"] is None
    assert (
        bare["n_step_rmse_m"]
        == bare["n_step_rmse_unmeasured_m"]
        == full["n_step_rmse_unmeasured_m"]
    )
    assert bare["constant_velocity_rmse_m"] == full["constant_velocity_rmse_m"]
    assert full["n_step_rmse_m"] != full["n_step_rmse_unmeasured_m"]
    one, other = dataset.trajectories
    partly = Dataset((one, replace(other, contact=None)))
    assert evaluate_open_loop(untrained, partly, horizon_s=3 * DT)["edge_f1"] is None
    weightless = Dataset((one, replace(other, scene=replace(other.scene, mass=None))))
    found = evaluate_open_loop(untrained, weightless, horizon_s=3 * DT)
    assert found["frozen_contact_rmse_m"] is None and found["edge_f1"] == full["edge_f1"]


def last_error(windows: RecordedWindows, prediction: Prediction) -> float:
    return float(np.sqrt(prediction.squared_error[:, -1][windows.exists].max()))


def test_a_metric_of_ones_own_is_of_every_prediction(untrained):
    dataset = Dataset((random_run(3, 8, 0),))
    metrics = {
        "last_error_m": last_error,
        "unknown": lambda *_: None,
        "edges": lambda _, each: None if each.edge_active is None else np.inf,
    }
    found = evaluate_open_loop(untrained, dataset, horizon_s=3 * DT, metrics=metrics)
    numbers = found.to_json()
    standing = found.predictions["standing_still"]
    own = {
        "last_error_m": last_error(found.recorded, found.predictions["n_step"]),
        "standing_still_last_error_m": last_error(found.recorded, standing),
        **dict.fromkeys(("unknown", "edges", "edges_unmeasured")),
    }
    assert {name: numbers[name] for name in own} == own and own["last_error_m"] > 0.0
    more = {"last_error_unmeasured_m", "constant_velocity_last_error_m"}
    more.add("frozen_contact_last_error_m")
    plain = evaluate_open_loop(untrained, dataset, horizon_s=3 * DT).to_json()
    assert numbers.keys() - plain.keys() == own.keys() | more
    assert {name: numbers[name] for name in plain} == plain
    with pytest.raises(InvalidInputError, match="metrics must have new names, found 'windows'"):
        evaluate_open_loop(untrained, dataset, horizon_s=3 * DT, metrics={"windows": last_error})


def test_a_prediction_of_ones_own_has_every_metric_that_it_determines(pickups):
    """Beside the model's, on the same windows, and for the verdict."""

    def shifted(trajectory: Trajectory, steps: int) -> np.ndarray:
        starts = trajectory.steps - steps + 1
        true = [trajectory.position[start + 1 : start + steps + 1] for start in range(starts)]
        return np.stack(true) + np.array([0.003, 0.004])

    def turning(trajectory: Trajectory, steps: int) -> np.ndarray:
        poses = shifted(trajectory, steps)
        return np.concatenate([poses, 0.0 * poses[..., :1]], axis=-1)

    own = {"shifted": shifted, "turning": turning, "unknown": lambda *_: None}
    found = evaluate_open_loop(GluedBodies(), pickups, predictions=own)
    for name in ("rmse", "rmse_moving", "rmse_free", "mean_moving"):
        assert found[f"shifted_{name}_m"] == pytest.approx(0.005)
    assert found["shifted_rmse_moving_by_run_m"] == pytest.approx([0.005, 0.005])
    assert found["unknown_rmse_m"] is None and found.predictions["unknown"] is None
    assert found["shifted_diverged_windows"] == 0 and "shifted" in found.unbeaten
    assert found.predictions["shifted"].squared_angle is None
    assert found.predictions["turning"].squared_angle is not None
    assert "shifted_edge_f1" not in found.numbers
    plain = evaluate_open_loop(GluedBodies(), pickups)
    assert {name: found[name] for name in plain.numbers if name != "verdict"} == {
        name: value for name, value in plain.numbers.items() if name != "verdict"
    }
    for predictions, message in (
        ({"n_step": shifted}, "predictions must have new names, found 'n_step'"),
        ({"flat": lambda *of: shifted(*of)[..., :1]}, "prediction 'flat' must have the shape"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            evaluate_open_loop(GluedBodies(), pickups, predictions=predictions)


def test_trajectories_of_different_sizes_are_as_each_alone(untrained):
    runs = (random_run(2, 6, 0), random_run(4, 11, 1), random_run(3, 2, 2))
    together = evaluate_open_loop(untrained, Dataset(runs), horizon_s=3 * DT)
    windows = together.recorded
    assert windows.trajectory.tolist() == [0] * 4 + [1] * 9  # the third is too short
    squared = together.predictions["n_step"].squared_error
    real = [squared[windows.trajectory == n][..., : 2 + 2 * n] for n in (0, 1)]
    assert windows.rmse(squared) == pytest.approx(
        np.sqrt(np.mean(np.concatenate([errors.ravel() for errors in real])))
    )
    first = windows.trajectory == 0
    assert windows.rmse(squared, first) == pytest.approx(np.sqrt(np.mean(real[0])))
    for number in (0, 1):
        alone = evaluate_open_loop(untrained, Dataset((runs[number],)), horizon_s=3 * DT)
        mine, count = windows.trajectory == number, runs[number].scene.node_count
        edges = count * (count - 1) // 2
        assert np.array_equal(windows.start[mine], alone.recorded.start)
        for name in ("n_step", "n_step_unmeasured", "frozen_contact"):
            found = together.predictions[name].squared_error[mine]
            expected = alone.predictions[name].squared_error
            assert np.allclose(found[..., :count], expected, rtol=1e-4, atol=1e-8)
            assert not found[..., count:].any()
        assert np.array_equal(windows.exists[mine][:, :count], alone.recorded.exists)
        assert not windows.exists[mine][:, count:].any()
        assert np.array_equal(windows.contact[mine][..., :edges], alone.recorded.contact)
        both, one = (each.predictions["n_step"].edge_active for each in (together, alone))
        assert np.array_equal(both[mine][..., :edges], one)
        assert np.array_equal(windows.contact_changes[mine], alone.recorded.contact_changes)
        assert not windows.edge_exists[mine][:, edges:].any()


def test_a_single_body_has_no_edges():
    lonely = evaluate_open_loop(GluedBodies(), Dataset((random_run(1, 5, 0),)), horizon_s=2 * DT)
    assert lonely["edge_accuracy"] is None and lonely["n_step_rmse_m"] > 0
    assert lonely["n_step_rmse_m"] == pytest.approx(lonely["frozen_contact_rmse_m"], rel=0.1)


def test_another_model_of_the_same_kind_has_other_numbers(untrained):
    dataset = Dataset((random_run(3, 8, 0),))
    first = evaluate_open_loop(untrained, dataset, horizon_s=3 * DT)
    params, static = eqx.partition(untrained, eqx.is_inexact_array)
    changed = eqx.combine(jax.tree.map(lambda leaf: 1.1 * leaf, params), static)
    second = evaluate_open_loop(changed, dataset, horizon_s=3 * DT)
    assert first["n_step_rmse_m"] != second["n_step_rmse_m"]
    assert first["constant_velocity_rmse_m"] == second["constant_velocity_rmse_m"]


def test_a_model_that_explodes_is_reported_and_is_valid_json():
    found = evaluate_open_loop(Explodes(), Dataset((random_run(2, 6, 0),)), horizon_s=2 * DT)
    assert found["diverged_windows"] == found["windows"] == 5
    assert found["n_step_rmse_m"] == np.inf
    assert found.to_json()["n_step_rmse_m"] is None
    assert found.to_json()["constant_velocity_rmse_m"] > 0
    assert json.loads(json.dumps(found.to_json(), allow_nan=False)) == found.to_json()
    assert set(found.to_json()["n_step_rmse_moving_by_type_m"].values()) == {None}


def test_the_usual_horizon_is_one_step_where_that_is_longer():
    slow = random_run(2, 3, 0)
    slow = replace(slow, scene=replace(slow.scene, dt=1.0))
    found = evaluate_open_loop(GluedBodies(), Dataset((slow,)))
    assert (found["n_steps"], found["windows"]) == (1, 3)


@pytest.mark.parametrize("horizon", [0.0, -1.0, 0.3, 0.12, np.nan, np.inf])
def test_a_horizon_of_no_whole_steps_or_longer_than_every_trajectory(untrained, horizon):
    message = r"the horizon must be a multiple of the time step, 0.05 s, up to 0.25 s"
    with pytest.raises(InvalidInputError, match=message):
        evaluate_open_loop(untrained, Dataset((random_run(2, 5, 0),)), horizon_s=horizon)


@pytest.mark.parametrize("known", [True, False])
def test_errors_of_angles_are_those_of_bodies_that_turn(known: bool) -> None:
    """A box spins by 10 rad/s, of which the recording says so, or 0."""
    square = 0.1 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    scene = Scene(
        *(("box", "other"), ("box", "box"), np.zeros(2, bool), DT),
        polygons=(square, square),
        polygon_of=np.arange(2),
    )
    still = np.broadcast_to([[0.0, 0.0], [2.0, 0.0]], (9, 2, 2))
    turn = np.zeros((9, 2, 1))
    turn[:, 0, 0] = 10.0 * DT * np.arange(9)
    rate = np.full_like(turn, 10.0 * known) * [[1.0], [0.0]]
    recorded = Trajectory(
        scene, still, 0.0 * still, np.zeros((8, 0)), orientation=turn, angular_velocity=rate
    )
    config = ModelConfig(2, 0, DT, width=4, node_types=("box",), turn_length=0.1)
    model = ours(replace(config, inertia={"box": 1.0}), key=jax.random.key(0))
    head = model.local_dynamics.head
    slippery = eqx.tree_at(
        lambda each: [each.damper_raw, each.deceleration_raw], head, [jnp.full(1, -9.0)] * 2
    )
    model = eqx.tree_at(lambda each: each.local_dynamics.head, model, slippery)
    found = evaluate_open_loop(model, Dataset((recorded,)), horizon_s=2 * DT).to_json()
    expected = 0.0 if known else 10.0 * DT * np.sqrt(np.mean(np.square([1.0, 2.0])))
    assert found["angle_rmse_rad"] == pytest.approx(expected, abs=1e-5)
    assert found["constant_velocity_angle_rmse_rad"] == pytest.approx(expected, abs=1e-9)
    assert found["turned_over_accuracy"] == known  # by 57 degrees in a window
    # Pictures show the parameters of positions alone.
    parameters = model_diagnostics(model, recorded).parameters
    assert parameters is not None and parameters.inverse_mass.shape == (8, 2, 2)
