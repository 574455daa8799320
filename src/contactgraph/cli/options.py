"""Values of command line options: names looked up, numbers checked before any work is done."""

import ast
import math
import os
import re
import sys
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, fields
from importlib.metadata import entry_points
from operator import ne
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, UseAppendAction, arg

from contactgraph.data import InvalidInputError
from contactgraph.data.lookup import choice, load_object
from contactgraph.parallel import Executor, LocalExecutor

if TYPE_CHECKING:
    from contactgraph.policies import SensorFault

MOST_EPISODES = 100_000
"""More do not fit into memory."""
AUTO = "auto"
"""In place of a model's name: chosen by the data."""

ModelArgument = Positional[
    Annotated[
        str,
        arg(
            metavar="MODEL",
            help="A run folder of train, a model file, or a shipped model: door, franka, "
            "multi-pickup or pickup. module:factory@MODEL is a model with parts of your own.",
        ),
    ]
]
TaskArgument = Positional[
    Annotated[
        str,
        arg(
            metavar="TASK",
            help="pickup, multi-pickup, door, another task that contactgraph info lists, or "
            "module:Class.",
        ),
    ]
]
OptionPairs = Annotated[
    tuple[str, ...],
    arg(
        metavar="KEY=VALUE",
        help="An option of the task by the name of its constructor's argument, such as radius=0.05 "
        "or name='two words'; repeatable.",
        help_behavior_hint="(none)",
    ),
    UseAppendAction,
]
PlannerName = Annotated[
    str | None,
    arg(
        metavar="MODULE:FACTORY",
        help="A planner of your own: a class or function that takes the keywords horizon and "
        "limits.",
        help_behavior_hint="(iLQR)",
    ),
]
OutputFile = Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(optional)")]
Device = Annotated[
    str,
    arg(
        metavar="NAME",
        help="auto or cpu: the CPU, which is faster for all that this command does; gpu: the first "
        "accelerator that JAX finds. JAX_PLATFORMS, where it is set, decides for auto.",
    ),
]


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """The scenes of a task, for commands that run it."""

    distractors: int = 0
    """Further bodies: door 0 to 10, franka 0 to 5, other tasks with a choice 0 to 20."""
    objects: Annotated[
        int | None,
        arg(metavar="INT", help_behavior_hint="(multi-pickup: 2, sticky: 3, billiards: 3)"),
    ] = None
    """Objects to pick up, 1 to 5, to try, 2 to 5, or to strike, 1 to 8, for tasks with a choice."""
    hidden_switch: bool = False
    """suction: a random process that nothing records operates the switch."""
    engine: Annotated[
        str | None, arg(metavar="NAME", help_behavior_hint="(the first that is installed)")
    ] = None
    """Physics of planar tasks: box2d or pymunk."""
    option: OptionPairs = ()


@dataclass(frozen=True, kw_only=True)
class BeliefOptions:
    """The contact sensor and the inference, for commands that measure a model."""

    false_alarms: Annotated[float, arg(metavar="RATE")] = 0.0
    """Share of free edges that the contact sensor reports as touching, at every step."""
    misses: Annotated[float, arg(metavar="RATE")] = 0.0
    """Share of touching edges that the contact sensor reports as free."""
    delay: Annotated[int, arg(metavar="STEPS")] = 0
    """Delay of the contact sensor, steps."""
    fault: Annotated[str | None, arg(metavar="MODULE:CLASS", help_behavior_hint="(none)")] = None
    """A faulty contact sensor of your own, a class of SensorFault."""
    ignore_motion: bool = False
    """Correct the contact beliefs by measured contacts alone."""
    inference: Annotated[str, arg(metavar="NAME")] = "filter"
    """Inference of edges: filter, the model's own, or an ablation: prior-touch or prior-hold, the
    geometric prior alone, of edges that touch or that hold; or none, without edges."""
    metric: Annotated[
        tuple[str, ...], arg(metavar="MODULE:FUNCTION ...", help_behavior_hint="(none)")
    ] = ()
    """Metrics of your own, added under the functions' names."""

    def sensor_fault(self, seed: int = 0) -> "SensorFault":
        """The contact sensor that the flags describe; raises `InvalidInputError` for wrong
        values."""
        from contactgraph.policies import SensorFault, SensorFaults

        for flag, rate in (("--false-alarms", self.false_alarms), ("--misses", self.misses)):
            if not 0.0 <= rate < 1.0:
                raise InvalidInputError(f"{flag} must be a share from 0 to below 1, found {rate}")
        check_range("--delay", self.delay, 0, 1000)
        faults = SensorFaults(self.false_alarms, self.misses, self.delay, seed)
        if self.fault is None:
            return faults
        if not faults.exact:
            raise InvalidInputError(
                "--fault: it errs alone, so --false-alarms, --misses and --delay must be left out"
            )
        own = load_object("--fault", self.fault)()
        if not isinstance(own, SensorFault):
            raise InvalidInputError(
                f"--fault {self.fault}: must be a class of SensorFault, found {own!r}"
            )
        return own


