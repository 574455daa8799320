"""The files of a study: tables, claims, numbers, and a report that holds them together."""

import itertools
import json
import time
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from pathlib import Path

from contactgraph.cli.output import provenance, write_json, write_text
from contactgraph.viz.metric_table import short
from contactgraph_studies.job import JobRecords
from contactgraph_studies.runner import Failure
from contactgraph_studies.study import Claim, Study, StudyResult


def write_study(
    study: Study, folder: Path, command: str, failures: Sequence[Failure], cores: int
) -> None:
    """Write claims, tables, figures and the report from the outputs in the folder.

    Prints the claims and the first table.
    """
    result, origin = study.result(folder), provenance()
    costs = JobRecords(folder, version("contactgraph")).costs([*study.jobs, *study.kept_jobs])
    hours = sum(one["seconds"] for one in costs.values()) / 3600.0
    date = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    failed = [(failure.job.command, failure.reason) for failure in failures]
    write_json(folder / "claims.json", {"claims": [claim.to_json() for claim in result.claims]})
    write_json(
        folder / "results.json",
        {
            "command": command,
            "date": date,
            **origin,
            "cores": cores,
            "hours_of_jobs": round(hours, 2),
            **result.amounts,
            "failures": [{"command": line, "reason": reason} for line, reason in failed],
            "jobs": costs,
            "cells": result.readings,
        },
    )
    write_text(folder / "table.md", "\n".join(table.markdown() for table in result.tables))
    write_text(folder / "table.csv", result.tables[0].csv())
    commands = [command, *(job.command for job in study.jobs)]
    made = f"{date}; {len(costs)} of {len(study.jobs)} jobs, {short(hours)} h, {cores} at a time"
    packages = ", ".join(f"{name} {number}" for name, number in origin["versions"].items())
    report = study_report(result, failed, commands, f"{made}. {packages}.")
    write_text(folder / "report.md", report)
    for claim in result.claims:
        about = f"{claim.family}, " if claim.family else ""
        print(f"{claim.number}. {about}{claim.verdict}: {claim.title}")
        print(f"   {claim.sentence}")
    print(result.tables[0].markdown())
    print(f"the report: {folder / 'report.md'}")


def publish(study: Study, folder: Path, tables: Path, name: str) -> None:
    """Copy the tables of a study, its claims and, where they are few, its numbers."""
    kept = {"table.csv": f"{name}.csv", "table.md": f"{name}.md"}
    if json.loads((folder / "claims.json").read_text())["claims"]:
        kept["claims.json"] = f"{name}.claims.json"
    if study.keeps_readings:
        kept["results.json"] = f"{name}.json"
    tables.mkdir(parents=True, exist_ok=True)
    for source, target in kept.items():
        write_text(tables / target, (folder / source).read_text(encoding="utf-8"))
    print(f"the tables: {tables / name}.csv and .md")


def study_report(
    result: StudyResult, failures: Sequence[tuple[str, str]], commands: Sequence[str], made: str
) -> str:
    """Markdown, claims first; ``failures`` are commands and reasons."""
    parts = [f"# {result.title}", result.summary]
    if result.claims:
        parts += ["## What the paper claims", *_claims(result.claims)]
    if failures:
        lost = [f"- `{command}`: {reason}" for command, reason in failures]
        parts += ["## Failed measurements", "\n".join(lost)]
    for picture in result.figures:
        parts += [f"## {picture.title}", f"![{picture.title}]({picture.path})", picture.caption]
    for table in result.tables:
        parts += [f"## {table.title}", table.caption, table.markdown().rstrip()]
    parts += ["## Commands", made, "\n".join(["```sh", *commands, "```"])]
    return "\n\n".join(parts) + "\n"


def _claims(claims: Sequence[Claim]) -> Iterator[str]:
    """Each claim once, with what is found of every family of models; claims.json has numbers."""
    for _, group in itertools.groupby(claims, key=lambda claim: claim.number):
        families = list(group)
        claim = families[0]
        yield f"### {claim.number}. {claim.title}"
        yield f"> {claim.quote}"
        yield f"It holds if {claim.criterion}."
        found = ((one.family or "found", one.verdict, one.sentence) for one in families)
        yield "\n".join(f"- {family}: **{verdict}**. {text}" for family, verdict, text in found)
