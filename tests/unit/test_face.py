"""What a visitor meets: the paper, the citation, the workflow, the start page, and what the benchmarks keep."""

import re
import tomllib
from pathlib import Path

import herglotz

ROOT = Path(__file__).resolve().parents[2]


def text(name):
    return (ROOT / name).read_text(encoding="utf-8")


def test_the_citation_is_of_this_version():  # fails if a release leaves the version behind, or the date out
    cited = dict(re.findall(r"^(version|date-released): (\S+)$", text("CITATION.cff"), re.M))
    assert cited["version"] == herglotz.__version__
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", cited["date-released"])
    assert re.search(rf"^## {re.escape(cited['version'])}\b", text("CHANGELOG.md"), re.M)


def test_the_paper_has_its_sections_and_references():
    # fails if a section that JOSS asks for is gone, if a citation has no entry, or an entry is cited nowhere
    paper, entries = text("paper.md"), re.findall(r"^@\w+\{(\w+),", text("paper.bib"), re.M)
    asked = ["Summary", "Statement of need", "State of the field", "Software design", "Research impact statement",
             "AI usage disclosure", "References"]  # fmt: skip
    assert re.findall(r"^# (.+)$", paper, re.M) == asked
    assert sorted(set(re.findall(r"@(\w+)", paper))) == sorted(entries)
    assert re.search(r"^bibliography: paper\.bib$", paper, re.M)
    assert 250 < len(paper.split()) < 1000  # the length that JOSS asks for


def test_the_workflow_runs_the_tests():  # fails if the workflow names a target or a Python that there is not
    workflow = text(".github/workflows/test.yml")
    targets = re.findall(r"^ +- run: make (\S+)$", workflow, re.M)
    assert targets == ["test"]
    assert re.search(r"^test:", text("Makefile"), re.M)
    (versions,) = re.findall(r"python: \[(.*)\]", workflow)
    known = tomllib.loads(text("pyproject.toml"))["project"]["classifiers"]
    for version in re.findall(r'"([\d.]+)"', versions):
        assert f"Programming Language :: Python :: {version}" in known


def test_issue_templates_ask_for_what_an_answer_needs():  # fails if a form lacks a name, or asks for nothing
    forms = [p for p in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml") if p.stem != "config"]
    assert len(forms) == 3
    for form in forms:
        body = form.read_text(encoding="utf-8")
        assert re.findall(r"^(name|description|labels|body):", body, re.M) == ["name", "description", "labels", "body"]
        assert "required: true" in body


def test_the_start_page_is_read_in_two_minutes():  # fails if it grows past what a reader reads in two minutes
    assert len(text("docs/index.md").split()) <= 480  # 240 words a minute


def test_what_the_benchmarks_keep():
    # fails if stored results outgrow what a clone should carry, or a result or a benchmark supports no claim
    results = [p for p in (ROOT / "benchmarks" / "results").iterdir() if p.is_file()]
    assert sum(p.stat().st_size for p in results) <= 600_000
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "Makefile", *(ROOT / "docs").rglob("*.md")]
    claims = "\n".join(p.read_text(encoding="utf-8") for p in pages)
    for path in results:
        # tables of the judge have their commit in the name, which no page has
        shown = "judge" if path.stem.startswith("judge_") else path.stem
        assert re.search(rf"results/{shown}[._]", claims), path.name
    sources = {p: p.read_text(encoding="utf-8") for p in (ROOT / "benchmarks").rglob("*.py")}
    for path in (ROOT / "benchmarks").glob("*.py"):
        named = rf"benchmarks[/.]{path.stem}\b|import [^\n]*\b{path.stem}\b|from benchmarks\.{path.stem} "
        elsewhere = "\n".join([claims, *(body for p, body in sources.items() if p != path)])
        assert path.stem == "__init__" or re.search(named, elsewhere), path.name
