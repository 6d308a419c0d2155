"""A simulator's XML file (MJCF, SDF, URDF) as text: elements with their places, so that single numbers change and all other bytes stay.

Writers of the engines (`MjSpec.to_xml`) lose comments, defaults and the order of attributes. Here an attribute is replaced inside the
bytes of its start tag, and an element's content between its tags. Format of MJCF: https://mujoco.readthedocs.io/en/stable/XMLreference.html.
"""

from __future__ import annotations

import re
import xml.parsers.expat
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from localization.errors import SimulationError
from motion_models.input_files import read_bytes

ROOTS = ("mujoco", "sdf", "robot")
"""Root elements of MJCF, SDF and URDF."""
_ATTRIBUTE = re.compile(rb"""([\w:.-]+)(\s*=\s*)("[^"]*"|'[^']*')""")


@dataclass(eq=False)
class Element:
    """An element of the file."""

    tag: str
    attributes: Mapping[str, str]
    start: int
    """Offset of its start tag [bytes]."""
    end: int
    """Offset after its start tag."""
    file: str
    """Name of the file that it is in."""
    close: int = 0
    """Offset of its end tag; that after its start tag where it has none."""
    parent: Element | None = None
    children: list[Element] = field(default_factory=list)

    def walk(self) -> Iterator[Element]:
        """This element and all below it, in the file's order."""
        yield self
        for child in self.children:
            yield from child.walk()

    def own(self, *tags: str) -> list[Element]:
        """Children with one of ``tags``."""
        return [child for child in self.children if child.tag in tags]


@dataclass(frozen=True)
class Change:
    """Attributes of an element, or a new element below it."""

    element: Element
    attributes: Mapping[str, str | None]
    """None for one that is taken away."""
    new_tag: str = ""
    """Tag of a new child with these attributes; "" where those of the element itself change."""
    text: str = ""
    """New children as text after its start tag, in place of attributes."""
    content: str | None = None
    """What is between its tags, in place of attributes."""


@dataclass(frozen=True)
class XmlFile:
    """A simulator's file with those that it includes, as bytes by name; the first is the file itself."""

    path: Path
    """Where it is, for messages and for meshes beside it."""
    files: Mapping[str, bytes]
    root: Element
    """<mujoco>, <sdf> or <robot>, with the contents of included files in it."""

    @property
    def name(self) -> str:
        """Name of the file itself."""
        return next(iter(self.files))

    def content(self, element: Element) -> str:
        """Text between the tags of ``element``."""
        return self.files[element.file][element.end : element.close].decode("utf-8", errors="replace").strip()

    def elements(self, *tags: str) -> list[Element]:
        """All elements with one of ``tags``, but for those in defaults."""
        return [e for e in self.root.walk() if e.tag in tags and not _is_default(e)]

    def named(self, tag: str, name: str) -> Element | None:
        """The element ``tag`` with this ``name``."""
        return next((e for e in self.elements(tag) if e.attributes.get("name") == name), None)

    def changed(self, changes: Sequence[Change]) -> XmlFile:
        """These files with ``changes``; all other bytes are the same."""
        merged: dict[tuple[Element, str], dict[str, str | None]] = {}
        for change in (c for c in changes if not c.text and c.content is None):
            merged.setdefault((change.element, change.new_tag), {}).update(change.attributes)
        edits: dict[str, list[tuple[int, int, bytes]]] = {}
        for change in changes:
            if change.text or change.content is not None:
                edits.setdefault(change.element.file, []).append(self._filled(change.element, change.text, change.content))
        for (element, new_tag), attributes in merged.items():
            edits.setdefault(element.file, []).append(self._edit(element, new_tag, attributes))
        files = dict(self.files)
        for name, of_file in edits.items():
            data = files[name]
            for start, end, text in sorted(of_file, key=lambda edit: edit[:2], reverse=True):
                data = data[:start] + text + data[end:]
            files[name] = data
        return parse(files, self.path, self.root.tag)

    def _filled(self, element: Element, text: str, content: str | None) -> tuple[int, int, bytes]:
        """Offsets of the bytes that are replaced by new children or another content, and by what."""
        inner = (text if content is None else content).encode()
        if self.files[element.file][element.start : element.end].endswith(b"/>"):
            tag = self.files[element.file][element.start : element.end - 2].rstrip()
            return element.start, element.end, tag + b">" + inner + f"</{element.tag}>".encode()
        return element.end, element.end if content is None else element.close, inner

    def _edit(self, element: Element, new_tag: str, attributes: Mapping[str, str | None]) -> tuple[int, int, bytes]:
        """Offsets of the bytes that are replaced, and by what."""
        tag = self.files[element.file][element.start : element.end]
        if new_tag:
            written = (_written(name, value) for name, value in attributes.items() if value is not None)
            inner = f"<{new_tag} {' '.join(written)}/>".encode()
            if tag.endswith(b"/>"):
                return element.start, element.end, tag[:-2].rstrip() + b">" + inner + f"</{element.tag}>".encode()
            return element.end, element.end, inner
        for name, value in attributes.items():
            tag = _with_attribute(tag, name, value)
        return element.start, element.end, tag

    def with_comment(self, comment: str) -> XmlFile:
        """These files with ``comment`` before the end of its first line, or first element."""
        text = f"\n<!-- {comment.replace('--', '- -')} -->\n".encode()
        at = self.root.start
        data = self.files[self.name]
        return parse({**self.files, self.name: data[:at] + text.lstrip() + data[at:]}, self.path, self.root.tag)

    def with_folders_of(self, folder: Path) -> XmlFile:
        """These files for one in another ``folder``: paths of meshes and textures start there."""
        if self.root.tag != "mujoco" or not any(
            "file" in e.attributes for e in self.elements("mesh", "texture", "hfield", "skin", "flexcomp")
        ):
            return self
        compiler = next(iter(self.root.own("compiler")), None)
        given = {} if compiler is None else compiler.attributes
        base = given.get("assetdir", "")
        moved: dict[str, str | None] = {}
        for name in ("meshdir", "texturedir"):
            old = (self.path.parent / given.get(name, base)).resolve()
            moved[name] = _relative(old, folder.resolve())
        change = Change(self.root, moved, "compiler") if compiler is None else Change(compiler, moved)
        return self.changed([change])


