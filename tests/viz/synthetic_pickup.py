"""Pickups in the plane and in space by hand-written motion.

With a belief, parameters and plans such as a good model would have.
"""

import dataclasses

import numpy as np

from contactgraph.data import Scene, Trajectory, pair_indices
from contactgraph.viz import (
    BeliefTimeline,
    LossCurve,
    NStepError,
    ReliabilityCurve,
    ReportData,
    ReportMetric,
    SceneTrajectory,
)

DT, RADIUS = 0.05, 0.04
STEPS, GRASP = 100, 45
BLOCK, GOAL = [0.5, -0.02, 0.05], [0.6, 0.3, 0.25]
BLOCK_SIZE = np.array([0.04, 0.04, 0.1])
"""Of the pickup in space, m."""
UPPER, LOWER = 0.36, 0.42
"""Of the arm, m."""


def pickup(name, distractors, steps=160, horizon=15):
    """Discs in the plane: a gripper goes to an object and takes it to a goal."""
    grasp = 2 * steps // 5
    hand = _there_and_on([-0.75, -0.5], [0.1, 0.05], [0.62, 0.6], grasp, steps)
    target = np.add(_taken_by(hand, grasp), [2 * RADIUS, 0.0])
    rest = np.linspace([-0.4, -0.9], [0.9, 0.1], distractors)
    count = 2 + distractors
    scene = Scene(
        node_name=("gripper", *(f"object-{k}" for k in range(count - 1))),
        node_type=("gripper", *("object" for _ in range(count - 1))),
        actuated=np.arange(count) == 0,
        dt=DT,
        goal=np.array([0.62, 0.6]),
        mass=np.ones(count),
        radius=np.full(count, RADIUS),
    )
    return seen(name, _recorded(scene, hand, target, rest, grasp), horizon)


def sweep(name="Sweep", distractors=2, horizon=25):
    """In space: a hand on an arm sweeps through a block and lifts it."""
    return seen(name, sweep_trajectory(distractors), horizon)


def sweep_trajectory(distractors=2):
    hand = _there_and_on([0.35, -0.3, 0.3], BLOCK, GOAL, GRASP, STEPS)
    block = _taken_by(hand, GRASP)
    rest = np.array([[0.4 + 0.25 * (k % 2), 0.2 - 0.13 * k, 0.05] for k in range(distractors)])
    blocks = 1 + distractors
    scene = Scene(
        node_name=("hand", "block", *(f"distractor-{k}" for k in range(distractors))),
        node_type=("hand", *("block" for _ in range(blocks))),
        actuated=np.arange(1 + blocks) == 0,
        dt=0.02,
        dimension=3,
        goal=np.array(GOAL),
        mass=np.array([4.0, *[0.4] * blocks]),
        radius=np.array([0.025, *[0.02] * blocks]),
        metadata={"goal_radius": 0.05},
        size=np.stack([np.full(3, np.nan), *[BLOCK_SIZE] * blocks]),
    )
    links = np.stack([_arm(point) for point in hand])
    return _recorded(scene, hand, block, rest, GRASP, links)


def seen(name, recorded, horizon):
    """The trajectory with what a model might make of it."""
    position, steps, mass = recorded.position, recorded.steps, recorded.scene.mass
    nodes, dimension = position.shape[1:]
    rng = np.random.default_rng(0)
    edges = pair_indices(nodes)
    held = recorded.contact[1:, 0, 1]
    belief = np.abs(0.01 * rng.standard_normal((steps, len(edges))))
    belief[:, 0] = np.clip(held - belief[:, 0], 0.0, 1.0)

    def parameter(noise):
        return np.abs(noise * rng.standard_normal((steps, nodes, dimension)))

    inverse_mass, damping, stiffness = parameter(0.004), parameter(0.02), parameter(0.02)
    together = 1.0 / mass[:2].sum()
    inverse_mass[:, 0] += np.where(held, together, 1.0 / mass[0])[:, None]
    inverse_mass[:, 1] += together * held[:, None]
    damping[np.argmax(held), :2] += 8.0
    # A table holds a resting block up, and no block down.
    stiffness[:, 1, 2:] += 40.0 * ~held[:, None]
    plan = position[np.minimum(np.arange(steps)[:, None] + np.arange(horizon + 1), steps)]
    plan[:, :, :2] += 0.0005 * rng.standard_normal((steps, horizon + 1, 1, dimension))
    parameters = {"inverse_mass": inverse_mass, "stiffness": stiffness, "damping": damping}
    return SceneTrajectory(name, recorded, edges, belief, plan=plan, **parameters)


def _smooth(start, end, steps):
    """[steps + 1, D] m along a minimum-jerk path."""
    share = np.linspace(0.0, 1.0, steps + 1)[:, None]
    return start + np.subtract(end, start) * (10 * share**3 - 15 * share**4 + 6 * share**5)


def _there_and_on(start, middle, end, grasp, steps):
    return np.concatenate([_smooth(start, middle, grasp), _smooth(middle, end, steps - grasp)[1:]])


def _taken_by(hand, grasp):
    return np.where(np.arange(len(hand))[:, None] < grasp, hand[grasp], hand)


