"""The study as one page that opens from disk: claims first, then what they rest on."""

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from string import Template

from contactgraph.viz.markup import numbers_table
from contactgraph_studies.claim import Claim, ClaimNumber
from contactgraph_studies.findings import Findings, Picture
from contactgraph_studies.page_table import table_section
from contactgraph_studies.words import with_range

_VERDICT = {True: ("holds", "met"), False: ("does not hold", "missed"), None: ("not known", "")}


@dataclass(frozen=True)
class StudyPage:
    """Everything on the page."""

    findings: Findings
    failures: Sequence[tuple[str, str]]
    """Commands that failed, and why."""
    commands: Sequence[str]
    versions: Mapping[str, str]
    date: str


def study_page(data: StudyPage) -> str:
    """The page as text; it loads nothing."""
    found = data.findings
    return Template(_asset("study.html")).substitute(
        title=escape(found.title),
        summary=escape(found.summary),
        style=_asset("page.css") + _asset("study.css"),
        claims=_section("claims", "What the paper claims", map(_claim, found.claims)),
        failures=_failures(data.failures),
        figures=_section("figures", "Figures", map(_picture, found.figures)),
        asked=escape(found.asked),
        targets=numbers_table(tuple(found.targets)),
        tables="".join(table_section(table) for table in found.tables),
        scenes=_section("scenes", "Scenes", map(_picture, found.scenes)),
        commands="\n".join(escape(command) for command in data.commands),
        versions=", ".join(f"{escape(name)} {escape(v)}" for name, v in data.versions.items()),
        date=escape(data.date),
    )


def _section(slug: str, heading: str, parts: Iterable[str]) -> str:
    """Nothing where there are no parts."""
    inside = "".join(parts)
    return f'<section id="{slug}"><h2>{heading}</h2>\n{inside}\n</section>\n' if inside else ""


def _asset(name: str) -> str:
    return (files("contactgraph.viz") / "assets" / name).read_text(encoding="utf-8")


def _claim(claim: Claim) -> str:
    word, kind = _VERDICT[claim.holds]
    rows = "".join(_claim_row(number) for number in claim.numbers)
    return (
        f'<article class="claim"><p class="verdict {kind}">{word}</p><div>'
        f"<h3>{claim.number}. {escape(claim.title)}</h3>"
        f"<blockquote>{escape(claim.quote)}</blockquote>"
        f"<p>{escape(claim.sentence)}</p>"
        f'<details><summary>Numbers</summary><p class="caption">It holds if '
        f"{escape(claim.criterion)}.</p>"
        '<div class="wide"><table class="plain"><thead><tr><th>Task</th><th>What</th>'
        "<th>Median (range over seeds)</th><th>Command</th></tr></thead>"
        f"<tbody>{rows}</tbody></table></div></details></div></article>"
    )


def _claim_row(number: ClaimNumber) -> str:
    return (
        f"<tr><td>{escape(number.task)}</td><td>{escape(number.name)}</td>"
        f'<td class="figure">{escape(with_range(number.figure, number.unit))}</td>'
        f"<td><code>{escape(number.figure.command)}</code></td></tr>"
    )


def _failures(failures: Sequence[tuple[str, str]]) -> str:
    if not failures:
        return ""
    items = "".join(
        f"<li><code>{escape(command)}</code> {escape(reason)}</li>" for command, reason in failures
    )
    return (
        "<section><h2>What could not be measured</h2><details>"
        f'<summary>{len(failures)} commands failed</summary><ul class="plain">{items}</ul>'
        "</details></section>"
    )


def _picture(picture: Picture) -> str:
    data = base64.b64encode(picture.image).decode("ascii")
    return (
        f"<figure><h3>{escape(picture.title)}</h3>"
        f'<img alt="{escape(picture.title)}" src="data:image/{picture.kind};base64,{data}">'
        f'<figcaption class="caption">{escape(picture.caption)}</figcaption></figure>'
    )
