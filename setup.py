"""For colcon, which runs it; what is built stands in pyproject.toml."""

from setuptools import setup
from setuptools.dist import Distribution


class PlainDistribution(Distribution):
    """Its values are literals: colcon evaluates their representation, and that of a set of specifiers is none."""

    def parse_config_files(self, *arguments, **options):
        """As setuptools does, then the specifiers of `python_requires` as text."""
        super().parse_config_files(*arguments, **options)
        self.python_requires = self.metadata.python_requires = str(self.python_requires)


setup(distclass=PlainDistribution)
