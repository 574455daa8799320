"""Effects of false and late sensors on beliefs and control."""

import numpy as np
import pytest
from evaluation_worlds import DT, GluedBodies, by_model, random_run, scene_of

from contactgraph.data import Dataset, InvalidInputError, strip_contacts
from contactgraph.envs import PickupExpert, PickupTask
from contactgraph.evaluate import collect, evaluate_open_loop
from contactgraph.model import ContactSensor
from contactgraph.policies import Planning, SensorFaults

RUN = random_run(6, 2000, 0)
OFF_DIAGONAL = ~np.eye(6, dtype=bool)


def test_no_fault_is_the_truth():
    assert SensorFaults().exact
    assert np.array_equal(SensorFaults().reported(RUN.contact, RUN.scene, 3), RUN.contact)
    assert SensorFaults().sensor == ContactSensor()


def test_fault_rates_are_those_configured():
    reported = SensorFaults(0.2, 0.05, seed=1).reported(RUN.contact, RUN.scene, 0)
    assert np.array_equal(reported, reported.swapaxes(1, 2))
    assert not reported[:, ~OFF_DIAGONAL].any()
    touching = RUN.contact[:, OFF_DIAGONAL]
    assert np.mean(~reported[:, OFF_DIAGONAL][touching]) == pytest.approx(0.05, abs=0.01)
    assert np.mean(reported[:, OFF_DIAGONAL][~touching]) == pytest.approx(0.2, abs=0.01)
    wrong = reported != RUN.contact
    assert np.mean(wrong[1:] & wrong[:-1]) < 0.05  # errors of one step do not stay for the next


def test_false_alarms_are_on_candidates_alone():
    scene = scene_of(4, candidate_edges=[[0, 2], [3, 1]])
    reported = SensorFaults(0.5).reported(np.zeros((200, 4, 4), bool), scene, 0)
    edges = [[0, 2], [1, 3], [2, 0], [3, 1]]
    assert np.argwhere(reported.any(axis=0)).tolist() == edges


def test_a_late_sensor():
    reported = SensorFaults(delay_steps=3).reported(RUN.contact, RUN.scene, 0)
    assert not reported[:3].any()
    assert np.array_equal(reported[3:], RUN.contact[:-3])


def test_seeds_and_trajectories_differ_and_repeat():
    def of(seed, number):
        return SensorFaults(0.1, 0.1, 1, seed).reported(RUN.contact, RUN.scene, number)

    assert np.array_equal(of(1, 2), of(1, 2))
    assert not np.array_equal(of(1, 2), of(1, 3)) and not np.array_equal(of(1, 2), of(2, 2))


def test_the_correction_receives_the_rates():
    sensor = SensorFaults(0.05, 0.2, 2).sensor
    assert (sensor.false_alarm, sensor.miss) == (0.05, 0.2)
    assert sensor.delay == 2
    assert SensorFaults(1e-7).sensor == ContactSensor()


@pytest.fixture(scope="module")
def pickups() -> Dataset:
    return Dataset(tuple(collect([PickupTask], [PickupExpert()], 1, 0)))


def test_open_loop_suffers_and_scores_against_the_truth(pickups):
    world = GluedBodies()
    exact = evaluate_open_loop(world, pickups)
    late = evaluate_open_loop(world, pickups, faults=SensorFaults(delay_steps=5))
    lying = evaluate_open_loop(world, pickups, faults=SensorFaults(0.0, 0.3))
    assert (
        late["edge_recall"] < exact["edge_recall"]
        and late["n_step_rmse_m"] > exact["n_step_rmse_m"]
    )
    assert lying["n_step_rmse_m"] >= exact["n_step_rmse_m"]
    for found in (late, lying):
        assert np.array_equal(found.recorded.contact, exact.recorded.contact)
        assert found["frozen_contact_rmse_m"] == exact["frozen_contact_rmse_m"]
        assert found["n_step_rmse_unmeasured_m"] == exact["n_step_rmse_unmeasured_m"]
    # With rates of a sensor that is nearly always wrong, the belief does not change.
    deaf = ContactSensor(0.5, 0.5)
    unmoved = evaluate_open_loop(world, pickups, sensor=deaf)
    assert unmoved["n_step_rmse_m"] == pytest.approx(exact["n_step_rmse_unmeasured_m"])


class Trusted(SensorFaults):
    """Its reports are taken for those of an exact sensor."""

    sensor = ContactSensor()


def test_the_controller_observes_faults_and_the_recording_is_exact():
    beliefs, runs, plans = {}, {}, Planning(horizon=5, iterations=2)
    for name, faults, measured in (
        ("exact", SensorFaults(), True),
        ("late", Trusted(delay_steps=20), True),
        ("blind", SensorFaults(), False),
    ):
        records = []
        _, (runs[name],) = by_model(
            GluedBodies(), PickupTask, 1, 0, plans=plans, faults=faults,
            measured=measured,
            on_episode=lambda run, record, to=records: to.append(record),
        )  # fmt: skip
        beliefs[name] = records[0].plan_belief[:, 0, 0] > 0.5
    # This world learns of contact from the sensor alone.
    first = {name: int(np.argmax(run.contact[:, 0, 1])) for name, run in runs.items()}
    assert min(first.values()) > 0
    assert int(np.argmax(beliefs["exact"])) == first["exact"]
    assert int(np.argmax(beliefs["late"])) == first["late"] + 20
    assert not beliefs["blind"].any()


def test_invalid_fault_rates():
    for rate in (-0.1, 1.0, np.nan):
        with pytest.raises(InvalidInputError, match="false_alarm_rate must be at least 0"):
            SensorFaults(rate)
    with pytest.raises(InvalidInputError, match="miss_rate must be at least 0 and below 1"):
        SensorFaults(miss_rate=2.0)
    with pytest.raises(InvalidInputError, match="delay_steps must be at least 0, found -1"):
        SensorFaults(delay_steps=-1)
    bare = strip_contacts(Dataset((random_run(2, 5, 0),)))
    with pytest.raises(InvalidInputError, match="1 of 1 trajectories have no contact field"):
        evaluate_open_loop(GluedBodies(), bare, horizon_s=2 * DT, faults=SensorFaults(0.1))
