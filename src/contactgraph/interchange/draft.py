"""A first import map for a recording, to be corrected by hand, below a list of its columns."""

import json
import re
from collections.abc import Iterator

import numpy as np

from contactgraph.interchange.recording import Column, Recording
from contactgraph.interchange.scene_map import parse_map, shipped_map_text, shipped_maps

_POSITION = re.compile(r"(?P<body>.+?)\.(?:pose\.|transform\.)*(?:position|translation)")
_AXIS = re.compile(r"(.*?)[._ ]?(?:pos(?:ition)?)?(?:^|[._ [])([xyzXYZ]|[0-2](?=]))]?")
_CONTROL = re.compile(r"(?:.*[./_])?(?:actions?|controls?|commands?|cmd|force|wrench)(?:[./_].*)?")
_NO_BODY = re.compile(r"(?:.*[._ ])?(?:goal|vel(?:ocity)?|acc(?:eleration)?|rot(?:ation)?)")


def draft_map(recording: Recording) -> str:
    """An import map in TOML; what is in the recording stands above it, as comments.

    It is the shipped map of the recorded environment where there is one. Else bodies, control and
    time step are guessed by the names and widths of columns.
    """
    lines = [f"# {recording.where}: {len(recording.episodes)} episodes", *_listed(recording)]
    for name in shipped_maps():
        text = shipped_map_text(name)
        begins = parse_map(name, text).environment
        if begins and recording.environment.startswith(begins):
            lines += [f"# {recording.environment} has a map of its own, --map {name}:", "", text]
            return "\n".join(lines)
    columns = recording.episodes[0].columns
    controls = [name for name in columns if _CONTROL.fullmatch(name.lower())]
    quaternions = {name for name, column in columns.items() if column.values.shape[1] == 4}
    dimension, bodies = _bodies(columns)
    lines += ["# A draft: correct it, above all what the control is, and the axes."]
    lines += [f"dimension = {dimension}  # 2: plane, 3: space", "", "[time]", _time_step(recording)]
    for index, (name, names) in enumerate(bodies.items()):
        lines += ["", "[[body]]", f"name = {json.dumps(name)}"]
        lines += ['type = "object"  # bodies of one type share what is learned']
        lines += [f"actuated = {json.dumps(bool(controls) and index == 0)}  # by the control"]
        lines += [f"position = {json.dumps(names)}  # m; else with a scale"]
        stem = re.sub(r"(?:position|translation)$", "", names[0])
        turns = sorted({f"{stem}rotation", f"{stem}orientation"} & quaternions)
        if turns and dimension == 3:
            lines += [f'orientation = {{ columns = {json.dumps(turns[0])}, order = "xyzw" }}']
    for name in controls:
        lines += ["", "[[control]]", f"columns = {json.dumps(name)}"]
        lines += ['kind = "force"  # or position, displacement, velocity, switch, other: see docs']
        lines += [f"body = {json.dumps(next(iter(bodies)))}"]
    return "\n".join(lines) + "\n"


def _listed(recording: Recording) -> Iterator[str]:
    """A line for each column: name, width, and least and largest number of all episodes."""
    episodes = recording.episodes
    for name in dict.fromkeys(name for each in episodes for name in each.columns):
        found = [each.columns[name].values for each in episodes if name in each.columns]
        finite = np.concatenate([values[np.isfinite(values)] for values in found])
        low, high = (finite.min(), finite.max()) if finite.size else (np.nan, np.nan)
        gaps = sum(int(np.isnan(values).any(axis=1).sum()) for values in found)
        rows = f"{sum(map(len, found))} rows" + f", nothing in {gaps} rows" * bool(gaps)
        yield f"#   {name}[{found[0].shape[1]}]  {low:.4g} to {high:.4g}, {rows}"
    for name, what in {key: each.others[key] for each in episodes for key in each.others}.items():
        yield f"#   {name}  not used: {what}"


def _bodies(columns: dict[str, Column]) -> tuple[int, dict[str, list[str]]]:
    """The number of coordinates, and the columns of each body with so many; at least one body."""
    widths = {name: column.values.shape[1] for name, column in columns.items()}
    found: dict[str, list[str]] = {}
    axes: dict[str, dict[str, str]] = {}
    for name, width in widths.items():
        if width in (2, 3) and "Marker)" not in name and (match := _POSITION.fullmatch(name)):
            found[match["body"]] = [name]
        elif width == 1 and (match := _AXIS.fullmatch(name)):
            axes.setdefault(match[1] or "body", {})[match[2].lower()] = name
    for body, each in axes.items():
        if not (_CONTROL.fullmatch(body.lower()) or _NO_BODY.fullmatch(body.lower())):
            found.setdefault(body, [each[axis] for axis in sorted(each)])
    sizes = {body: sum(widths[each] for each in names) for body, names in found.items()}
    dimension = max(sizes.values(), default=1)
    if dimension > 1:
        return dimension, {body: found[body] for body in found if sizes[body] == dimension}
    name = max(widths, key=lambda each: widths[each])
    return 2, {"body": [f"{name}[0:2]"] if widths[name] > 1 else [name, name]}


def _time_step(recording: Recording) -> str:
    if recording.dt is not None:
        return f"dt = {recording.dt!r}  # s, of the recording"
    stamps = [c.stamps for c in recording.episodes[0].columns.values() if c.stamps is not None]
    steps = np.concatenate([[0.0], *map(np.diff, stamps)])
    if not np.any(steps > 0.0):
        return "dt = 0.05  # s: the recording does not tell it"
    return f"dt = {np.median(steps[steps > 0.0]):.4g}  # s, the median of the recording's"
