"""LeRobot datasets, version 3: parquet files with JSON beside them.

The layout is that of https://huggingface.co/docs/lerobot/lerobot-dataset-v3: frames of all episodes
one after the other in ``data/chunk-*/file-*.parquet``, described by ``meta/info.json``.
"""

import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from contactgraph.data import InvalidInputError
from contactgraph.data.json_fields import JsonFields
from contactgraph.data.untrusted_hdf5 import reading
from contactgraph.interchange.export_layout import MAP_FILE, ExportLayout, new_folder
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
_SETTINGS: dict[str, str | bool | int | float | list[str]] = {
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
    fps = info.number("fps")
    if fps <= 0.0:
        raise InvalidInputError(f"{source / _INFO}: fps must be above 0, found {fps}")
    widths, others = _features(info)
    paths = sorted((source / "data").glob("*/*.parquet"))
    clocks = [name for name in _CLOCKS if name in info.inner("features").content]
    needed = {"episode_index": 1, "index": 1, **dict.fromkeys(clocks, 1), **widths}
    rows = [_rows(each, needed) for each in paths]
    frames, total = sum(rows), info.count("total_frames", 0)
    if frames != total or not paths:
        raise InvalidInputError(
            f"{source}: must have {total} frames, as {_INFO} says, found {frames} in "
            f"{len(paths)} files of data"
        )
    check_count(str(source), frames * sum(needed.values()))
    files = [_columns(each, needed, count) for each, count in zip(paths, rows, strict=True)]
    columns = {name: np.concatenate([each[name] for each in files]) for name in needed}
    if len(np.unique(columns["index"])) != frames:
        raise InvalidInputError(f"{source}: index must be different in all frames")
    order = np.lexsort((columns["index"][:, 0], columns["episode_index"][:, 0]))
    columns = {name: values[order] for name, values in columns.items()}
    index = columns.pop("episode_index")[:, 0]
    columns.pop("index")
    clock = {name: columns.pop(name)[:, 0] for name in clocks}
    begins = np.diff(index, prepend=np.nan) != 0
    if "frame_index" in clock:
        begins |= np.diff(clock["frame_index"], prepend=np.nan) < 0
    starts = np.flatnonzero(begins)
    stated = info.content.get("total_episodes", len(starts))
    if stated != len(starts):
        raise InvalidInputError(
            f"{source}: must have {stated!r} episodes, as {_INFO} says, found {len(starts)}"
        )
    stamps = clock.get("timestamp")
    if stamps is None and "frame_index" in clock:
        stamps = clock["frame_index"] / fps
    if stamps is not None and "frame_index" in clock:
        steps = np.diff(stamps)[~begins[1:]] * fps, np.diff(clock["frame_index"])[~begins[1:]]
        if np.any(steps[1] > steps[0] + 0.5) or (
            len(steps[0]) and abs(np.median(steps[0]) - 1.0) > _RATE_ERROR
        ):
            raise InvalidInputError(
                f"{source}: timestamp must fit frame_index and fps {fps:g}, found steps of "
                f"{np.median(steps[0]) / fps:g} s"
            )
    if stamps is not None:
        stamps = _CLOCK_STEP * np.round(stamps / _CLOCK_STEP)
    return Recording(
        str(source),
        tuple(
            Episode(
                f"episode {index[rows[0]]:g}",
                {
                    name: Column(values[rows], None if stamps is None else stamps[rows])
                    for name, values in columns.items()
                },
                others,
            )
            for rows in np.split(np.arange(frames), starts[1:])
        ),
        dt=1.0 / fps,
    )


def _features(info: JsonFields) -> tuple[dict[str, int], dict[str, str]]:
    """Widths of the features that are numbers, and what the others are."""
    features = info.inner("features")
    widths, others = {}, {}
    for name in features.content:
        if name in _OWN:
            continue
        feature = features.inner(name)
        kind, shape = feature.text("dtype"), feature.content.get("shape")
        if kind in _NUMBERS and isinstance(shape, list) and len(shape) == 1:
            widths[name] = int(feature.numbers("shape", (1,))[0])
        else:
            others[name] = f"{kind} of shape {shape}"
    return widths, others


@contextmanager
def _database() -> Iterator[Any]:
    """A database in memory, which reads and writes parquet and loads nothing."""
    try:
        import duckdb
    except ImportError as error:
        raise InvalidInputError(
            f"LeRobot datasets need duckdb ({error}): pip install 'contactgraph[lerobot]'"
        ) from error
    with duckdb.connect(config=_SETTINGS) as database:
        yield database


def _rows(path: Path, names: Iterable[str]) -> int:
    """Rows of a parquet file that has these columns, by its head."""
    check_file(path, _LARGEST_FILE)
    with _database() as database, reading(str(path)):
        count = "SELECT num_rows FROM parquet_file_metadata(?)"
        ((rows,),) = database.execute(count, [str(path)]).fetchall()
        columns = database.execute("DESCRIBE SELECT * FROM read_parquet(?)", [str(path)]).fetchall()
        missing = set(names) - {name for name, *_ in columns}
        if missing:
            raise InvalidInputError(f"{path}: no column {', '.join(sorted(missing))}")
        return int(rows)


def _columns(path: Path, widths: dict[str, int], rows: int) -> dict[str, np.ndarray]:
    """[rows, width] of each column, of numbers or of lists of them."""
    with _database() as database, reading(str(path)):

        def ask(select: str) -> Any:
            text = f"SELECT {select} FROM read_parquet(?) LIMIT {rows * max(widths.values()) + 1}"
            return database.execute(text, [str(path)])

        def values(name: str, width: int) -> np.ndarray:
            column = _quoted(name)
            ((lists,),) = ask(f"any_value(typeof({column})) LIKE '%[]'").fetchall()
            if lists:
                # Before they are unpacked: a few bytes can stand for any number of values.
                ((others,),) = ask(f"count_if(len({column}) IS DISTINCT FROM {width})").fetchall()
                column = "NULL" if others else f"unnest({column})"
            found = ask(f"{column} AS found").fetchnumpy()["found"]
            wrong = found.dtype.kind not in "biuf" or isinstance(found, np.ma.MaskedArray)
            if wrong or found.size != rows * width:
                raise InvalidInputError(
                    f"{path}: column {name!r} must have {width} numbers in each of {rows} rows"
                )
            return found.reshape(rows, width).astype(np.float64)

        return {name: values(name, width) for name, width in widths.items()}


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


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
    numbers = {
        "observation.state": np.concatenate([layout.states(each) for each in dataset]),
        "action": np.concatenate(
            [np.concatenate([each.control, each.control[-1:]]) for each in dataset]
        ),
        "timestamp": (frame * dataset.dt).astype(np.float32),
        "frame_index": frame,
        "episode_index": np.repeat(np.arange(len(lengths)), lengths),
        "index": np.arange(ends[-1]),
        "task_index": np.zeros(ends[-1], dtype=np.int64),
    }
    names = {"observation.state": layout.names, "action": layout.control_names}
    numbers = {name: each for name, each in numbers.items() if each.ndim == 1 or each.shape[1]}
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
    whole = np.zeros(len(lengths), dtype=np.int64)
    task = str(dataset.metadata.get("task", "contactgraph"))
    episodes = {
        "episode_index": np.arange(len(lengths)),
        "tasks": np.full((len(lengths), 1), task, dtype=object),
        "length": lengths,
        "data/chunk_index": whole,
        "data/file_index": whole,
        "dataset_from_index": ends - lengths,
        "dataset_to_index": ends,
        "meta/episodes/chunk_index": whole,
        "meta/episodes/file_index": whole,
    }
    # pandas reads the tasks, and takes the column that is described here for their index.
    column = {"name": None, "field_name": _INDEX, "metadata": None}
    column |= {"pandas_type": "unicode", "numpy_type": "object"}
    index = {"index_columns": [_INDEX], "columns": [column], "column_indexes": []}
    tasks = {"task_index": np.zeros(1, dtype=np.int64), _INDEX: np.array([task], dtype=object)}
    tables: dict[str, Mapping[str, np.ndarray]] = {
        f"data/{_FIRST}": numbers,
        f"meta/episodes/{_FIRST}": episodes,
        "meta/tasks.parquet": tasks,
    }
    texts = {
        _INFO: json.dumps(info, indent=2),
        "meta/stats.json": json.dumps({name: _statistics(each) for name, each in numbers.items()}),
        MAP_FILE: layout.map_text(
            lambda start, stop: f'"observation.state[{start}:{stop}]"',
            lambda start, stop: f'"action[{start}:{stop}]"',
        ),
    }
    with new_folder(folder) as temporary:
        for name, table in tables.items():
            (temporary / name).parent.mkdir(parents=True, exist_ok=True)
            _write(temporary / name, table, json.dumps(index) if table is tasks else None)
        for name, text in texts.items():
            (temporary / name).write_text(text, encoding="utf-8")


def _write(path: Path, columns: Mapping[str, np.ndarray], pandas: str | None) -> None:
    """Each a column of single values [S], or of lists [S, width]; with metadata for pandas."""
    single: dict[str, np.ndarray] = {}

    def single_column(values: np.ndarray) -> str:
        name = f"c{len(single)}"
        single[name] = np.ascontiguousarray(values)
        return name

    def selected(name: str, values: np.ndarray) -> str:
        if values.ndim == 1:
            return f"{single_column(values)} AS {_quoted(name)}"
        parts = ", ".join(single_column(each) for each in values.T)
        return f"[{parts}] AS {_quoted(name)}"

    select = ", ".join(selected(name, values) for name, values in columns.items())
    metadata = "" if pandas is None else f", KV_METADATA {{pandas: {_text(pandas)}}}"
    with _database() as database:
        database.register("single", single)
        database.execute(
            f"COPY (SELECT {select} FROM single) TO {_text(str(path))} (FORMAT parquet{metadata})"
        )


def _text(value: str) -> str:
    return "'" + value.replace("'", "''") + "'"


def _statistics(values: np.ndarray) -> dict[str, list[float]]:
    """By which LeRobot's policies scale a feature."""
    rows = values.reshape(len(values), -1).astype(np.float64)
    rows = rows[np.isfinite(rows).all(axis=1)] if np.isfinite(rows).all(axis=1).any() else rows
    found = {
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "mean": rows.mean(axis=0),
        "std": rows.std(axis=0),
        **{f"q{share:02d}": np.percentile(rows, share, axis=0) for share in (1, 10, 50, 90, 99)},
    }
    return {**{name: each.tolist() for name, each in found.items()}, "count": [len(rows)]}
