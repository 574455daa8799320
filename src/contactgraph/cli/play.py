"""``contactgraph play``: a live page, on which a model controls a task and a hand disturbs it."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from contactgraph.cli.options import (
    AUTO,
    Device,
    ModelArgument,
    OptionPairs,
    OutputFile,
    PlannerName,
    check_range,
    check_seed,
    given_options,
)
from contactgraph.data import InvalidInputError
from contactgraph.data.lookup import load_object

if TYPE_CHECKING:
    from contactgraph.play import StageChoice, StageParts
    from contactgraph.policies import PlannerFactory


@dataclass(frozen=True)
class Play:
    """Watch a model control a task on a live page, and disturb it by hand.

    The page is served on this machine alone, until Ctrl-C.
    """

    model: ModelArgument = "pickup"
    task: Positional[
        Annotated[
            str | None,
            arg(metavar="TASK", help_behavior_hint="(the model's task, where it ships)"),
        ]
    ] = None
    """A task that contactgraph info lists, or module:Class."""
    distractors: int = 0
    """Further bodies to begin with."""
    option: OptionPairs = ()
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

        from contactgraph.cli.output import check_writable
        from contactgraph.control import compile_small_loops
        from contactgraph.envs.registry import SHIPPED, task_factory, task_names, task_spec
        from contactgraph.model import shipped_models
        from contactgraph.play import Session, StageChoice
        from contactgraph.play.server import listening_socket, origin_of, serve_session

        compile_small_loops()
        check_range("--port", self.port, 0, 65535)
        check_seed(self.seed)
        check_writable(self.record)
        task = self.task
        if task is None:
            task = self.model
            if task not in shipped_models():
                raise InvalidInputError(
                    f"{self.model}: name the task too; only shipped models have one of their name"
                )
        models = dict.fromkeys((self.model, *shipped_models()))
        passive = {name for name in SHIPPED if task_spec(name).passive}
        tasks = dict.fromkeys((task, *(name for name in task_names() if name not in passive)))
        choice = StageChoice(self.model, task, self.distractors)
        planner = None if self.planner is None else load_object("--planner", self.planner)
        options = given_options(self)
        task_factory(task, options)
        options.pop("distractors", None)  # the page chooses them
        parts = partial(stage_parts, planner=planner, options={task: options})
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


def stage_parts(
    choice: "StageChoice",
    planner: "PlannerFactory | None" = None,
    options: Mapping[str, Mapping[str, Any]] = MappingProxyType({}),
) -> "StageParts":
    """The model and the task of these names; raises `InvalidInputError`.

    ``options`` are those of tasks by name.
    """
    from contactgraph.cli.models import motion_evidence, stored_model
    from contactgraph.envs.registry import task_factory
    from contactgraph.play import StageParts

    given = {**options.get(choice.task, {})}
    if choice.distractors:
        given["distractors"] = choice.distractors
    task, model = task_factory(choice.task, given)(), stored_model(choice.model)
    return StageParts(model, task, motion_evidence(model, False), planner)
