"""A pickup by hand-written physics, with a belief and parameters such as a good model would have.

Circles of 1 kg without friction; a PD force drives the gripper through the object and on to the
goal; the touch is purely inelastic and then holds.
"""

import dataclasses

import numpy as np

from contactgraph.data import Scene, Trajectory
from contactgraph.viz import (
    BeliefTimeline,
    LossCurve,
    NStepError,
    ReliabilityCurve,
    ReportData,
    ReportMetric,
    SceneTrajectory,
)

DT, RADIUS, SUBSTEPS = 0.05, 0.04, 10
START, OBJECT, GOAL = np.array([-0.75, -0.5]), np.array([0.1, 0.05]), np.array([0.62, 0.6])
KP = 5.0


def _force(position, velocity, held):
    target = GOAL if held else OBJECT
    damping = (4.0 if held else 0.5) * np.sqrt(KP)
    pull = KP * (target - (position[1] if held else position[0]))
    return np.clip(pull - damping * velocity[0], -6.0, 6.0)


def _step(position, velocity, held, force):
    """One control step: moves the two bodies in place, and answers whether they hold together."""
    for _ in range(SUBSTEPS):
        velocity[0] += force / (2.0 if held else 1.0) * DT / SUBSTEPS
        if held:
            velocity[1] = velocity[0]
        position += velocity * DT / SUBSTEPS
        if not held and np.linalg.norm(position[1] - position[0]) <= 2 * RADIUS:
            held = True
            velocity[:] = velocity.mean(axis=0)
    return held


def _plan(position, velocity, held, horizon, rng):
    position, velocity = position.copy(), velocity.copy()
    states = [position.copy()]
    for _ in range(horizon):
        force = _force(position, velocity, held) + 0.15 * rng.standard_normal(2)
        held = _step(position, velocity, held, force)
        states.append(position.copy())
    return states


def _resting_distractors(count, rng):
    places = []
    while len(places) < count:
        place = rng.uniform(-0.9, 0.9, 2)
        ways = [(START, OBJECT), (OBJECT, GOAL)]
        clear = all(_distance_to_path(place, *way) > 0.17 for way in ways)
        apart = all(np.linalg.norm(place - other) > 0.15 for other in places)
        if clear and apart:
            places.append(place)
    return np.array(places).reshape(-1, 2)


def _distance_to_path(point, start, end):
    along = np.clip((point - start) @ (end - start) / ((end - start) @ (end - start)), 0.0, 1.0)
    return np.linalg.norm(point - start - along * (end - start))


def pickup(name, distractors, steps=160, horizon=15, seed=0):
    rng = np.random.default_rng(seed)
    nodes = 2 + distractors
    rest = _resting_distractors(distractors, rng)
    pair, speed, held = np.stack([START, OBJECT]), np.zeros((2, 2)), False
    position, velocity, control, touch, plan = [], [], [], [], []
    noise = np.zeros(2)
    for step in range(steps + 1):
        position.append(np.concatenate([pair, rest]))
        velocity.append(np.concatenate([speed, np.zeros_like(rest)]))
        touch.append(held)
        if step == steps:
            break
        future = np.array(_plan(pair, speed, held, horizon, rng))
        still = np.broadcast_to(rest, (horizon + 1, distractors, 2))
        plan.append(np.concatenate([future, still], axis=1))
        noise = 0.9 * noise + 0.15 * rng.standard_normal(2)
        control.append(_force(pair, speed, held) + noise)
        held = _step(pair, speed, held, control[-1])
    position, velocity, touch = np.array(position), np.array(velocity), np.array(touch)
    second, first = np.tril_indices(nodes, k=-1)
    edges = np.stack([first, second], axis=1)
    contact = np.zeros((steps + 1, len(edges)), dtype=bool)
    contact[:, 0] = touch
    belief = _belief(position, velocity, contact, edges, rng)
    parameters = _parameters(belief[:, 0], touch, nodes, rng)
    scene = Scene(
        node_name=("gripper", *(f"object-{k}" for k in range(nodes - 1))),
        node_type=("gripper", *("object" for _ in range(nodes - 1))),
        actuated=np.arange(nodes) == 0,
        dt=DT,
        goal=GOAL,
        radius=np.full(nodes, RADIUS),
    )
    dense = np.zeros((steps + 1, nodes, nodes), dtype=bool)
    dense[:, 0, 1] = dense[:, 1, 0] = touch
    trajectory = Trajectory(scene, position, velocity, np.array(control), dense)
    return SceneTrajectory(name, trajectory, edges, belief, plan=np.array(plan), **parameters)


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


