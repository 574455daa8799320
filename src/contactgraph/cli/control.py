"""``contactgraph control``: a model, or a scripted policy, in closed loop with a task."""

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from contactgraph.cli.options import (
    AUTO,
    MOST_EPISODES,
    BeliefOptions,
    Device,
    OutputFile,
    PlannerName,
    SceneOptions,
    TaskArgument,
    check_range,
    check_seed,
    given_options,
    options_metadata,
    own_functions,
)
from contactgraph.data import Dataset, InvalidInputError, Trajectory, write_trajectories
from contactgraph.data.lookup import load_object

if TYPE_CHECKING:
    import numpy as np

    from contactgraph.envs.contract import Policy, Task
    from contactgraph.model import ContactDynamics
    from contactgraph.policies import EpisodeRecord
    from contactgraph.viz import SceneTrajectory

_RECORDED = (
    *("cost", "horizon", "iterations", "starts", "routes", "segment", "planner", "clearance"),
    *("replan_every", "false_alarms", "misses", "delay", "fault", "unmeasured"),
    *("position_noise", "velocity_noise", "inference"),
)
"""Options that only a model takes; the JSON file repeats them."""
_SCRIPTED = ("expert", "fixed-start")
"""Names in place of a MODEL; a file or folder of such a name is given as a path, ``./expert``."""
_PREDICTED_S = 0.5
"""Length of the predictions of executed episodes."""


@dataclass(frozen=True)
class _Controller:
    """A policy, and what is known of it."""

    policy: "Policy"
    settings: Mapping[str, Any]
    """By JSON key."""
    model: "ContactDynamics | None" = None
    how: str = ""
    """One line on how it plans."""
    evidence: Mapping[str, Any] = field(default_factory=dict)
    """What corrects beliefs: arguments of `evaluate_open_loop`."""


