"""LeRobot datasets, version 3: parquet files with JSON beside them.

The layout is that of https://huggingface.co/docs/lerobot/lerobot-dataset-v3: frames of all episodes
one after the other in ``data/chunk-*/file-*.parquet``, described by ``meta/info.json``.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.data.untrusted_hdf5 import reading
from contactgraph.interchange.export_layout import MAP_FILE, ExportLayout, new_folder
from contactgraph.interchange.map_entries import positive_at
from contactgraph.interchange.recording import (
    Column,
    Episode,
    Recording,
    check_count,
    check_file,
    read_json,
)

_INFO = "meta/info.json"
_FIRST = "chunk-000/file-000.parquet"
_INDEX = "__index_level_0__"
_WHOLE = 1e-6
"""Largest error of a whole number of frames a second, relative."""
_LARGEST_FILE = 2**32
_SETTINGS: dict[str, Any] = {
    "threads": 1,
    "memory_limit": "1GB",
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
}
_OWN = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""Features of every dataset, which are no observations."""
_CLOCKS = ("timestamp", "frame_index")
_RATE_ERROR = 0.1
_CLOCK_STEP = 1e-6
"""s, to which stamps in single precision are rounded."""
_NUMBERS = ("float16", "float32", "float64", "bool", "int8", "int16", "int32", "int64", "uint8")


def read_lerobot(source: Path) -> Recording:
    """The dataset in the folder ``source``, without its images and videos."""
    if not (source / _INFO).exists():
        raise InvalidInputError(f"{source}: must be a folder of LeRobot with {_INFO}")
    info = read_json(source / _INFO)
    version = info.text("codebase_version")
    if not version.startswith("v3."):
        raise InvalidInputError(
            f"{source / _INFO}: codebase_version must be v3.0 or a later v3, found {version!r}; "
            "lerobot itself converts older datasets"
        )
    fps = positive_at(info, "fps")
    features = info.inner("features")
    widths, others, labels = {"episode_index": 1, "index": 1}, {}, {}
    for name in features.content:
        if name in _CLOCKS:
            widths[name] = 1
        elif name not in _OWN:
            feature = features.inner(name)
            kind, shape = feature.text("dtype"), feature.content.get("shape")
            if kind in _NUMBERS and isinstance(shape, list) and len(shape) == 1:
                widths[name] = int(feature.numbers("shape", (1,))[0])
                given = feature.content.get("names")
                if isinstance(given, list) and len(given) == widths[name]:
                    labels[name] = tuple(map(str, given))
            else:
                others[name] = f"{kind} of shape {shape}"
    files, frames, total = [], 0, info.count("total_frames", 1)
    for path in sorted((source / "data").glob("*/*.parquet")):
        files.append(_read(path, widths))
        frames += len(files[-1]["index"])
        check_count(str(source), frames * sum(widths.values()))
    if frames != total:
        raise InvalidInputError(
            f"{source}: must have {total} frames, as {_INFO} says, found {frames} in "
            f"{len(files)} files of data"
        )
    columns = {name: np.concatenate([each[name] for each in files]) for name in widths}
    if len(np.unique(columns["index"])) != frames:
        raise InvalidInputError(f"{source}: index must be different in all frames")
    order = np.lexsort((columns.pop("index")[:, 0], columns["episode_index"][:, 0]))
    columns = {name: values[order] for name, values in columns.items()}
    index = columns.pop("episode_index")[:, 0]
    stamps, number = (columns.pop(name)[:, 0] if name in columns else None for name in _CLOCKS)
    begins = np.diff(index, prepend=np.nan) != 0
    if number is not None:
        begins |= np.diff(number, prepend=np.nan) < 0
        stamps = number / fps if stamps is None else stamps
        elapsed, counted = (np.diff(each)[~begins[1:]] for each in (stamps * fps, number))
        step = np.median(elapsed) if len(elapsed) else 1.0
        if np.any(counted > elapsed + 0.5) or abs(step - 1.0) > _RATE_ERROR:
            raise InvalidInputError(
                f"{source}: timestamp must fit frame_index and fps {fps:g}, found steps of "
                f"{step / fps:g} s"
            )
    episodes = []
    for rows in np.split(np.arange(frames), np.flatnonzero(begins)[1:]):
        times = None if stamps is None else _CLOCK_STEP * np.round(stamps[rows] / _CLOCK_STEP)
        found = {
            name: Column(values[rows], times, labels=labels.get(name, ()))
            for name, values in columns.items()
        }
        episodes.append(Episode(f"episode {index[rows[0]]:g}", found, others))
    stated = info.content.get("total_episodes", len(episodes))
    if stated != len(episodes):
        raise InvalidInputError(
            f"{source}: must have {stated!r} episodes, as {_INFO} says, found {len(episodes)}"
        )
    return Recording(str(source), tuple(episodes), dt=1.0 / fps)


