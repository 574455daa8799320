"""What the benchmarks share: the machine, counting compilations, the table, the JSON file."""

import argparse
import json
import os
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax


def arguments(description: str) -> argparse.Namespace:
    """``--quick`` and ``--json FILE``."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--quick", action="store_true", help="few repetitions: to see that it runs")
    parser.add_argument("--json", type=Path, help="write the measurements to this file")
    return parser.parse_args()


def machine() -> dict[str, Any]:
    """Processor, cores, load and versions: figures without these say little."""
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "load_1min": round(os.getloadavg()[0], 2),
        "device": jax.devices()[0].device_kind,
        "system": platform.platform(),
        "python": platform.python_version(),
        **{name: version(name) for name in ("contactgraph", "jax", "jaxlib", "equinox", "numpy")},
    }


def _processor() -> str:
    information = Path("/proc/cpuinfo")
    if information.is_file():
        for line in information.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


class Compilations:
    """Counts XLA compilations, from JAX's own events. One lives as long as the process."""

    def __init__(self) -> None:
        self.count = 0
        jax.monitoring.register_event_duration_secs_listener(self._heard)

    def _heard(self, event: str, seconds: float, **_: Any) -> None:
        self.count += event == "/jax/core/compile/backend_compile_duration"


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows of equal keys as aligned text."""
    heads = list(rows[0])
    cells = [heads, *[[_text(row[head]) for head in heads] for row in rows]]
    widths = [max(len(row[column]) for row in cells) for column in range(len(heads))]
    lines = ["  ".join(c.rjust(w) for c, w in zip(row, widths, strict=True)) for row in cells]
    return "\n".join([lines[0], "  ".join("-" * width for width in widths), *lines[1:]])


def _text(value: Any) -> str:
    if value is None:
        return "-"
    if not isinstance(value, float):
        return str(value)
    return f"{value:.2f}" if abs(value) < 100 else f"{value:,.0f}"


def report(name: str, rows: Sequence[Mapping[str, Any]], told: argparse.Namespace) -> None:
    """Print the machine and the table; write both as JSON where a file was named."""
    about = machine()
    print(
        f"{about['processor']}, {about['cores']} cores, load {about['load_1min']}, "
        f"jax {about['jax']} on {about['device']}, Python {about['python']}"
    )
    print(table(rows))
    if told.json is not None:
        content = {"benchmark": name, "quick": told.quick, "machine": about, "rows": list(rows)}
        told.json.write_text(json.dumps(content, indent=2) + "\n")
