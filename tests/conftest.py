"""Settings of all tests."""

import os

from hypothesis import settings
from matplotlib.figure import Figure

# The same examples in every run, so that a failure is a change's and not the day's; HYPOTHESIS_EXPLORE=1 looks for new ones.
settings.register_profile("reproducible", derandomize=True)
if not os.environ.get("HYPOTHESIS_EXPLORE"):
    settings.load_profile("reproducible")

_render = Figure.savefig
_EMPTY = {
    "svg": '<svg viewBox="0 0 1 1"></svg>',
    "png": bytes.fromhex(
        "89504e470d0a1a0a0000000d4948445200000001000000010802000000907753de0000000c49444154789c63f8ffff3f0005fe02fe0def46b80000000049454e44ae426082"
    ),
}
"""A picture of nothing, by format."""


def _render_nothing(figure, file, *, format, **_):  # matplotlib's name
    file.write(_EMPTY[format])


def pytest_runtest_setup(item):
    """Matplotlib writes pictures in tests with the mark ``rendered``; elsewhere figures are made and not written (0.3 s each)."""
    Figure.savefig = _render if item.get_closest_marker("rendered") else _render_nothing