def load(path: Path) -> XmlFile:
    """The file at ``path``, an MJCF with its includes. Raises `SimulationError`, naming file and line."""
    files: dict[str, bytes] = {}
    _collect(path, path.parent, path.name, files)
    return parse(files, path, _parse_file(files[path.name], path.name, path).tag)


def _collect(path: Path, folder: Path, name: str, files: dict[str, bytes]) -> None:
    try:
        files[name] = read_bytes(path)
    except OSError as error:
        raise SimulationError(f"simulator '{path}' cannot be read: {error.strerror}.") from error
    for element in _parse_file(files[name], name, path).walk():
        included = element.attributes.get("file", "")
        if element.tag == "include" and included and included not in files:
            _collect(folder / included, folder, included, files)


def parse(files: Mapping[str, bytes], path: Path, tag: str = "mujoco") -> XmlFile:
    """What ``files`` are, the first of which is the main one; its root is a ``tag``. Raises `SimulationError`, naming file and line."""
    roots = {name: _parse_file(data, name, path) for name, data in files.items()}
    root = next(iter(roots.values()))
    if root.tag != tag or tag not in ROOTS:
        raise SimulationError(f"simulator '{path}' is no MJCF, SDF or URDF: its root is <{root.tag}>, and must be <{'>, <'.join(ROOTS)}>.")
    _splice(root, roots)
    return XmlFile(path, files, root)


def _splice(element: Element, roots: Mapping[str, Element]) -> None:
    """Replace each <include> below ``element`` by what its file has."""
    children: list[Element] = []
    for child in element.children:
        included = roots.get(child.attributes.get("file", "")) if child.tag == "include" else None
        children += [child] if included is None else included.children
    element.children = children
    for child in children:
        child.parent = element
        _splice(child, roots)


def _parse_file(data: bytes, name: str, path: Path) -> Element:
    parser = xml.parsers.expat.ParserCreate()
    stack: list[Element] = []
    found: list[Element] = []

    def open_element(tag: str, attributes: dict[str, str]) -> None:
        start = parser.CurrentByteIndex
        end = _tag_end(data, start)
        element = Element(tag, attributes, start, end, name, end, stack[-1] if stack else None)
        (stack[-1].children if stack else found).append(element)
        stack.append(element)

    def close_element(tag: str) -> None:
        element = stack.pop()
        element.close = max(element.end, parser.CurrentByteIndex)

    parser.StartElementHandler, parser.EndElementHandler = open_element, close_element
    try:
        parser.Parse(data, True)
    except xml.parsers.expat.ExpatError as error:
        raise SimulationError(f"simulator '{path}' is no XML: {name}, line {error.lineno}: {error}.") from error
    return found[0]


def _tag_end(data: bytes, start: int) -> int:
    """Offset after the start tag that begins at ``start``: the first > outside quotes."""
    quote = 0
    for at in range(start, len(data)):
        c = data[at]
        if quote:
            quote = 0 if c == quote else quote
        elif c in b"\"'":
            quote = c
        elif c == 0x3E:
            return at + 1
    return len(data)


def _with_attribute(tag: bytes, name: str, value: str | None) -> bytes:
    """Start ``tag`` with this attribute replaced, added at its end, or taken away."""
    for match in _ATTRIBUTE.finditer(tag):
        if match[1].decode() == name:
            if value is None:
                return tag[: match.start()].rstrip() + tag[match.end() :]
            quote = match[3][:1]
            return tag[: match.start(3)] + quote + value.encode() + quote + tag[match.end(3) :]
    if value is None:
        return tag
    end = b"/>" if tag.endswith(b"/>") else b">"
    return tag[: -len(end)].rstrip() + b" " + _written(name, value).encode() + end


def _written(name: str, value: str) -> str:
    return f'{name}="{value}"'


def _is_default(element: Element) -> bool:
    parent = element.parent
    while parent is not None:
        if parent.tag == "default":
            return True
        parent = parent.parent
    return False


def _relative(target: Path, folder: Path) -> str:
    """Path of ``target`` from ``folder``."""
    common = [a for a, b in zip(target.parts, folder.parts, strict=False) if a == b]
    up = [".."] * (len(folder.parts) - len(common))
    return "/".join([*up, *target.parts[len(common) :]]) or "."