def _recorded(scene, hand, target, rest, grasp, links=None):
    """The hand holds the target from state `grasp` on; further bodies rest, [K, D] m."""
    others = np.broadcast_to(rest, (len(hand), *rest.shape))
    position = np.concatenate([hand[:, None], target[:, None], others], axis=1)
    velocity = np.gradient(position, scene.dt, axis=0)
    contact = np.zeros((*position.shape[:2], position.shape[1]), dtype=bool)
    contact[grasp:, 0, 1] = contact[grasp:, 1, 0] = True
    control = scene.mass[0] * np.gradient(velocity[:, 0], scene.dt, axis=0)[:-1]
    return Trajectory(scene, position, velocity, control, contact, links)


def _arm(hand):
    """[8, 3] m: base, shoulder, elbow, wrist, palm, one finger, back, the other finger."""
    shoulder, wrist = np.array([0.0, 0.0, 0.33]), hand + np.array([0.0, 0.0, 0.2])
    way = wrist - shoulder
    reach = np.linalg.norm(way)
    along = (UPPER**2 - LOWER**2 + reach**2) / (2 * reach)
    level = np.array([way[0], way[1], 0.0]) / np.hypot(way[0], way[1])
    up = np.array([0.0, 0.0, 1.0])
    bend = np.cross(np.cross(way, up), way)
    bend /= np.linalg.norm(bend)
    elbow = shoulder + along * way / reach + np.sqrt(max(UPPER**2 - along**2, 0.0)) * bend
    aside = 0.03 * np.array([-level[1], level[0], 0.0])
    palm = hand + 0.06 * up
    return np.stack([np.zeros(3), shoulder, elbow, wrist, palm, hand + aside, palm, hand - aside])


def changed(scene, **fields):
    """The scene trajectory with other fields: its own, its trajectory's or its scene's."""
    given = dict(fields)

    def taken(part):
        names = [one.name for one in dataclasses.fields(part) if one.name in given]
        return {name: given.pop(name) for name in names}

    own, recorded = taken(scene), taken(scene.trajectory)
    static = dataclasses.replace(scene.trajectory.scene, **given)
    trajectory = dataclasses.replace(scene.trajectory, scene=static, **recorded)
    return dataclasses.replace(scene, trajectory=trajectory, **own)


def _held_and_lost(recorded=True):
    """A hold that ends while the bodies touch, which the uncorrected belief does not see."""
    truth = np.repeat([0, 2, 1] if recorded else [0, 3, 3], (15, 25, 20))
    hold = truth >= 2
    beliefs = {"contacts and motion": 1.0 * hold, "motion alone": np.where(hold, 0.98, 0.05)}
    beliefs["nothing"] = np.where(truth > 0, np.linspace(1.2, 0.55, 60).clip(0, 1), 0.02)
    state = {name: np.where(each > 0.5, truth.max(), 0) for name, each in beliefs.items()}
    scores = {name: (0.99, 0.015) for name in beliefs}
    name = "release" if recorded else "pickup"
    return BeliefTimeline(name, "gripper and object-0", DT, truth, beliefs, state, scores)


def report(scenes):
    step = np.arange(0, 3001, 25.0)
    decay = np.exp(-step / 500.0)
    control = "contactgraph control pickup pickup --episodes 100 --distractors 10 --seed 0"
    errors = [
        NStepError(
            f"{count} distractors",
            windows,
            0.004 * ratio,
            model_interval_m=(0.003 * ratio, 0.005 * ratio),
            frozen_contact_m=0.0177 * ratio,
            constant_velocity_m=0.059 * ratio,
        )
        for windows in ("all windows", "no contact changes", "contact changes")
        for count, ratio in ((3, 0.55), (10, 0.3))
    ]
    return ReportData(
        title="A contact graph that picks things up",
        summary="Trained on 40 recorded trajectories, the model knows when the gripper holds the "
        "object, and carries it to the goal past ten objects it has never seen.",
        metrics=(
            ReportMetric("Success", 100.0, "%", (96.3, 100.0), control, 0, True),
            ReportMetric("Plan time, p99", 12.4, "ms", None, control, 0, True),
            ReportMetric("Model file", 0.21, "MB", None, "contactgraph info runs/pickup"),
        ),
        scenes=scenes,
        beliefs=(_held_and_lost(), _held_and_lost(recorded=False)),
        errors=tuple(errors),
        horizon_s=0.5,
        reliability=tuple(
            ReliabilityCurve(
                f"{panel}, 10 distractors",
                source,
                tuple((1000 - 90 * n, b, b ** (1 + bend)) for n, b in enumerate((0.02, 0.4, 0.97))),
                bend / 10,
            )
            for panel in ("one step ahead", "at the end of the window")
            for source, bend in (("contacts and motion", 0.1), ("motion alone", 0.3))
        ),
        losses=(
            LossCurve("prediction", step, decay + 0.004),
            LossCurve("prediction", step[::5], decay[::5] + 0.006, held_out=True),
            LossCurve("belief against prior", step, 0.4 * decay + 0.05),
        ),
        versions={"contactgraph": "0.1.0", "jax": "0.5.0", "box2d": "2.3.10", "Python": "3.11"},
        remake=("make demo", "contactgraph report runs/pickup"),
    )
