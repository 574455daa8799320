"""Writes the pages of the documentation site to `build/pages`; zensical makes the site of them.

Usage: python docs/site_pages.py

The folder mirrors the repository, so that a link leads to the same place on a Git host and on the
site. Examples become pages with their text, code and pictures. The pages of the reference name the
public names of a package, which mkdocstrings describes by their docstrings.
"""

import ast
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = ROOT / "build" / "pages"
LIBRARY = (
    *(
        "data",
        "model",
        "large_scenes",
        "identify",
        "train",
        "control",
        "envs",
        "policies",
        "evaluate",
        "viz",
        "plot",
        "play",
        "interchange",
    ),
    "parallel",
)
ARM = ("safety", "loop", "perception", "sim")
PACKAGES = (
    "contactgraph",
    *(f"contactgraph.{each}" for each in LIBRARY),
    *(f"contactgraph_franka.{each}" for each in ARM),
)
PICTURES = {
    "04_contact_graph": ("contact_graph.png", "The picture that this example writes"),
    "07_learn_cost": ("../results/figures/cost-pickup.png", "Q and R learned in the study"),
}
LINK = re.compile(r"\]\(([^)\s#]+)")
EXAMPLE = re.compile(r"(\]\((?:\.\./)?examples)(?:/(\w+)\.py)?\)")


def write_page(path: str | Path, *parts: str) -> None:
    """Writes a page, and copies the figures and tables to which it links."""
    text = "\n\n".join(parts) + "\n"
    for link in LINK.findall(text):
        linked = (ROOT / path).parent.joinpath(link).resolve()
        if linked.is_file() and (linked.suffix not in (".md", ".py") or "results" in linked.parts):
            copy(linked.relative_to(ROOT))
    target = PAGES / path
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(
        EXAMPLE.sub(lambda found: f"{found[1]}/{found[2] or 'index'}.md)", text), "utf-8"
    )


def copy(path: Path) -> None:
    """Copies a file of the repository to its place among the pages."""
    if path.suffix == ".md":
        text = (ROOT / path).read_text("utf-8")
        write_page(path, *(() if text.startswith("# ") else (f"# {path}",)), text)
    else:
        (PAGES / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / path, PAGES / path)


def write_examples() -> None:
    """A page for every example, and one that lists them."""
    listed = []
    for example in sorted((ROOT / "examples").glob("*.py")):
        name, source = example.stem, example.read_text("utf-8")
        tree = ast.parse(source)
        title, _, text = (ast.get_docstring(tree) or "").partition("\n")
        code = "\n".join(source.splitlines()[tree.body[0].end_lineno :]).strip()
        text = re.sub(r"(python examples/.+|contactgraph collect .+)", r"`\1`", text.strip())
        parts = [f"# {name.replace('_', ' ')}", title, text]
        if name in PICTURES:
            picture, caption = PICTURES[name]
            parts.append(f"![{caption}]({picture})\n\n*{caption}.*")
            if "/" not in picture:
                subprocess.run(
                    [sys.executable, example, PAGES / "examples"],
                    check=True,
                    stdout=subprocess.DEVNULL,
                )
        write_page(f"examples/{name}.md", *filter(None, parts), f"```python\n{code}\n```")
        listed.append(f"- [{name.replace('_', ' ')}]({name}.md): {title}")
    write_page("examples/index.md", "# Examples", "\n".join(listed))


def exported(package: str) -> tuple[str, dict[str, str]]:
    """A package's text, and its names, or those that a module defines, with where each is made."""
    file = ROOT / "src" / Path(*package.split("."))
    file = file / "__init__.py" if file.is_dir() else file.with_suffix(".py")
    tree = ast.parse(file.read_text("utf-8"))
    own = [each.name for each in tree.body if isinstance(each, ast.ClassDef | ast.FunctionDef)]
    names = {name: f"{package}.{name}" for name in own if not name.startswith("_")}
    for each in ast.walk(tree):
        if isinstance(each, ast.ImportFrom) and each.module:
            inner = ROOT / "src" / Path(*each.module.split("."))
            made = exported(each.module)[1] if inner.is_dir() and each.module != package else {}
            for name in each.names:
                if name.asname:
                    names[name.asname] = made.get(name.name, f"{each.module}.{name.name}")
    return ast.get_docstring(tree) or "", names


def write_reference() -> None:
    """A page for every package, and one that lists the packages."""
    rows = ["| package | content |", "|---|---|"]
    for package in PACKAGES:
        text, names = exported(package)
        entries = [
            f"::: {made}\n    options:\n      heading: {name}\n      toc_label: {name}"
            for name, made in names.items()
        ]
        write_page(f"reference/{package}.md", f"# {package}", text, *entries)
        content = text.partition("\n\n")[0].replace("\n", " ")
        rows.append(f"| [{package}]({package}.md) | {content} |")
    write_page("reference/index.md", "# Reference", "\n".join(rows))


if __name__ == "__main__":
    for each in (PAGES, PAGES.with_name("site")):
        shutil.rmtree(each, ignore_errors=True)
    (PAGES / "examples").mkdir(parents=True)
    assets = filter(Path.is_file, ROOT.glob("docs/assets/**/*"))
    for each in (*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *assets):
        copy(each.relative_to(ROOT))
    write_examples()
    write_reference()
