"""Puts models/ into the package: the registry, and what else lies there, as ``prism_edge/models``.

Everything else is in pyproject.toml, which can't say this beside finding the packages by itself.
"""

from setuptools import find_namespace_packages, setup

setup(
    packages=[*find_namespace_packages(include=["prism_edge", "prism_edge.*"]), "prism_edge.models"],
    package_dir={"prism_edge.models": "models"},
)
