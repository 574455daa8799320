"""The files of a study; its page is one HTML file, claims first, that loads nothing."""

import base64
import itertools
import json
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from string import Template

from contactgraph.cli.output import provenance, write_json, write_text
from contactgraph.viz.metric_table import short
from contactgraph_studies.bootstrap import Verdict
from contactgraph_studies.job import JobRecords
from contactgraph_studies.results import with_range
from contactgraph_studies.runner import Failure
from contactgraph_studies.study import Claim, ClaimMetric, Picture, Study, StudyResult

_CLASSES = {Verdict.HOLDS: "met", Verdict.FAILS: "missed"}


def write_study(
    study: Study, folder: Path, command: str, failures: Sequence[Failure], cores: int
) -> None:
    """Write claims, tables, figures and the page from the outputs in the folder.

    Prints the claims and the first table.
    """
    result, origin = study.result(folder), provenance()
    costs = JobRecords(folder, version("contactgraph")).costs(study.jobs)
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
    made = (
        f"{date}; {len(costs)} of {len(study.jobs)} jobs done, {short(hours)} h, {cores} at a time"
    )
    page = study_page(result, failed, commands, origin["versions"], made)
    write_text(folder / "index.html", page)
    for claim in result.claims:
        about = f"{claim.family}, " if claim.family else ""
        print(f"{claim.number}. {about}{claim.verdict}: {claim.title}")
        print(f"   {claim.sentence}")
    print(result.tables[0].markdown())
    print(f"the page: {folder / 'index.html'}")


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


def study_page(
    result: StudyResult,
    failures: Sequence[tuple[str, str]],
    commands: Sequence[str],
    versions: Mapping[str, str],
    made: str,
) -> str:
    """The page as text; ``failures`` are commands and reasons."""
    own, shared = files("contactgraph_studies") / "assets", files("contactgraph.viz") / "assets"
    styles = (shared / "page.css", own / "study.css")
    return Template((own / "study.html").read_text(encoding="utf-8")).substitute(
        title=escape(result.title),
        summary=escape(result.summary),
        style="".join(style.read_text(encoding="utf-8") for style in styles),
        claims=_section("claims", "What the paper claims", _claims(result.claims)),
        failures=_failures(failures),
        figures=_section("figures", "Figures", map(_picture, result.figures)),
        tables="".join(table.html() for table in result.tables),
        scenes=_section("scenes", "Scenes", map(_picture, result.scenes)),
        commands="\n".join(escape(command) for command in commands),
        versions=", ".join(f"{escape(name)} {escape(v)}" for name, v in versions.items()),
        made=escape(made),
    )


def _section(slug: str, heading: str, parts: Iterable[str]) -> str:
    """Nothing if there are no parts."""
    inside = "".join(parts)
    return f'<section id="{slug}"><h2>{heading}</h2>\n{inside}\n</section>\n' if inside else ""


def _claims(claims: Sequence[Claim]) -> Iterator[str]:
    """Each claim once, with what is found of every family of models."""
    for _, group in itertools.groupby(claims, key=lambda claim: claim.number):
        families = list(group)
        claim = families[0]
        verdicts = "".join(_verdict(one) for one in families)
        found = "".join(f"<p><b>{one.family}</b> {escape(one.sentence)}</p>" for one in families)
        rows = "".join(_claim_row(one, number) for one in families for number in one.metrics)
        yield (
            f'<article class="claim"><div>{verdicts}</div><div>'
            f"<h3>{claim.number}. {escape(claim.title)}</h3>"
            f"<blockquote>{escape(claim.quote)}</blockquote>"
            f'<p class="caption">It holds if {escape(claim.criterion)}.</p>{found}'
            "<details><summary>Numbers</summary>"
            '<div class="wide"><table class="plain"><thead><tr><th>Models</th><th>Task</th>'
            "<th>What</th><th>Median (range over trainings)</th><th>95 %</th><th>Command</th></tr>"
            f"</thead><tbody>{rows}</tbody></table></div></details></div></article>"
        )


def _verdict(claim: Claim) -> str:
    verdict = f'<p class="verdict {_CLASSES.get(claim.verdict, "")}">{claim.verdict}'
    return f'{verdict}<span class="caption"> {escape(claim.family)}</span></p>'


def _claim_row(claim: Claim, number: ClaimMetric) -> str:
    interval = "" if number.interval is None else " to ".join(map(short, number.interval))
    return (
        f"<tr><td>{escape(claim.family)}</td>"
        f"<td>{escape(number.task)}</td><td>{escape(number.name)}</td>"
        f'<td class="figure">{escape(with_range(number.statistic, number.statistic.unit))}</td>'
        f'<td class="figure">{interval}</td>'
        f"<td><code>{escape(number.statistic.command)}</code></td></tr>"
    )


def _failures(failures: Sequence[tuple[str, str]]) -> str:
    if not failures:
        return ""
    items = "".join(
        f"<li><code>{escape(command)}</code> {escape(reason)}</li>" for command, reason in failures
    )
    return (
        "<section><h2>Failed measurements</h2><details>"
        f'<summary>{len(failures)} commands failed</summary><ul class="plain">{items}</ul>'
        "</details></section>"
    )


def _picture(picture: Picture) -> str:
    data = base64.b64encode(picture.image).decode("ascii")
    return (
        f"<figure><h3>{escape(picture.title)}</h3>"
        f'<img alt="{escape(picture.title)}" src="data:image/{picture.media_type};base64,{data}">'
        f'<figcaption class="caption">{escape(picture.caption)}</figcaption></figure>'
    )
