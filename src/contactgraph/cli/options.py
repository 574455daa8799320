"""Values of command line options: names looked up, numbers checked before any work is done."""

import ast
import math
import os
import re
import sys
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields
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

AUTO = "auto"
"""In place of a model's name: chosen by the data."""
TEMPERATURE = 0.15
"""See `contactgraph.model.ModelConfig.temperature`."""

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
ControllerArgument = Positional[
    Annotated[
        str,
        arg(
            metavar="MODEL",
            help="A run folder of train, a model file, a shipped model (door, franka, multi-pickup "
            "or pickup), or module:factory@MODEL. In its place, expert is the task's scripted "
            "demonstrator, and fixed-start its controller without model or search.",
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
Distractors = Annotated[
    int,
    arg(
        help="Further bodies: pickups, suction, release, delay, sticky, look-alikes and "
        "unknown-mass 0 to 20, door 0 to 10, franka 0 to 5."
    ),
]
Objects = Annotated[
    int | None,
    arg(
        metavar="INT",
        help="Objects to pick up, 1 to 5, to try, 2 to 5, or to strike, 1 to 8, for tasks with a "
        "choice.",
        help_behavior_hint="(multi-pickup: 2, sticky: 3, billiards: 3)",
    ),
]
HiddenSwitch = Annotated[
    bool,
    arg(help="suction: a random process that nothing records operates the switch."),
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
Engine = Annotated[
    str | None,
    arg(
        metavar="NAME",
        help="Physics of planar tasks: box2d or pymunk.",
        help_behavior_hint="(the first that is installed)",
    ),
]
Grasp = Annotated[
    str | None,
    arg(
        metavar="NAME",
        help="Contact model of the fingers, for tasks with fingers: friction or weld.",
        help_behavior_hint="(franka: friction)",
    ),
]
FalseAlarms = Annotated[
    float,
    arg(
        metavar="RATE",
        help="Share of free edges that the contact sensor reports as touching, at every step.",
    ),
]
Misses = Annotated[
    float,
    arg(metavar="RATE", help="Share of touching edges that the contact sensor reports as free."),
]
FaultName = Annotated[
    str | None,
    arg(
        metavar="MODULE:CLASS",
        help="A faulty contact sensor of your own, a class of SensorFault.",
        help_behavior_hint="(none)",
    ),
]
MetricNames = Annotated[
    tuple[str, ...],
    arg(
        metavar="MODULE:FUNCTION ...",
        help="Metrics of your own, added under the functions' names.",
        help_behavior_hint="(none)",
    ),
]
Delay = Annotated[int, arg(metavar="STEPS", help="Delay of the contact sensor, steps.")]
Horizon = Annotated[
    int | None,
    arg(
        metavar="INT",
        help="Planning horizon, steps.",
        help_behavior_hint="(20; pushing 30; franka 50; twice with --cost)",
    ),
]
Starts = Annotated[
    int | None,
    arg(
        metavar="INT",
        help="Ways round a body to push it that each plan compares, twice; 0: none.",
        help_behavior_hint="(64 for pushing, else 0)",
    ),
]
Routes = Annotated[
    int | None,
    arg(
        metavar="INT",
        help="Routes to where the cost is least that each plan compares; 0: none.",
        help_behavior_hint="(7 with --clearance, else 0)",
    ),
]
Segment = Annotated[
    int,
    arg(
        help="Steps of the short plans by which a long plan begins, such as 20 for a --horizon of "
        "200; 0: none."
    ),
]
Clearance = Annotated[
    float | None,
    arg(
        metavar="M",
        help="Gap to keep from bodies that the task does not name, m.",
        help_behavior_hint="(may touch them)",
    ),
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
Inference = Annotated[
    str,
    arg(
        metavar="NAME",
        help="Inference of edges: filter, the model's own, or an ablation: prior-touch or "
        "prior-hold, the geometric prior alone, of edges that touch or that hold; or none, without "
        "edges.",
    ),
]
OutputFile = Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(optional)")]

_LARGEST_SEED = 2**32 - 1
"""Random keys are made of 32 bits: a larger seed would give the numbers of a smaller one."""


FLAGS = (
    *("distractors", "objects", "grasp", "radius", "passive", "hidden_switch"),
    *("in_the_way", "engine"),
)
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


def check_episodes(episodes: int) -> None:
    """Raises `InvalidInputError` for no episodes, or more than fit into memory."""
    check_range("--episodes", episodes, 1, 100_000)


def check_weight(flag: str, weight: float) -> None:
    """Raises `InvalidInputError` for a weight that is negative or not finite."""
    if not (weight >= 0 and math.isfinite(weight)):
        raise InvalidInputError(f"{flag} must be a number of at least 0, found {weight}")


def check_share(flag: str, share: float) -> None:
    """Raises `InvalidInputError` for a share outside 0 to 1."""
    if not 0.0 <= share <= 1.0:
        raise InvalidInputError(f"{flag} must be 0 to 1, found {share}")


def sensor_fault(
    name: str | None, false_alarms: float, misses: float, delay: int, seed: int
) -> "SensorFault":
    """The contact sensor that the flags describe; raises `InvalidInputError` for wrong values."""
    from contactgraph.policies import SensorFault, SensorFaults

    for flag, rate in (("--false-alarms", false_alarms), ("--misses", misses)):
        if not 0.0 <= rate < 1.0:
            raise InvalidInputError(f"{flag} must be a share from 0 to below 1, found {rate}")
    check_range("--delay", delay, 0, 1000)
    faults = SensorFaults(false_alarms, misses, delay, seed)
    if name is None:
        return faults
    if not faults.exact:
        raise InvalidInputError(
            "--fault: it errs alone, so --false-alarms, --misses and --delay must be left out"
        )
    own = load_object("--fault", name)()
    if not isinstance(own, SensorFault):
        raise InvalidInputError(f"--fault {name}: must be a class of SensorFault, found {own!r}")
    return own


def own_functions(flag: str, names: tuple[str, ...]) -> dict[str, Callable[..., Any]]:
    """Functions ``module:function``, by the name of the function."""
    found = {name.rpartition(":")[2]: load_object(flag, name) for name in names}
    for name, function in found.items():
        if not callable(function):
            raise InvalidInputError(f"{flag} {name}: must be a function, found {function!r}")
    return found


def device_count(batch_size: int) -> int:
    """The devices of this machine that share a batch: the most that divide it."""
    import jax

    there = jax.local_device_count()
    return max(count for count in range(1, there + 1) if batch_size % count == 0)


Device = Annotated[
    str,
    arg(
        metavar="NAME",
        help="auto or cpu: the CPU, which is faster for all that this command does; gpu: the first "
        "accelerator that JAX finds. JAX_PLATFORMS, where it is set, decides for auto.",
    ),
]


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
