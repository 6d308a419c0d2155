"""Parametrized tests of which `make test` runs some cases, and `make test-all` each."""

from collections.abc import Iterable, Sequence
from typing import Any

import pytest


def cases(
    values: Iterable[Any], usual: Sequence[str], ids: Iterable[str] | None = None, others: pytest.MarkDecorator = pytest.mark.extended
) -> list[Any]:
    """``values`` as parameters; those whose id is not among ``usual`` have the mark ``others``. An id that no value has is an error."""
    values = list(values)
    names = list(ids) if ids is not None else [str(v[0] if isinstance(v, tuple) else v) for v in values]
    missing = set(usual) - set(names)
    assert not missing, f"no case is named {missing}"
    return [
        pytest.param(*(v if isinstance(v, tuple) else (v,)), id=name, marks=[] if name in usual else [others])
        for v, name in zip(values, names, strict=True)
    ]