_LARGEST_SEED = 2**32 - 1
"""Random keys are made of 32 bits: a larger seed would give the numbers of a smaller one."""


FLAGS = ("distractors", "objects", "passive", "hidden_switch", "engine")
"""Options of tasks that are flags of the commands; ``fixed_seed`` is ``--goal fixed``."""
_TEXT = re.compile(r"[A-Za-z_./][\w./:+ -]*")
"""Text that needs no quotes of its own in a value of ``--option``: a shell takes quotes away."""


def given_options(command: Any) -> dict[str, Any]:
    """The options of a command's scenes by name: flags that differ from their defaults, and pairs.

    Raises `InvalidInputError` for a pair of ``--option`` that cannot be read.
    """
    values = {each.name: (getattr(command, each.name), each.default) for each in fields(command)}
    options = {name: values[name][0] for name in FLAGS if name in values and ne(*values[name])}
    for pair in command.option:
        name, equals, text = pair.partition("=")
        if not (name.isidentifier() and equals):
            raise InvalidInputError(f"--option must be KEY=VALUE, found {pair!r}")
        if name in options:
            raise InvalidInputError(f"--option {name}: it is given twice")
        options[name] = _read_value(name, text)
    return options


def _read_value(name: str, text: str) -> bool | int | float | str:
    """A literal of Python, or of TOML, or text."""
    if text in ("true", "false"):
        return text == "true"
    try:
        value = ast.literal_eval(text)
    except (SyntaxError, ValueError):
        value = text if _TEXT.fullmatch(text) else None
    if not isinstance(value, bool | int | float | str):
        raise InvalidInputError(
            f"--option {name}: must be a number, true, false or text that begins with a letter, "
            f"found {text!r}"
        )
    return value


def option_arguments(options: Mapping[str, Any]) -> tuple[str, ...]:
    """The arguments of ``collect`` and ``control`` that give these options."""
    arguments: list[str] = []
    for name, value in options.items():
        flag = f"--{name.replace('_', '-')}"
        if name not in FLAGS or value is False:
            arguments += ["--option", f"{name}={value}"]
        else:
            arguments += [flag] if value is True else [flag, str(value)]
    return tuple(arguments)


def options_metadata(options: Mapping[str, Any]) -> dict[str, str | int | float]:
    """The options of scenes, for the metadata of written files; those tell the engine already."""
    given = {name: value for name, value in options.items() if name not in ("fixed_seed", "engine")}
    goal = {} if options.get("fixed_seed") is None else {"goal": "fixed"}
    return {"distractors": 0, **given, **goal}


def check_range(flag: str, value: float, lowest: int, highest: int) -> None:
    """Raises `InvalidInputError` where the flag's value is outside ``lowest … highest``."""
    if not lowest <= value <= highest:
        raise InvalidInputError(f"{flag} must be {lowest} to {highest}, found {value}")


def check_seed(seed: int) -> None:
    """Raises `InvalidInputError` for a seed outside the 32 bits of a random key."""
    check_range("--seed", seed, 0, _LARGEST_SEED)


def check_weight(flag: str, weight: float) -> None:
    """Raises `InvalidInputError` for a weight that is negative or not finite."""
    if not (weight >= 0 and math.isfinite(weight)):
        raise InvalidInputError(f"{flag} must be a number of at least 0, found {weight}")


def own_functions(flag: str, names: tuple[str, ...]) -> dict[str, Callable[..., Any]]:
    """Functions ``module:function``, by the name of the function."""
    found = {name.rpartition(":")[2]: load_object(flag, name) for name in names}
    for name, function in found.items():
        if not callable(function):
            raise InvalidInputError(f"{flag} {name}: must be a function, found {function!r}")
    return found


def use_device(name: str) -> None:
    """Let JAX compute on the device of ``--device``, and say which where there is a choice.

    Must run before JAX has looked for devices. Measured on an H200 with 16 cores, training on
    pickup takes 305 s on the GPU and 109 s on the CPU, a control step 4.8 and 1.3 ms.
    """
    wanted = choice("--device", name, {AUTO: "cpu", "cpu": "cpu", "gpu": "gpu"})
    import jax

    if name == AUTO and os.environ.get("JAX_PLATFORMS"):
        return
    if wanted == "cpu":
        jax.config.update("jax_platforms", "cpu")
    elif jax.default_backend() == "cpu":
        raise InvalidInputError(
            "--device gpu: JAX finds no accelerator (pip install 'jax[cuda13]')"
        )
    if name != AUTO or entry_points(group="jax_plugins"):
        print(f"device: {jax.devices()[0]}", file=sys.stderr)


def open_executor(cluster: str) -> AbstractContextManager[Executor]:
    """The executor of ``--cluster``: ``local``, ``ray`` or ``ray:HOST:PORT``."""
    name, colon, address = cluster.partition(":")
    if choice("--cluster", name, {"local": False, "ray": True}):
        from contactgraph.ray_cluster import connected

        return connected(address if colon else None)
    if colon:
        raise InvalidInputError(f"--cluster: local takes no address, found {address!r}")
    return nullcontext(LocalExecutor())
