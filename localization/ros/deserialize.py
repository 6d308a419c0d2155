"""Values from what `serialize` wrote: JSON and the bytes of arrays. No code in them is run, whatever they hold."""

from __future__ import annotations

import json
import math
import sys
from array import array
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from localization.errors import CheckpointError
from localization.ros.serialize import KINDS, PACKAGES

Json = Any


def deserialize(text: bytes, blob: bytes, shared: Mapping[str, Any] | None = None) -> Any:
    """The value of `serialize`. Raises `CheckpointError` for bytes that are none of its."""
    try:
        content = json.loads(text)
        return _Reader(content, blob, shared or {}).get(content["root"])
    except CheckpointError:
        raise
    except (AttributeError, IndexError, KeyError, OverflowError, RecursionError, TypeError, UnicodeDecodeError, ValueError) as error:
        raise CheckpointError(f"it does not hold what this version writes ({type(error).__name__}: {error})") from error


class _Reader:
    def __init__(self, content: Json, blob: bytes, shared: Mapping[str, Any]) -> None:
        self._objects, self._arrays = content["objects"], content["arrays"]
        self._blob, self._shared = blob, shared
        self._made: dict[int, Any] = {}

    def get(self, code: Json) -> Any:
        if not isinstance(code, list):
            return code
        kind, *rest = code
        if kind == "o":
            return self._object(rest[0])
        if kind == "t":
            return tuple(map(self.get, rest))
        if kind == "f":
            return float(rest[0])
        if kind == "x":
            return self._shared[rest[0]]
        if kind == "n":
            return self._array(rest[0])[()]
        raise ValueError(f"unknown code {kind!r}")

    def _object(self, index: int) -> Any:
        if index not in self._made:
            self._make(index, self._objects[index])
        return self._made[index]

    def _make(self, index: int, code: Json) -> None:
        """Containers are known before they are filled, for they may hold themselves."""
        kind, *rest = code
        if kind == "c":
            self._instance(index, *rest)
        elif kind == "l":
            made: list[Any] = []
            self._made[index] = made
            made.extend(map(self.get, rest))
        elif kind == "d":
            table: dict[Any, Any] = {}
            self._made[index] = table
            table.update((self.get(k), self.get(v)) for k, v in rest)
        elif kind == "q":
            queue: deque[Any] = deque(maxlen=rest[0])
            self._made[index] = queue
            queue.extend(map(self.get, rest[1:]))
        elif kind == "p":
            self._made[index] = self._list(*rest)
        elif kind == "m":
            self._made[index] = self._array(rest[0])
        elif kind == "v":
            self._made[index] = self._view(*rest)
        elif kind == "a":
            self._made[index] = array(rest[0], self._array(rest[1]).tobytes())
        elif kind == "s":
            self._made[index] = slice(*rest)
        else:
            raise ValueError(f"unknown object {kind!r}")

    def _list(self, kind: str, *rest: Json) -> list[Any]:
        if kind != "objects":
            columns = [self._column(*column) for column in rest]
            return list(zip(*columns, strict=True)) if kind == "rows" else columns[0]
        module, name, names, *coded = rest
        found, made = _class(module, name), []
        for values in zip(*(self._column(*column) for column in coded), strict=True):
            value = object.__new__(found)
            vars(value).update(zip(names, values, strict=True))
            made.append(value)
        return made

    def _instance(self, index: int, module: str, name: str, state: Json) -> None:
        found = _class(module, name)
        made: Any = object.__new__(found)
        self._made[index] = made
        content = self.get(state)
        if hasattr(found, "__setstate__"):
            made.__setstate__(content)
        else:
            for key, value in content.items():
                object.__setattr__(made, key, value)

    def _column(self, kind: str, place: int) -> list[Any]:
        values = self._array(place)
        if kind == "ndarray":
            return [row.copy() for row in values]
        return list(values) if kind == "float64" else values.tolist()

    def _view(self, base: Json, dtype: str, offset: int, shape: list[int], strides: list[int]) -> NDArray[Any]:
        return np.ndarray(tuple(shape), _dtype(dtype), self.get(base), offset, tuple(strides))

    def _array(self, place: int) -> NDArray[Any]:
        dtype, shape, order, offset = self._arrays[place]
        count = math.prod(shape)
        flat = np.frombuffer(self._blob, _dtype(dtype), count, offset) if count else np.empty(0, _dtype(dtype))
        return flat.copy().reshape(shape, order=order)


def _class(module: str, name: str) -> type[Any]:
    """One of our modules, loaded already, and defined there: an imported name would be a class of another module."""
    found: Any = sys.modules.get(module) if module.startswith(PACKAGES) else None
    for part in name.split("."):
        found = getattr(found, part, None)
    if not isinstance(found, type) or found.__module__ != module:
        raise CheckpointError(f"it holds a {module}.{name}, which this version does not have")
    return found


def _dtype(name: str) -> np.dtype[Any]:
    dtype = np.dtype(name)
    if dtype.kind not in KINDS:
        raise ValueError(f"arrays of {name} are not written")
    return dtype
