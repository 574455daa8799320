import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from contactgraph.data import Dataset, InvalidInputError, Scene, Trajectory
from contactgraph.envs import (
    CarryExpert,
    DelayTask,
    PickupExpert,
    PickupTask,
    SuctionExpert,
    SuctionTask,
)
from contactgraph.evaluate import run_episode
from contactgraph_studies.bayes_bound import Holders, HoldTime, Switch, bayes_bound, touches

DT = 0.05


def run(steps, bodies=1, contact=(), holding=()):
    """A gripper and bodies at its rim; what touches or holds from a state on, by pairs of both."""
    count = 1 + bodies
    position = np.zeros((steps + 1, count, 2))
    position[:, 1:, 0] = 0.08
    matrices = np.zeros((2, steps + 1, count, count), bool)
    for kind, pairs in enumerate((contact, holding)):
        for states, node in pairs:
            matrices[: kind + 1, states, 0, node] = matrices[: kind + 1, states, node, 0] = True
    scene = Scene(
        node_name=("gripper", *(f"target-{index}" for index in range(bodies))),
        node_type=("gripper", *["object"] * bodies),
        actuated=np.arange(count) == 0,
        dt=DT,
        radius=np.full(count, 0.04),
    )
    control = np.zeros((steps, 2))
    return Trajectory(scene, position, 0 * position, control, matrices[0], holding=matrices[1])


def world_of(**rule):
    return SimpleNamespace(hold=SimpleNamespace(**rule), joined_pairs=set(), touching_pairs=set())


@pytest.mark.parametrize("age", [0.2, 1.0])
def test_the_rest_of_a_hold_time_is_uniform(age):
    """Given that a hold has lasted for ``age``, it ends uniformly in what is left of 0.5 to 2 s."""
    states = round(age / DT)
    held = run(60, holding=[(slice(10, 60), 1)])
    posterior, rng = HoldTime(held), np.random.default_rng(0)
    ends = []
    for _ in range(4000):
        world = world_of(left={1: 7.0})
        posterior.redraw(world, 10 + states, rng)
        ends.append(world.hold.left[1])
    age += 0.5 * DT  # it began within a step
    least, most = max(0.5, age) - age, 2.0 - age
    assert least - 0.5 * DT <= min(ends) and max(ends) <= most + 0.5 * DT
    assert np.mean(ends) == pytest.approx((least + most) / 2.0, abs=0.03)
    assert np.std(ends) == pytest.approx((most - least) / np.sqrt(12.0), abs=0.02)
    likeliest = world_of(left={1: 7.0})
    posterior.redraw(likeliest, 10 + states, None)
    assert likeliest.hold.left[1] == pytest.approx(np.median(ends), abs=0.04)


def survival(least, most, time):
    """P(T > time) of a time that is uniform."""
    return np.clip((most - time) / (most - least), 0.0, 1.0)


def test_the_switch_by_its_renewals():
    """Without an observation: half at first; on for 0.9 of 1.65 s in the long run."""
    switch = Switch(run(400))
    on = np.array([belief[1].sum() for belief in switch.belief])
    times = DT * np.arange(13)
    # Up to 0.6 s only the first change can have happened, of either.
    off_left, on_left = survival(0.3, 1.2, times), survival(0.4, 1.4, times)
    assert on[:13] == pytest.approx(0.5 * on_left + 0.5 * (1.0 - off_left), abs=1e-9)
    assert on[-1] == pytest.approx(0.9 / 1.65, abs=1e-3)


def test_an_observed_switch():
    states = slice(20, 30)
    switch = Switch(run(60, holding=[(states, 1)], contact=[(slice(30, 31), 1)]))
    on = np.array([belief[1].sum() for belief in switch.belief])
    assert on[states] == pytest.approx(1.0) and on[30] == 0.0
    # It has changed within the last step, and stays off for 0.3 to 1.2 s.
    for passed in (0.25, 0.45, 0.6):
        least, most = (1.0 - survival(0.3, 1.2, passed + each) for each in (0.0, DT))
        assert least - 1e-9 <= on[30 + round(passed / DT)] <= most + 1e-9
    drawn = []
    for seed in range(300):
        world = SimpleNamespace(hold=None)
        switch.redraw(world, 30, np.random.default_rng(seed))
        drawn.append([len(world.hold.given({1})) for _ in range(120)])
    for passed in (0.3, 0.45, 0.6):
        found = np.mean(drawn, axis=0)[round(200 * passed) - 1]
        assert found == pytest.approx(on[30 + round(passed / DT)], abs=0.08)


def test_the_bodies_that_hold():
    p, rest = 0.25, 0.75
    posterior = Holders(
        run(9, bodies=3, contact=[(slice(3, 9), 1), (slice(6, 9), 2)], holding=[(slice(8, 9), 1)])
    )
    of_body = [posterior.share(start) @ posterior.sets for start in (0, 4, 7)]
    unknown = (p - p**3) / (1.0 - p**3 - rest**3)
    assert of_body[0] == pytest.approx([0.0, *[unknown] * 3])
    other = p / (1.0 - rest**2)  # of the two that are left at least one holds
    assert of_body[1] == pytest.approx([0.0, 0.0, other, other])
    assert of_body[2] == pytest.approx([0.0, 0.0, 0.0, 1.0])
    world = world_of(nodes=None)
    posterior.redraw(world, 7, None)
    assert world.hold.nodes == {3}
    posterior.redraw(world, 9, np.random.default_rng(0))
    assert 1 in world.hold.nodes and 2 not in world.hold.nodes


def test_nothing_is_hidden_in_delay():
    data = Dataset((run_episode(DelayTask(), CarryExpert(), 3),))
    found = bayes_bound(data, every=60, samples=2)
    assert found["windows"] == 4 and found["episodes"] == 1
    assert found["errors_m"]["Bayes"]["rmse"] == found["errors_m"]["Bayes"]["mean"] == 0.0
    assert found["errors_m"]["prior-touch"]["rmse"] > 0.0
    visible = Dataset((run_episode(PickupTask(), PickupExpert(), 3),))
    with pytest.raises(InvalidInputError, match=r"suction --hidden-switch, .* found pickup"):
        bayes_bound(visible)


@pytest.mark.parametrize(("name", "said"), [("nowhere.h5", "does not exist"), ("text.h5", "HDF5")])
def test_a_wrong_file_is_one_line(tmp_path, name, said):
    (tmp_path / "text.h5").write_text("no data")
    command = [sys.executable, "-m", "contactgraph_studies.bayes_bound", str(tmp_path / name)]
    ended = subprocess.run(command, capture_output=True, text=True)
    assert ended.returncode == 2 and said in ended.stderr
    assert ended.stderr.startswith("bayes_bound: ") and ended.stderr.count("\n") == 1


def test_data_without_what_the_tasks_record():
    bare = replace(run(9), contact=None, holding=None)
    with pytest.raises(InvalidInputError, match="must have radius, contact and holding"):
        touches(bare)
    switched = Dataset((run_episode(SuctionTask(), SuctionExpert(), 3),))
    with pytest.raises(InvalidInputError, match="suction --hidden-switch"):
        bayes_bound(switched)


def test_touch_is_by_the_surfaces():
    assert touches(run(2, bodies=2)).all()
    far = run(2)
    assert not touches(replace(far, position=1.01 * far.position))[:, 1].any()
