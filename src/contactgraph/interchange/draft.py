"""A first import map for a recording, to be corrected by hand, below a list of its columns."""

import json
import re

import numpy as np

from contactgraph.interchange.recording import Column, Episode, Recording
from contactgraph.interchange.scene_map import parse_map, shipped_map_text, shipped_maps

_POSITION = re.compile(
    r"(?P<body>.+?)\.(?:pose\.pose\.|pose\.|transform\.)?(?:position|translation)"
)
_AXIS = re.compile(r"(?P<body>.+?)[._ ]?(?:position|pos)?[._ ](?P<axis>[xyz])", re.IGNORECASE)
_CONTROL = re.compile(r"(?:.*[./_])?(?:actions?|controls?|commands?|cmd|force|wrench)(?:[./_].*)?")
_TURNS = ("rotation", "orientation")
_NO_BODY = re.compile(r"(?:.*[._ ])?(?:goal|vel(?:ocity)?|acc(?:eleration)?|rot(?:ation)?)")
_GUESSED_DT = 0.05


def draft_map(recording: Recording) -> str:
    """An import map in TOML; what is in the recording stands above it, as comments.

    It is the shipped map of the recorded environment where there is one. Else bodies, control and
    time step are guessed by the names and widths of columns.
    """
    lines = [f"# {recording.where}: {len(recording.episodes)} episodes"]
    lines += [f"#   {each}" for each in _columns(recording)]
    for name in shipped_maps():
        text = shipped_map_text(name)
        begins = parse_map(name, text).environment
        if begins and recording.environment.startswith(begins):
            lines += [f"# {recording.environment} has a map of its own, --map {name}:", "", text]
            return "\n".join(lines)
    lines.append("# A draft: correct it, above all what the control is, and the axes.")
    return "\n".join([*lines, *_guessed(recording)]) + "\n"


def _columns(recording: Recording) -> list[str]:
    """A line for each column: name, width, and least and largest number of all episodes."""
    lines, columns, others = [], dict[str, Column](), dict[str, str]()
    for each in recording.episodes:
        columns, others = each.columns | columns, each.others | others
    for name, column in columns.items():
        found = [each.columns[name].values for each in recording.episodes if name in each.columns]
        finite = [values[np.isfinite(values)] for values in found]
        low = min((each.min() for each in finite if each.size), default=np.nan)
        high = max((each.max() for each in finite if each.size), default=np.nan)
        gaps = sum(int(np.isnan(values).any(axis=1).sum()) for values in found)
        missing = f", nothing in {gaps} rows" if gaps else ""
        rows = sum(map(len, found))
        lines.append(
            f"{name}[{column.values.shape[1]}]  {low:.4g} to {high:.4g}, {rows} rows{missing}"
        )
    return lines + [f"{name}  not used: {what}" for name, what in others.items()]


def _guessed(recording: Recording) -> list[str]:
    episode = recording.episodes[0]
    bodies = _bodies(episode)
    dimension = _width(episode, next(iter(bodies.values()))[0])
    lines = [f"dimension = {dimension}  # 2 in the plane, 3 in space", "", "[time]"]
    lines.append(_time_step(recording))
    controls = [name for name in episode.columns if _CONTROL.fullmatch(name.lower())]
    for index, (name, (columns, turn)) in enumerate(bodies.items()):
        lines += ["", "[[body]]", f"name = {json.dumps(name)}"]
        lines.append('type = "object"  # bodies of one type share what is learned')
        drives = json.dumps(index == 0 and bool(controls))
        lines.append(f"actuated = {drives}  # whether the control acts on it")
        reference = columns[0] if len(columns) == 1 else list(columns)
        lines.append(f"position = {json.dumps(reference)}  # m; else with a scale")
        if turn and dimension == 3:
            table = f'{{ columns = {json.dumps(turn)}, order = "xyzw" }}'
            lines.append(f"orientation = {table}")
    for name in controls:
        lines += ["", "[[control]]", f"columns = {json.dumps(name)}"]
        lines.append(
            'kind = "force"  # or position, displacement, velocity, switch, other: see the docs'
        )
        lines.append(f"body = {json.dumps(next(iter(bodies)))}")
    return lines


def _bodies(episode: Episode) -> dict[str, tuple[tuple[str, ...], str]]:
    """By name, columns of the position and of a quaternion, if any; at least one body."""
    found: dict[str, tuple[tuple[str, ...], str]] = {}
    axes: dict[str, dict[str, str]] = {}
    quaternions = {name for name, c in episode.columns.items() if c.values.shape[1] == 4}
    for name, column in episode.columns.items():
        width = column.values.shape[1]
        match = _POSITION.fullmatch(name)
        if match and width in (2, 3) and "Marker)" not in name:
            stem = name.removesuffix("position").removesuffix("translation")
            turn = next((f"{stem}{each}" for each in _TURNS if f"{stem}{each}" in quaternions), "")
            found[match["body"]] = ((name,), turn)
        elif width == 1 and name.lower() in ("x", "y", "z"):
            axes.setdefault("body", {})[name.lower()] = name
        elif width == 1 and (single := _AXIS.fullmatch(name)):
            axes.setdefault(single["body"], {})[single["axis"].lower()] = name
    for body, named in axes.items():
        columns = tuple(named[axis] for axis in "xyz" if axis in named)
        no_body = _CONTROL.fullmatch(body.lower()) or _NO_BODY.fullmatch(body.lower())
        if len(columns) > 1 and body not in found and not no_body:
            found[body] = (columns, "")
    if not found:
        name, column = max(episode.columns.items(), key=lambda item: item[1].values.shape[1])
        width = column.values.shape[1]
        found["body"] = ((f"{name}[0:2]",) if width > 1 else (name, name), "")
    sizes = {name: _width(episode, columns) for name, (columns, _) in found.items()}
    largest = max(sizes.values())
    return {name: each for name, each in found.items() if sizes[name] == largest}


def _width(episode: Episode, columns: tuple[str, ...]) -> int:
    return sum(episode.column(each).values.shape[1] for each in columns)


def _time_step(recording: Recording) -> str:
    if recording.dt is not None:
        return f"dt = {recording.dt!r}  # s, of the recording"
    stamps = [c.stamps for c in recording.episodes[0].columns.values() if c.stamps is not None]
    steps = np.concatenate([np.diff(each) for each in stamps]) if stamps else np.zeros(0)
    steps = steps[steps > 0.0]
    if not len(steps):
        return f"dt = {_GUESSED_DT}  # s: the recording does not tell it"
    return f"dt = {float(f'{np.median(steps):.4g}')!r}  # s, the median of the recording's"
