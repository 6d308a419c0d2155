"""For colcon, which runs it; what is built stands in pyproject.toml."""

from setuptools import setup

setup()
