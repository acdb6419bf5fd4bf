"""The name that `flcav.runs` had."""

from flcav.runs import __all__, __dir__, __getattr__  # noqa: F401 - names of earlier programs