@dataclass(frozen=True)
class Control(BeliefOptions, SceneOptions):
    """Control a task through contact by iLQR-MPC with a learned model, episode after episode.

    A scripted policy in the model's place (expert, fixed-start) is the baseline in the same scenes.
    """

    model: Positional[Annotated[str, arg(metavar="MODEL")]]
    """A run folder of train, a model file, a shipped model (door, franka, multi-pickup or pickup),
    or module:factory@MODEL. In its place, expert is the task's scripted demonstrator, and
    fixed-start its controller without model or search."""
    task: TaskArgument
    episodes: int = 100
    """Number of episodes."""
    seed: int = 0
    """Random seed; the same seed gives the same episodes."""
    clearance: Annotated[float | None, arg(metavar="M", help_behavior_hint="(may touch them)")] = (
        None
    )
    """Gap to keep from bodies that the task does not name, m."""
    cost: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(the task's cost)")] = None
    """Cost file by learn-cost, to plan with in place of the task's own cost."""
    horizon: Annotated[
        int | None,
        arg(metavar="INT", help_behavior_hint="(20 up; pushing 30; franka 50; twice with --cost)"),
    ] = None
    """Planning horizon, steps."""
    iterations: int = 5
    """Rollouts of iLQR a plan, at most."""
    starts: Annotated[
        int | None, arg(metavar="INT", help_behavior_hint="(32 for pushing, else 0)")
    ] = None
    """Ways round a body to push it that each plan compares, twice; 0: none."""
    routes: Annotated[
        int | None, arg(metavar="INT", help_behavior_hint="(7 with --clearance, else 0)")
    ] = None
    """Routes to where the cost is least that each plan compares; 0: none."""
    segment: int = 0
    """Steps of the short plans by which a long plan begins, such as 20 for a --horizon of 200; 0:
    none."""
    planner: PlannerName = None
    replan_every: int = 1
    """Steps between plans; the plan's feedback acts in between."""
    deadline_ms: Annotated[float | None, arg(metavar="MS", help_behavior_hint="(optional)")] = None
    """Time limit of a plan, ms; the previous plan replaces a later one."""
    unmeasured: bool = False
    """Control without a contact sensor."""
    position_noise: Annotated[float, arg(metavar="M")] = 0.0
    """Standard deviation of the noise on every observed position, m."""
    velocity_noise: Annotated[float, arg(metavar="M/S")] = 0.0
    """Standard deviation of the noise on every observed velocity, m/s."""
    json: OutputFile = None
    """Write the measurements to this file."""
    video: OutputFile = None
    """Write the first episode as an animation to this file (.gif, or .mp4 with ffmpeg)."""
    save: OutputFile = None
    """Write the episodes to this dataset file (HDF5)."""
    device: Device = AUTO

    def run(self) -> "Callable[[str], SceneTrajectory]":
        """Run the episodes, write the files that are asked for, and print a summary.

        Returns a function that gives the first episode, with its plans, a name to draw it under.
        """
        from contactgraph.cli.control_output import NOT_PLANNED, NOT_PREDICTED, print_summary
        from contactgraph.cli.models import data_simulator
        from contactgraph.cli.output import check_writable, progress, write_json
        from contactgraph.control import compile_small_loops
        from contactgraph.envs.registry import task_factory
        from contactgraph.evaluate import control_task, evaluate_open_loop
        from contactgraph.viz import (
            check_animation,
            recorded_scene,
            scene_trajectory,
            write_animation,
        )

        compile_small_loops()
        for path in (self.json, self.video, self.save):
            check_writable(path)
        if self.video is not None:
            check_animation(self.video)
        check_range("--episodes", self.episodes, 1, MOST_EPISODES)
        check_seed(self.seed)
        metrics = own_functions("--metric", self.metric)
        options = given_options(self)
        scripted = self.model in _SCRIPTED
        task = task_factory(self.task, options)()
        controller = self._script() if scripted else self._mpc(task)
        plans: list[np.ndarray | None] = []  # of the first episode alone
        finished = itertools.count(1)
        with progress("controlling", self.episodes) as bar:

            def on_episode(_: Trajectory, record: "EpisodeRecord | None") -> None:
                if not plans:
                    plans.append(None if record is None else record.plan)
                bar.advance(next(finished))

            result = control_task(
                controller.policy,
                task,
                self.episodes,
                self.seed,
                metrics=metrics,
                on_episode=on_episode,
            )
        model, trajectories = controller.model, result.trajectories
        predicted: Mapping[str, Any] = NOT_PREDICTED
        long = any(each.steps >= round(_PREDICTED_S / each.scene.dt) for each in trajectories)
        if model is not None and long:
            executed = Dataset(tuple(trajectories))
            predicted = evaluate_open_loop(model, executed, **controller.evidence).to_json()
        metadata = {**options_metadata(options), "task": self.task, "seed": self.seed}

        def drawn(name: str) -> "SceneTrajectory":
            if model is None:
                return recorded_scene(name, trajectories[0])
            return scene_trajectory(model, name, trajectories[0], plans[0])

        if self.save is not None:
            write_trajectories(self.save, trajectories, metadata)
        if self.video is not None:
            write_animation(self.video, drawn(f"{self.task}, {self.distractors} distractors"))
        measured = {**result.to_json(), **(NOT_PLANNED if scripted else {})}
        values = {**metadata, **controller.settings, **predicted, **measured}
        write_json(self.json, {"run": self.model, **values})
        if not scripted:
            recorded = data_simulator(self.model)
            simulator = str(trajectories[0].scene.metadata.get("simulator", recorded))
            if recorded not in (None, simulator):
                print(f"{self.model} was trained on {recorded}; these episodes are on {simulator}")
            print(controller.how)
        print_summary(result.metrics, predicted)
        for name in metrics:
            print(f"{name:<27}{values[name]}")
        return drawn

    def _mpc(self, task: "Task") -> _Controller:
        """MPC with the model."""
        from contactgraph.cli.models import motion_evidence, stored_model, with_inference
        from contactgraph.control import read_cost
        from contactgraph.policies import ObservationNoise, Planning, task_policy

        check_range("--horizon", 1 if self.horizon is None else self.horizon, 1, 1000)
        check_range("--iterations", self.iterations, 1, 1000)
        check_range("--starts", self.starts or 0, 0, 10_000)
        check_range("--routes", self.routes or 0, 0, 1000)
        check_range("--clearance", self.clearance or 0, 0, 10)
        fault = self.sensor_fault(self.seed)
        if self.unmeasured and not fault.exact:
            raise InvalidInputError(
                "--unmeasured: no contact is measured, so --false-alarms, --misses, --delay and "
                "--fault must be left out"
            )
        noise = ObservationNoise(self.position_noise, self.velocity_noise, self.seed)
        model = with_inference(stored_model(self.model), self.inference)
        by_motion = motion_evidence(model, self.ignore_motion, noise.position, noise.velocity)
        planner = None
        if self.planner is not None:
            if self.starts or self.routes or self.segment:
                raise InvalidInputError(
                    "--planner: it plans alone, so --starts, --routes and --segment must be left "
                    "out"
                )
            planner = load_object("--planner", self.planner)
        cost = None if self.cost is None else read_cost(self.cost)
        task.reset(seed=self.seed)
        plans = Planning(
            horizon=self.horizon,
            iterations=self.iterations,
            starts=self.starts,
            routes=self.routes,
            segment=self.segment,
            clearance=self.clearance,
            planner=planner,
        ).chosen(task, model, cost)
        check_range("--horizon", plans.horizon or 0, 1, 1000)
        check_range("--segment", self.segment, 0, plans.horizon or 0)
        check_range("--clearance", plans.clearance or 0, 0, 10)
        policy = task_policy(
            model,
            task,
            plans,
            seed=self.seed,
            cost=cost,
            replan_every=self.replan_every,
            deadline=None if self.deadline_ms is None else self.deadline_ms / 1e3,
            faults=fault,
            measured=not self.unmeasured,
            noise=noise,
            motion_noise=by_motion,
        )
        chosen = ("horizon", "starts", "routes", "clearance")
        settings = {
            **{name: getattr(self, name) for name in _RECORDED},
            **{name: getattr(plans, name) for name in chosen},
            "cost": None if self.cost is None else str(self.cost),
            "infer_contacts": by_motion is not None,
        }
        evidence = {"faults": fault, "motion_noise": by_motion}
        tried = {
            "approaches": plans.starts,
            "routes": plans.routes,
            "steps of short plans": self.segment,
            "leap": 0 if planner else int(plans.leap or 0),
        }
        search = "; ".join(["iLQR", *(f"{n} {what}" for what, n in tried.items() if n)])
        how = f"{self.planner or search} ({plans.reason})"
        line = f"plans, {plans.horizon} steps ahead".ljust(27) + how
        return _Controller(policy, settings, model, line, evidence)

    def _script(self) -> _Controller:
        """A scripted policy, which predicts, plans and estimates nothing."""
        from contactgraph.envs.registry import task_spec

        defaults = {each.name: each.default for each in fields(self)}
        names = (*_RECORDED, "deadline_ms", "ignore_motion")
        given = [name for name in names if getattr(self, name) != defaults[name]]
        if given:
            flags = ", ".join(f"--{name.replace('_', '-')}" for name in given)
            raise InvalidInputError(
                f"{flags}: for a model only; {self.model} is a scripted policy, which neither "
                "plans nor estimates"
            )
        task = task_spec(self.task)
        fixed_start = self.model == "fixed-start" and task.fixed_start
        policy = (fixed_start or task.demonstrator)()
        return _Controller(policy, dict.fromkeys((*_RECORDED, "infer_contacts")))
