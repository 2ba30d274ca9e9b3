"""What the store and the planners know of a stage, and how a stage runs on given inputs.

A stage is a plain function: paths and configuration in, one file or folder out. It is named, not imported, so that
planning and finding a known result load nothing heavy.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias, cast

from mineloc.config import Config
from mineloc.errors import MinelocError, StoreError
from mineloc.progress import Progress, quiet
from mineloc.store.code import code_digest
from mineloc.store.digest import Json
from mineloc.store.objects import Ref
from mineloc.store.record import Action
from mineloc.store.store import Outcome, Store


@dataclass(frozen=True, slots=True)
class Stage:
    """One kind of work.

    Attributes:
        name: of the stage.
        schema: version of what it writes; raised when the meaning of its output changes outside the code's closure.
        entry: `module:function`, called with the inputs and arguments by name, with `out=`, `config=`, and with
            `progress=` if it takes that.
        sections: the configuration sections that it reads; it sees the defaults in place of all others.
        inside: if it writes several files: the one that it is given as `out`; the folder around is the output.
        volatile: files of its output folder that differ from run to run (timings) and are no part of its identity.
    """

    name: str
    schema: int
    entry: str
    sections: tuple[str, ...] = ()
    inside: str = ""
    volatile: frozenset[str] = frozenset()

    @property
    def module(self) -> str:
        """The module of the entry."""
        return self.entry.partition(":")[0]

    def function(self) -> Callable[..., object]:
        """The entry itself, imported now."""
        return cast("Callable[..., object]", getattr(importlib.import_module(self.module), self.entry.split(":")[1]))


@dataclass(frozen=True, slots=True)
class Input:
    """A file or folder that a stage reads.

    Attributes:
        path: where the user finds it; its name is what the stage sees.
        ref: its content.
        is_source: it is read at `path`, outside the store; else from the store.
    """

    path: Path
    ref: Ref
    is_source: bool


Inputs: TypeAlias = Mapping[str, Input | tuple[Input, ...]]


@dataclass(frozen=True)
class Job:
    """A stage on given inputs.

    Attributes:
        stage: what to do.
        out_name: file or folder name of the result.
        inputs: by parameter name; a tuple becomes a list of paths.
        arguments: further parameters, JSON values.
        config: the whole configuration, of which the stage sees its sections.
    """

    stage: Stage
    out_name: str
    inputs: Inputs
    arguments: Mapping[str, Json] = field(default_factory=dict)
    config: Config = field(default_factory=Config)

    def action(self) -> Action:
        """Everything that the result depends on, for the store."""
        return Action(
            stage=self.stage.name,
            schema=self.stage.schema,
            code=code_digest(self.stage.module),
            arguments={**self.arguments, "out": self.out_name},
            config={name: getattr(self.config, name).model_dump(mode="json") for name in sorted(self.stage.sections)},
            inputs={
                name: tuple((one.path.name, one.ref.digest) for one in _group(given))
                for name, given in self.inputs.items()
            },
        )

    def lookup(self, store: Store) -> Outcome | None:
        """The known result, None if the stage must run."""
        return store.lookup(self.action())

    def run(self, store: Store, *, progress: Progress = quiet, waiting: Callable[[], None] | None = None) -> Outcome:
        """The result, known or made now in this process.

        Raises:
            MinelocError: what the stage says; with the paths under which the user knows the inputs.
            StoreError: an input is gone or damaged, or a source changed while it was read.
            OutputError: the store cannot be written.
        """
        return store.run(
            self.action(),
            lambda workspace: self._execute(store, workspace, progress),
            volatile=self.stage.volatile,
            waiting=waiting,
        )

    def _execute(self, store: Store, workspace: Path, progress: Progress) -> Path:
        shown: dict[str, str] = {}
        paths = {
            name: [
                one.path if one.is_source else _expose(store, one, workspace / "in" / f"{name}-{i}", shown)
                for i, one in enumerate(_group(given))
            ]
            for name, given in self.inputs.items()
        }
        result = workspace / "out" / self.out_name
        out = result / self.stage.inside if self.stage.inside else result
        out.parent.mkdir(parents=True)
        function = self.stage.function()
        listening = {"progress": progress} if "progress" in inspect.signature(function).parameters else {}
        try:
            function(
                **{name: many if isinstance(self.inputs[name], tuple) else many[0] for name, many in paths.items()},
                **self.arguments,
                out=out,
                config=Config(**{name: getattr(self.config, name) for name in self.stage.sections}),
                **listening,
            )
        except MinelocError as error:
            raise _retold(error, shown) from error
        for one in (one for given in self.inputs.values() for one in _group(given)):
            if one.is_source and store.source(one.path).digest != one.ref.digest:
                raise StoreError(one.path, "changed while it was read", todo="run again when it is complete")
        return result


def _group(given: Input | tuple[Input, ...]) -> tuple[Input, ...]:
    return given if isinstance(given, tuple) else (given,)


def _expose(store: Store, one: Input, folder: Path, shown: dict[str, str]) -> Path:
    folder.mkdir(parents=True)
    path = store.objects.expose(one.ref, folder / one.path.name)
    shown[str(path)] = str(one.path)
    return path


def _retold(error: MinelocError, shown: Mapping[str, str]) -> MinelocError:
    """The same error about the paths that the user knows instead of those of the workspace."""

    def told(text: str) -> str:
        for inside, outside in shown.items():
            text = text.replace(inside, outside)
        return text

    kind: Any = type(error)
    return kind(told(error.where), told(error.found), expected=told(error.expected), todo=told(error.todo))
