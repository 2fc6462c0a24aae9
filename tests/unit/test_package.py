"""The package's front door."""

import tomllib
from pathlib import Path

import herglotz as hz

ROOT = Path(__file__).resolve().parents[2]


def test_every_public_name_resolves_again_and_again():
    # fails if a lazily loaded name is shadowed by a room of the same name after its first use
    import herglotz.verify  # noqa: F401  a room, imported as a user would

    for _ in range(2):
        for name in hz.__all__:
            value = getattr(hz, name)
            assert callable(value), name


def test_completion_offers_the_public_names():  # fails if dir(hz) lacks hz.fit before its first use, or offers helpers
    assert set(hz.__all__) <= set(dir(hz))
    assert not {"Any", "TYPE_CHECKING", "import_module"} & set(dir(hz))


def test_the_version_stands_in_one_place():
    # fails if the version is written into pyproject.toml too, where it could differ; test_face.py has CITATION.cff
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert "version" not in project["project"]
    assert project["tool"]["hatch"]["version"]["path"] == "src/herglotz/__init__.py"
    assert f"## {hz.__version__}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_the_package_says_that_it_is_typed():
    # fails if type checkers would ignore our annotations (PEP 561)
    assert (ROOT / "src" / "herglotz" / "py.typed").exists()
