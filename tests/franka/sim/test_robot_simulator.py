"""The simulated robot's server, and the real client against it."""

import time
from collections.abc import Iterator

import numpy as np
import pytest

from contactgraph.data import InvalidInputError

pytest.importorskip("franky_sim", reason="needs pip install 'contactgraph[rehearsal]'")

from contactgraph_franka.sim.simulated_robot import RobotSimulator, SimulatedRobot, attach

pytestmark = pytest.mark.slow

PACE = 2.0


@pytest.fixture(scope="module")
def running(server_turn: None) -> Iterator[SimulatedRobot]:
    with RobotSimulator(pace=PACE) as running:
        yield running


def test_the_simulation_keeps_to_the_clock(running: SimulatedRobot) -> None:
    first = running.ground_truth.newest()
    time.sleep(0.5)
    rows = running.ground_truth.since(int(first["number"]))
    assert np.array_equal(np.diff(rows["number"]), np.ones(len(rows) - 1))
    assert running.clock() - rows["stamp"][-1] < 0.02
    # Simulated seconds and those of the clock are as long; a busy machine may drop a few cycles.
    span = rows[-1]["stamp"] - rows[0]["stamp"]
    assert rows[-1]["time"] - rows[0]["time"] == pytest.approx(span, rel=0.1)
    assert running.rate > 250 / PACE


def test_the_client_reads_the_state_of_the_simulation(running: SimulatedRobot) -> None:
    franky = pytest.importorskip("franky", reason="needs pip install 'contactgraph[robot]'")
    for attempt in range(3):
        try:
            arm = franky.Robot(running.address, realtime_config=franky.RealtimeConfig.Ignore)
            state = arm.state
            break
        except franky.NetworkException:
            if attempt == 2:
                raise
    truth = running.ground_truth.newest()
    np.testing.assert_allclose(state.q, truth["qpos"][:7], atol=1e-5)
    # Its own point of the hand is 22 mm above the grasp point.
    np.testing.assert_allclose(
        state.O_T_EE.translation - [0.0, 0.0, 0.022], truth["position"][0], atol=1e-4
    )
    assert state.m_ee == pytest.approx(0.76)


def test_any_process_can_place_a_block(running: SimulatedRobot) -> None:
    attach(running.address).place_block(0, np.array([0.6, 0.1, 0.05]), 0.4)
    time.sleep(0.1)
    row = running.ground_truth.newest()
    np.testing.assert_allclose(row["position"][1], [0.6, 0.1, 0.05], atol=1e-3)
    assert row["turn"][1][3] == pytest.approx(np.sin(0.2), abs=1e-3)


@pytest.mark.parametrize(
    ("index", "position", "words"),
    [
        (1, [0.5, 0.0, 0.05], "block must be 0 to 0, found 1"),
        (0, [0.5, 0.0, np.nan], r"position must be \[3\] m"),
        (0, [0.5, 0.0], r"position must be \[3\] m"),
    ],
)
def test_impossible_positions_are_refused(
    running: SimulatedRobot, index: int, position: list[float], words: str
) -> None:
    with pytest.raises(InvalidInputError, match=words):
        running.place_block(index, np.array(position))


def test_an_occupied_address_is_refused(running: SimulatedRobot) -> None:
    with (
        pytest.raises(InvalidInputError, match="are not free at"),
        RobotSimulator(addresses=[running.address]),
    ):
        pass
    with pytest.raises(InvalidInputError, match="has no camera"):
        running.camera()