def _database() -> Any:
    """A database in memory, which reads and writes parquet and loads nothing."""
    try:
        import duckdb
    except ImportError as error:
        raise InvalidInputError(
            f"LeRobot datasets need duckdb ({error}): pip install 'contactgraph[lerobot]'"
        ) from error
    return duckdb.connect(config=_SETTINGS)


def _read(path: Path, widths: dict[str, int]) -> dict[str, np.ndarray]:
    """[S, width] of each column, of numbers or of lists of them."""
    check_file(path, _LARGEST_FILE)
    columns = {}
    with _database() as database, reading(str(path)):
        head = "SELECT num_rows FROM parquet_file_metadata(?)"
        ((rows,),) = database.execute(head, [str(path)]).fetchall()
        check_count(str(path), rows * sum(widths.values()))
        table = database.read_parquet(str(path))
        kinds = dict(zip(table.columns, map(str, table.types), strict=True))
        missing = sorted(widths.keys() - kinds.keys())
        if missing:
            raise InvalidInputError(f"{path}: no column {', '.join(missing)}")
        for name, width in widths.items():
            column = _quoted(name)
            if kinds[name].endswith("[]"):
                # Before they are unpacked: a few bytes can stand for any number of values.
                count = f"count_if(len({column}) IS DISTINCT FROM {width})"
                ((others,),) = table.aggregate(count).fetchall()
                column = "NULL" if others else f"unnest({column})"
            selected = table.project(f"{column} AS found").limit(rows * width + 1)
            found = selected.fetchnumpy()["found"]
            wrong = found.dtype.kind not in "biuf" or isinstance(found, np.ma.MaskedArray)
            if wrong or found.size != rows * width:
                raise InvalidInputError(
                    f"{path}: column {name!r} must have {width} numbers in each of {rows} rows"
                )
            columns[name] = found.reshape(rows, width).astype(np.float64)
    return columns


