"""All comparisons with peers in one table: ours, peer, ratio, agreement, machine.

Usage: python benchmarks/table.py [--quick] [--python PYTHON] [--out FOLDER]

Runs every comparison in a process of its own, with ``--python`` (that of the environment with the
peers; else this one), prints the table and writes it as ``table.json`` and ``table.md``.
``--quick`` takes little time and shows that all of it runs; its figures are worth nothing.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
COMPARISONS = (
    "lqr_solve",
    "lqr_batch",
    "differentiable_lqr",
    "ilqr_pendulum",
    "collection",
    "first_tick",
)
HEADS = ("what", "ours ms", "peer", "peer ms", "ratio", "agreement")


def measured(name: str, python: str, quick: bool) -> dict[str, Any] | None:
    """The output of one comparison; None if it failed."""
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / "rows.json"
        command = [python, str(HERE / f"{name}.py"), "--json", str(written)]
        print(f"== {name}", flush=True)
        done = subprocess.run([*command, "--quick"] if quick else command, check=False)
        return json.loads(written.read_text()) if done.returncode == 0 else None


def markdown(parts: list[dict[str, Any]]) -> str:
    """The table as a page."""
    about = parts[0]["machine"]
    lines = [
        f"{about['processor']}, {about['system']}, Python {about['python']}, jax {about['jax']}.",
        "",
        "| " + " | ".join(HEADS) + " |",
        "|---|---:|---|---:|---:|---:|",
    ]
    for part in parts:
        for row in part["rows"]:
            lines.append("| " + " | ".join(_text(row[head]) for head in HEADS) + " |")
    return "\n".join(lines) + "\n"


def _text(value: Any) -> str:
    if value is None:
        return ""
    return (
        f"{value:,.3g}"
        if isinstance(value, float) and value < 100
        else (f"{value:,.0f}" if isinstance(value, float) else str(value))
    )


def main() -> int:
    """Measure and print all."""
    parser = argparse.ArgumentParser(description="Ours beside its peers.")
    parser.add_argument("--quick", action="store_true", help="to see that it runs")
    parser.add_argument("--python", default=sys.executable, help="of the peers' environment")
    parser.add_argument("--out", type=Path, help="write table.json and table.md to this folder")
    options = parser.parse_args()
    found = {name: measured(name, options.python, options.quick) for name in COMPARISONS}
    parts = [part for part in found.values() if part is not None]
    page = markdown(parts) if parts else ""
    print(page)
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "table.json").write_text(json.dumps(parts, indent=2) + "\n")
        (options.out / "table.md").write_text(page)
    failed = [name for name, part in found.items() if part is None]
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
