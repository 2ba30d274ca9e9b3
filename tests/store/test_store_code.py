"""Which changes of the program make a result old, and which do not."""

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from mineloc.store.code import SourceTree, code_digest, source_tree

SOURCES = {
    "__init__.py": "",
    "stage.py": "from pkg import middle\nfrom .late import x\n\ndef f():\n    from pkg.inside import g\n    return g\n",
    "middle.py": "import pkg.deep.leaf as leaf\nimport numpy\n",
    "late.py": "x = 1\n",
    "inside.py": "g = 2\n",
    "deep/__init__.py": "",
    "deep/leaf.py": "from ..registry import NAMES\n",
    "registry.py": "NAMES = {'m': 'pkg.methods.one:run', 'about': 'pkg.nothing is here'}\n",
    "methods/__init__.py": "",
    "methods/one.py": "def run(): pass\n",
    "methods/plan.toml": "width_m = 3\n",
    "methods/templates/page.html": "<p>",
    "view.py": "import rerun\nfrom pkg import stage\n",
    "unrelated/__init__.py": "",
    "unrelated/data.toml": "",
}
NEEDED = ["stage.py", "middle.py", "late.py", "inside.py", "deep/leaf.py", "deep/__init__.py", "registry.py"]
NEEDED += ["__init__.py", "methods/one.py", "methods/plan.toml", "methods/templates/page.html"]


@pytest.fixture
def folder(tmp_path):
    for name, text in SOURCES.items():
        path = tmp_path / "pkg" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path / "pkg"


def digest(folder: Path) -> str:
    return SourceTree("pkg", folder).digest("pkg.stage")


def test_the_closure_holds_what_is_reached_and_nothing_else(folder):
    closure = SourceTree("pkg", folder).closure("pkg.stage")
    assert sorted(closure.files) == sorted(f"pkg/{name}" for name in [*NEEDED, "methods/__init__.py"])
    assert closure.libraries == {"numpy"}


@pytest.mark.parametrize("name", NEEDED)
def test_a_change_in_anything_that_is_reached_changes_the_digest(folder, name):
    before = digest(folder)
    (folder / name).write_text((folder / name).read_text() + "\n# a word\n")
    assert digest(folder) != before


@pytest.mark.parametrize("name", ["view.py", "unrelated/__init__.py", "unrelated/data.toml"])
def test_a_change_elsewhere_does_not(folder, name):
    before = digest(folder)
    (folder / name).write_text("x = 2\n")
    assert digest(folder) == before


def test_another_version_of_an_imported_library_changes_the_digest(folder, monkeypatch):
    before = digest(folder)
    monkeypatch.setattr("mineloc.store.code._library_version", lambda name: f"{name} 99")
    assert digest(folder) != before


def test_where_the_sources_lie_and_the_hash_seed_change_nothing(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "elsewhere" / "pkg")
    program = (
        "import sys; from pathlib import Path; from mineloc.store.code import SourceTree;"
        "from mineloc.store.record import Action;"
        "d = SourceTree('pkg', Path(sys.argv[1])).digest('pkg.stage');"
        "print(d, Action(stage='s', schema=1, code=d, arguments={'b': 1, 'a': [1.5]}, config={}, inputs={}).key)"
    )
    said = {
        subprocess.run(
            [sys.executable, "-c", program, str(where)],
            env=os.environ | {"PYTHONHASHSEED": seed},
            cwd=cwd,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed, where, cwd in (("1", folder, tmp_path), ("2", tmp_path / "elsewhere" / "pkg", folder))
    }
    assert len(said) == 1
    assert digest(folder) in said.pop()


def test_an_unknown_module_is_a_mistake_of_the_caller(folder):
    with pytest.raises(ValueError, match=r"no module pkg\.nowhere"):
        SourceTree("pkg", folder).closure("pkg.nowhere")


def test_stages_do_not_depend_on_how_results_are_looked_at():
    files = source_tree().closure("mineloc.stages.evaluate").files
    assert "mineloc/metrics/absolute.py" in files
    assert not [name for name in files if name.startswith(("mineloc/view", "mineloc/report", "mineloc/survey"))]
    assert len(code_digest("mineloc.stages.evaluate")) == hashlib.sha256().digest_size * 2
