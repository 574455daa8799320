"""``contactgraph play``: a live page, on which a model controls a task and a hand disturbs it."""

import sys
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from contactgraph.cli.options import AUTO, Device, OutputFile, PlannerName

if TYPE_CHECKING:
    from contactgraph.cli.task_types import KnownTask
    from contactgraph.play import StageChoice, StageParts
    from contactgraph.policies import PlannerFactory

_BY_NAME = ("pickup", "multi-pickup", "door", "franka")
"""Tasks with a shipped model of their name."""


@dataclass(frozen=True)
class Play:
    """Watch a model control a task on a live page, and disturb it by hand.

    The page is served on this machine alone, until Ctrl-C.
    """

    model: Positional[
        Annotated[
            str,
            arg(
                metavar="MODEL",
                help="A run folder of train, a model file, or a shipped model: door, franka, "
                "multi-pickup or pickup.",
            ),
        ]
    ] = "pickup"
    task: Positional[
        Annotated[
            str | None,
            arg(metavar="TASK", help_behavior_hint="(the model's task, where it ships)"),
        ]
    ] = None
    """A task that contactgraph info lists, or module:Class."""
    distractors: int = 0
    """Further bodies to begin with."""
    seed: int = 0
    """Random seed of the scenes."""
    port: int = 0
    """Port of the page on 127.0.0.1; 0 takes a free one, which is printed."""
    open: bool = False
    """Open the page in the system's browser."""
    record: OutputFile = None
    """Write the episodes to this dataset file (HDF5), at the end of each and at Ctrl-C."""
    planner: PlannerName = None
    device: Device = AUTO

    def run(self) -> None:
        """Serve the page until Ctrl-C or until the session fails."""
        import asyncio
        import webbrowser

        from contactgraph.cli.known_tasks import TASKS
        from contactgraph.cli.options import check_range, check_seed, load_object
        from contactgraph.cli.output import check_writable
        from contactgraph.cli.tasks import task_names
        from contactgraph.data import InvalidInputError
        from contactgraph.model import shipped_models
        from contactgraph.play import Session, StageChoice
        from contactgraph.play.server import listening_socket, origin_of, serve_session

        check_range("--port", self.port, 0, 65535)
        check_seed(self.seed)
        check_writable(self.record)
        task = self.task
        if task is None:
            task = self.model
            if task not in _BY_NAME:
                raise InvalidInputError(
                    f"{self.model}: name the task too; only shipped models have one of their name"
                )
        models = dict.fromkeys((self.model, *shipped_models()))
        driven = [name for name in task_names() if name not in TASKS or _is_driven(TASKS[name])]
        tasks = dict.fromkeys((task, *driven))
        choice = StageChoice(self.model, task, self.distractors)
        planner = None if self.planner is None else load_object("--planner", self.planner)
        parts = partial(stage_parts, planner=planner)
        session = Session(choice, parts, tuple(models), tuple(tasks), self.seed, self.record)
        listening = listening_socket(self.port)
        url = f"{origin_of(listening)}/"

        def ready() -> None:
            print(url, flush=True)
            if self.open:
                webbrowser.open(url)

        session.start()
        try:
            asyncio.run(serve_session(session, listening, ready))
        finally:
            session.stop()
            if session.compiling:
                print("waiting for a compilation to end", file=sys.stderr)
            if self.record is not None and session.trajectories:
                count = len(session.trajectories)
                print(f"{self.record}: {count} episodes", file=sys.stderr)
        if session.failure is not None:
            raise session.failure


def _is_driven(task: "KnownTask") -> bool:
    from contactgraph.envs import RestPolicy

    return task.demonstrator is not RestPolicy


def stage_parts(choice: "StageChoice", planner: "PlannerFactory | None" = None) -> "StageParts":
    """The model and the task of these names; raises `InvalidInputError`."""
    from contactgraph.cli.models import motion_evidence, stored_model
    from contactgraph.cli.tasks import known_task, task_factory
    from contactgraph.control import searches
    from contactgraph.play import StageParts

    known = known_task(choice.task)
    options = {"distractors": choice.distractors} if choice.distractors else {}
    task = task_factory(choice.task, options)()
    task.reset(seed=0)
    model = stored_model(choice.model)
    horizon, starts, _ = known.planning(task.scene)
    return StageParts(
        model=model,
        task=task,
        horizon=horizon,
        starts=starts if searches(model) else 0,
        planner=planner,
        motion_noise=motion_evidence(model, False),
    )
