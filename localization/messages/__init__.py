"""Sentences about a log, its sensors and a robot, as data: a table for each subject beside this module, and the one function that fills
them in. The terminal, reports, `metrics.json`, diagnostics and `docs/warnings.md` have them from here.

A table `SUBJECT.toml` begins with `title`, `cause` and `cure` for the documentation. Each further table is a message:

    [no_data]
    text = "no wheel data for {total_s:.1f} s in all: motion there is predicted with a wide covariance."
    remedy = "Publish the wheels without pauses."

A message with a remedy is a warning. One without is a note: it states what was chosen or left out, and nothing has to be done. `[phrases]`
are parts of sentences, which fields of messages take.
"""

from __future__ import annotations

import functools
import math
import tomllib
from collections.abc import Mapping
from importlib.resources import files
from typing import Any, NamedTuple

Value = float | int | str


class Template(NamedTuple):
    """A message before its fields have values, as format strings."""

    text: str
    """What happened, and where."""
    remedy: str = ""
    """What to do; empty for a note."""


class Subject(NamedTuple):
    """The messages of one table."""

    title: str
    cause: str
    cure: str
    templates: Mapping[str, Template]
    """By name, in the order of the file."""
    phrases: Mapping[str, str]
    """Parts of sentences by name, as format strings."""


class Message(str):
    """A sentence for people, which programs can tell from others by its `id`."""

    id: str
    """Subject and name, as "wheel_gaps.no_data"."""
    body: str
    """The sentence without what it is about and when that began, which come first."""
    remedy: str
    """The part with what to do; empty for a note."""
    values: Mapping[str, Value]
    """The numbers and names in it, by field."""
    source: str
    """What it is about, as "ekf (skid_steer)"; empty where that is the log."""
    at_s: float | None
    """Begin of what it reports, since the first step [s]; None for the whole log."""

    def __new__(
        cls,
        id: str,
        body: str,
        remedy: str = "",
        values: Mapping[str, Value] | None = None,
        source: str = "",
        at_s: float | None = None,
    ) -> Message:
        """The sentence ``body`` about ``source`` from ``at_s`` on, if these are given."""
        begin = "" if at_s is None else f"at t = {at_s:.1f} s: "
        found = super().__new__(cls, f"{source}: {begin}{body}" if source else f"{begin}{body}")
        found.id, found.body, found.remedy, found.values, found.source, found.at_s = id, body, remedy, values or {}, source, at_s
        return found

    def __getnewargs__(self) -> tuple[Any, ...]:
        """What a copy is made of."""
        return self.id, self.body, self.remedy, self.values, self.source, self.at_s

    @property
    def is_warning(self) -> bool:
        """Whether there is something to do about it."""
        return bool(self.remedy)

    @property
    def statement(self) -> str:
        """The sentence without its remedy."""
        return self.removesuffix(f" {self.remedy}") if self.remedy else str(self)

    def of(self, source: str) -> Message:
        """The sentence about ``source``, which it names first."""
        return Message(self.id, self.body, self.remedy, self.values, source, self.at_s)

    def at(self, at_s: float) -> Message:
        """The sentence of what began at the time ``at_s`` [s], which it names first."""
        return Message(self.id, self.body, self.remedy, self.values, self.source, at_s)

    def but(self, **values: Value) -> Message:
        """This message with other ``values`` in those of its fields."""
        changed = {name: values.get(name, value) for name, value in self.values.items()}
        found = message(self.id, **changed)
        return Message(found.id, found.body, found.remedy, found.values, self.source, self.at_s)

    def as_json(self) -> dict[str, Any]:
        """Its parts as JSON holds them."""
        values = {name: None if isinstance(value, float) and not math.isfinite(value) else value for name, value in self.values.items()}
        return {"id": self.id, "is_warning": self.is_warning, "source": self.source, "at_s": self.at_s, "values": values, "text": self}


@functools.cache
def subject(name: str) -> Subject:
    """The table ``name``. Raises `KeyError` where there is none."""
    try:
        table = tomllib.loads(files("localization.messages").joinpath(f"{name}.toml").read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise KeyError(f"no table of messages has the name {name}") from None
    heads = {key: table.pop(key, "") for key in ("title", "cause", "cure")}
    phrases = table.pop("phrases", {})
    return Subject(**heads, templates={key: Template(**fields) for key, fields in table.items()}, phrases=phrases)


def message(id: str, /, **values: Value) -> Message:
    """The message ``id``, as "wheel_gaps.no_data", with ``values`` in its fields. Raises `KeyError` where it or a value is missing.

    >>> print(message("wheel_gaps.no_data", total_s=3.21))
    no wheel data for 3.2 s in all: motion there is predicted with a wide covariance.
    """
    table, _, name = id.partition(".")
    template = subject(table).templates[name]
    values = {key: _plain(value) for key, value in values.items()}
    text, remedy = template.text.format(**values), template.remedy.format(**values)
    return Message(id, f"{text} {remedy}" if remedy else text, remedy, values)


def phrase(id: str, /, **values: Value) -> str:
    """The part ``id`` of a sentence, with ``values`` in its fields."""
    table, _, name = id.partition(".")
    return subject(table).phrases[name].format(**{key: _plain(value) for key, value in values.items()})


def _plain(value: Value) -> Value:
    """A number as Python has it, and text without bytes that are none."""
    if isinstance(value, str):
        return value.encode("utf-8", errors="backslashreplace").decode()
    item = getattr(value, "item", None)
    return value if item is None else item()