def _belief(position, velocity, contact, edges, rng):
    """Sure of a touch one step ahead, doubtful of bodies that only pass close."""
    ahead = position + velocity * DT
    gap = np.linalg.norm(ahead[:, edges[:, 0]] - ahead[:, edges[:, 1]], axis=-1) - 2 * RADIUS
    logit = np.clip(-gap / 0.02 - 1.0, -7.0, 7.0)
    logit = logit + 6.0 * contact + 0.3 * rng.standard_normal(gap.shape)
    return (1.0 / (1.0 + np.exp(-logit)))[:-1]


def _parameters(held, touch, nodes, rng):
    steps = len(held)
    inverse_mass = np.abs(0.012 * rng.standard_normal((steps, nodes)))
    inverse_mass[:, 0] += 1.0 - 0.5 * held
    inverse_mass[:, 1] += 0.5 * held
    stiffness = np.abs(0.03 * rng.standard_normal((steps, nodes)))
    damping = np.abs(0.05 * rng.standard_normal((steps, nodes)))
    impact = int(np.argmax(touch)) - 1
    stiffness[impact, :2] += (2.1, 3.4)
    damping[impact, :2] += (7.5, 9.2)
    parameters = {"inverse_mass": inverse_mass, "stiffness": stiffness, "damping": damping}
    return {name: np.stack([values, values], axis=-1) for name, values in parameters.items()}


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


def report(scenes=None):
    step = np.arange(0, 3001, 25.0)
    decay = np.exp(-step / 500.0)
    rng = np.random.default_rng(1)

    def curve(start, end, noise):
        return (start * decay + end) * np.exp(noise * rng.standard_normal(step.size))

    collect = "contactgraph evaluate runs/pickup fresh-10.h5 --json evaluate-10.json"
    control = "contactgraph control pickup pickup --episodes 100 --distractors 10 --seed 0"
    errors = []
    for windows, base in (
        ("all windows", 1.0),
        ("no contact changes", 0.2),
        ("contact changes", 4),
    ):
        for count, ratio in ((0, 1.0), (3, 0.55), (10, 0.3)):
            model = 0.0042 * base * ratio
            floors = {
                "frozen_contact_m": 0.0177 * base * ratio,
                "constant_velocity_m": 0.059 * ratio,
            }
            condition = "no distractors" if count == 0 else f"{count} distractors"
            interval = (0.85 * model, 1.2 * model)
            errors.append(
                NStepError(condition, windows, model, model_interval_m=interval, **floors)
            )
    return ReportData(
        title="A contact graph that picks things up",
        summary="Trained on 40 recorded trajectories, the model knows when the gripper holds the "
        "object, and carries it to the goal past ten objects it has never seen.",
        metrics=(
            ReportMetric(
                "Success with 10 distractors", 100.0, "%", (96.3, 100.0), control, 0, True
            ),
            ReportMetric("N-step error", 0.42, "cm", (0.36, 0.5), collect, 0, True),
            ReportMetric("Edge F1", 0.991, "", (0.985, 0.996), collect, 0, True),
            ReportMetric("Speed at contact", 1.13, "m/s", (1.05, 1.2), control, 0, True),
            ReportMetric("Plan time, p99", 12.4, "ms", None, control, 0, True),
            ReportMetric("Model file", 0.21, "MB", None, "contactgraph info runs/pickup"),
        ),
        scenes=(
            pickup("no distractors", 0),
            pickup("3 distractors", 3, seed=3),
            pickup("10 distractors", 10, seed=5),
        )
        if scenes is None
        else scenes,
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
            for panel, factor in (("one step ahead", 1.0), ("at the end of the window", 3.0))
            for source, share in (("contacts and motion", 0.1), ("motion alone", 0.3))
            for bend in (factor * share,)
        ),
        losses=(
            LossCurve("prediction", step, curve(1.0, 0.004, 0.15)),
            LossCurve("prediction", step[::5], curve(1.1, 0.006, 0.05)[::5], held_out=True),
            LossCurve("belief against prior", step, curve(0.4, 0.05, 0.1)),
        ),
        versions={"contactgraph": "0.1.0", "jax": "0.5.0", "box2d": "2.3.10", "Python": "3.11"},
        remake=("make demo", "contactgraph report runs/pickup"),
    )
