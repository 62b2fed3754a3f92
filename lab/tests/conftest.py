"""What tests of the experiments share with those of the package."""

from tiny import tiny  # noqa: F401
