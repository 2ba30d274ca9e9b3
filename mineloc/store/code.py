"""Which code a result depends on: the modules that an entry point imports, directly or through others.

Found by reading the sources, not by importing them: nothing heavy is loaded, imports inside functions count, and so
do modules that are named in text (`"mineloc.x.y:function"`), as registries do. Data files that lie in the packages
(templates, plans) count like sources; of other libraries their versions do.
"""

from __future__ import annotations

import ast
import re
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from pathlib import Path

from mineloc.store.digest import canonical_json, sha256_of_file, sha256_of_text

# Libraries that are not installed under the name by which they are imported; others are looked up, slowly.
_DISTRIBUTIONS = {"rerun": "rerun-sdk"}
_PARSING = threading.Lock()


@dataclass(frozen=True, slots=True)
class Closure:
    """What an entry point needs.

    Attributes:
        files: sources and data files, by path relative to the package's parent folder.
        libraries: top-level names of the imported libraries, the standard library left out.
    """

    files: dict[str, Path]
    libraries: frozenset[str]


class SourceTree:
    """The sources of one package.

    Args:
        package: its name.
        folder: where it lies.
    """

    def __init__(self, package: str, folder: Path) -> None:
        self._package = package
        self._folder = folder
        self._imports_of: dict[Path, frozenset[str]] = {}
        self._named = re.compile(rf"""(["'])({re.escape(package)}(?:\.\w+)+)(?::\w+)?\1""")

    def closure(self, module: str) -> Closure:
        """Everything that importing and running a module of the package can reach.

        Raises:
            ValueError: no such module.
        """
        if self._source(module) is None:
            raise ValueError(f"no module {module} in {self._folder}")
        files: dict[str, Path] = {}
        libraries: set[str] = set()
        seen: set[str] = set()
        waiting = [module]
        while waiting:
            name = waiting.pop()
            if name in seen:
                continue
            seen.add(name)
            source = self._source(name)
            if source is None:
                continue
            for file in (source, *_data_beside(source)):
                files[file.relative_to(self._folder.parent).as_posix()] = file
            for imported in self._read(name, source):
                if imported.split(".")[0] == self._package:
                    waiting.extend(_with_parents(imported))
                else:
                    libraries.add(imported.split(".")[0])
            waiting.extend(_with_parents(name))
        return Closure(dict(sorted(files.items())), frozenset(libraries - sys.stdlib_module_names))

    def digest(self, module: str) -> str:
        """Hex sha256 over the sources, data files and library versions that a module depends on."""
        closure = self.closure(module)
        return sha256_of_text(
            canonical_json(
                {
                    "files": {name: sha256_of_file(path) for name, path in closure.files.items()},
                    "libraries": {name: _library_version(name) for name in sorted(closure.libraries)},
                    "python": ".".join(str(part) for part in sys.version_info[:2]),
                }
            )
        )

    def _source(self, module: str) -> Path | None:
        path = self._folder.joinpath(*module.split(".")[1:])
        for candidate in (path / "__init__.py", path.with_name(path.name + ".py")):
            if candidate.is_file():
                return candidate
        return None

    def _read(self, module: str, source: Path) -> frozenset[str]:
        if source not in self._imports_of:
            package = module if source.name == "__init__.py" else module.rpartition(".")[0]
            self._imports_of[source] = frozenset(self._imports(source, package))
        return self._imports_of[source]

    def _imports(self, source: Path, package: str) -> Iterator[str]:
        content = source.read_bytes()
        for node in _statements(ast.parse(content, filename=str(source))):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                base = _absolute(node, package)
                yield base
                # `from package import module` reads like `from module import name`: take both, the wrong one is no file
                yield from (f"{base}.{alias.name}" for alias in node.names)
        for _, named in self._named.findall(content.decode()):
            yield named


def _statements(tree: ast.Module) -> Iterator[ast.AST]:
    """All of them, however deep; expressions, which are nine nodes of ten, hold no import."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        yield node
        for field in ("body", "orelse", "finalbody", "handlers", "cases"):
            waiting.extend(getattr(node, field, ()))


def _absolute(node: ast.ImportFrom, package: str) -> str:
    if not node.level:
        return node.module or ""
    parts = package.split(".")
    base = parts[: len(parts) - node.level + 1]
    return ".".join([*base, *([node.module] if node.module else [])])


def _with_parents(module: str) -> list[str]:
    parts = module.split(".")
    return [".".join(parts[: i + 1]) for i in range(len(parts))]


def _data_beside(source: Path) -> list[Path]:
    """The data files of a package: all that is no source, in its folder and in folders below that are no packages."""
    if source.name != "__init__.py":
        return []
    found: list[Path] = []
    folders = [source.parent]
    while folders:
        for path in folders.pop().iterdir():
            if path.name.startswith((".", "__pycache__")):
                continue
            if path.is_dir() and not (path / "__init__.py").exists():
                folders.append(path)
            elif path.is_file() and path.suffix not in (".py", ".pyc"):
                found.append(path)
    return sorted(found)


@lru_cache
def _library_version(name: str) -> str:
    try:
        return version(_DISTRIBUTIONS.get(name, name))
    except PackageNotFoundError:
        return ",".join(f"{d}={version(d)}" for d in sorted(set(packages_distributions().get(name, []))))


@lru_cache
def source_tree() -> SourceTree:
    """The sources of mineloc itself."""
    return SourceTree("mineloc", Path(__file__).parent.parent)


def code_digest(module: str) -> str:
    """The digest of a mineloc module's closure; constant while the process lives, as its code is."""
    # Parsing in two threads at once is an internal error of Python before 3.11.5 (SystemError, cpython 106905).
    with _PARSING:
        return _code_digest(module)


@lru_cache
def _code_digest(module: str) -> str:
    return source_tree().digest(module)
