"""What tests of the laboratory share with those of the package."""

from tiny import tiny  # noqa: F401
