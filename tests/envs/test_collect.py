"""Recording by several processes: the same runs, in the same order."""

import os

import pytest
from test_run_episode import same

from contactgraph.envs import DoorExpert, DoorTask, ExplorationPolicy, PickupExpert, PickupTask
from contactgraph.envs import episodes as collecting
from contactgraph.evaluate import collect
from contactgraph.parallel import LocalExecutor


class Signed(PickupTask):
    """Records its process id."""

    def begin(self, seed):
        scene, world = super().begin(seed)
        scene.metadata["recorder"] = os.getpid()
        return scene, world


@pytest.fixture
def at_once(monkeypatch):
    """Processes begin after the first run, whether they pay or not."""
    monkeypatch.setattr(collecting, "_ALONE_S", 0.0)
    monkeypatch.setattr(collecting, "_START_S", 0.0)


@pytest.mark.usefixtures("at_once")
def test_several_processes_record_the_same_bits_as_one():
    # Runs follow other runs than they would in one process: nothing may be left of those.
    mix = [PickupExpert(), ExplorationPolicy()]
    reported = []
    trajectories = collect([Signed], mix, 7, 3, reported.append, executor=LocalExecutor(2))
    alone = collect([PickupTask], mix, 7, 3)
    assert all(same(one, other) for one, other in zip(trajectories, alone, strict=True))
    assert all(one is other for one, other in zip(reported, trajectories, strict=True))
    recorders = [trajectory.scene.metadata["recorder"] for trajectory in trajectories]
    assert recorders[0] == os.getpid() and os.getpid() not in recorders[1:]


@pytest.mark.usefixtures("at_once")
def test_the_doors_expert_keeps_nothing_either():
    trajectories = collect([DoorTask], [DoorExpert()], 4, 1, executor=LocalExecutor(2))
    alone = collect([DoorTask], [DoorExpert()], 4, 1)
    assert all(same(one, other) for one, other in zip(trajectories, alone, strict=True))


def test_quick_episodes_start_no_workers(monkeypatch):
    def map_in_order(*arguments):
        raise AssertionError("it does not pay")

    monkeypatch.setattr(collecting, "map_in_order", map_in_order)
    assert len(collect([PickupTask], [PickupExpert()], 5, 0, executor=LocalExecutor(64))) == 5