def write_lerobot(layout: ExportLayout, folder: Path) -> None:
    """Writes a dataset, whose ``observation.state`` is all states, to a new folder.

    The last frame of an episode, which leads to no state, repeats the control before.
    """
    dataset = layout.dataset
    fps = 1.0 / dataset.dt
    if abs(fps - round(fps)) > _WHOLE * fps:
        raise InvalidInputError(
            f"LeRobot has whole frames a second, but steps of {dataset.dt:g} s are {fps:g}"
        )
    lengths = np.array([each.steps + 1 for each in dataset])
    ends = np.cumsum(lengths)
    frame = np.concatenate([np.arange(length) for length in lengths])
    last_twice = ((0, 1), (0, 0))
    numbers = {
        "observation.state": np.concatenate([layout.states(each) for each in dataset]),
        "action": np.concatenate([np.pad(each.control, last_twice, "edge") for each in dataset]),
        "timestamp": (frame * dataset.dt).astype(np.float32),
        "frame_index": frame,
        "episode_index": np.repeat(np.arange(len(lengths)), lengths),
        "index": np.arange(ends[-1]),
        "task_index": np.zeros(ends[-1], dtype=np.int64),
    }
    numbers = {name: each for name, each in numbers.items() if each.size}
    names = {"observation.state": layout.names, "action": layout.control_names}
    info = {
        "codebase_version": "v3.0",
        "robot_type": None,
        "total_episodes": len(lengths),
        "total_frames": int(ends[-1]),
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": round(fps),
        "splits": {"train": f"0:{len(lengths)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": {
            name: {
                "dtype": str(each.dtype),
                "shape": [*each.shape[1:]] or [1],
                "names": names.get(name),
            }
            for name, each in numbers.items()
        },
    }
    task = str(dataset.metadata.get("task", "contactgraph"))
    places = ("chunk_index", "file_index")
    episodes = {
        "episode_index": np.arange(len(lengths)),
        "tasks": np.full((len(lengths), 1), task, dtype=object),
        "length": lengths,
        "dataset_from_index": ends - lengths,
        "dataset_to_index": ends,
        **{f"{of}/{each}": 0 * lengths for of in ("data", "meta/episodes") for each in places},
    }
    tasks = {"task_index": np.zeros(1, dtype=np.int64), _INDEX: np.array([task], dtype=object)}
    # pandas reads the tasks, and takes the column that is described here for their index.
    column = {"name": None, "field_name": _INDEX, "metadata": None}
    column |= {"pandas_type": "unicode", "numpy_type": "object"}
    index = {"index_columns": [_INDEX], "columns": [column], "column_indexes": []}
    pandas = _quoted(json.dumps(index), mark="'")
    texts = {
        _INFO: json.dumps(info, indent=2),
        "meta/stats.json": json.dumps({name: _statistics(each) for name, each in numbers.items()}),
        MAP_FILE: layout.map_text('"observation.state[{}:{}]"'.format, '"action[{}:{}]"'.format),
    }
    with new_folder(folder) as temporary:
        _write(temporary / "data" / _FIRST, numbers)
        _write(temporary / "meta/episodes" / _FIRST, episodes)
        _write(temporary / "meta/tasks.parquet", tasks, f", KV_METADATA {{pandas: {pandas}}}")
        for name, text in texts.items():
            (temporary / name).write_text(text, encoding="utf-8")


def _write(path: Path, columns: Mapping[str, np.ndarray], options: str = "") -> None:
    """Each a column of single values [S], or of lists [S, width]."""
    single: dict[str, np.ndarray] = {}
    select = []
    for name, values in columns.items():
        parts = [f"{name}/{index}" for index in range(values[:1].size)]
        single |= zip(parts, np.ascontiguousarray(np.atleast_2d(values.T)), strict=True)
        listed = ", ".join(map(_quoted, parts))
        select.append(f"{f'[{listed}]' if values.ndim > 1 else listed} AS {_quoted(name)}")
    place = _quoted(str(path), mark="'")
    path.parent.mkdir(parents=True, exist_ok=True)
    with _database() as database:
        database.register("single", single)
        database.execute(
            f"COPY (SELECT {', '.join(select)} FROM single) TO {place} (FORMAT parquet{options})"
        )


def _quoted(text: str, mark: str = '"') -> str:
    """A name in SQL, or with the ``mark`` ' a text."""
    return mark + text.replace(mark, 2 * mark) + mark


def _statistics(values: np.ndarray) -> dict[str, list[float]]:
    """By which LeRobot's policies scale a feature."""
    rows = values.reshape(len(values), -1).astype(np.float64)
    finite = np.isfinite(rows).all(axis=1)
    rows = rows[finite] if finite.any() else rows
    names = ("min", "max", "mean", "std")
    found = {name: getattr(rows, name)(axis=0).tolist() for name in names}
    for share in (1, 10, 50, 90, 99):
        found[f"q{share:02d}"] = np.percentile(rows, share, axis=0).tolist()
    return {**found, "count": [len(rows)]}
