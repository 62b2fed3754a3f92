"""Shared foundations: errors, files, records of tensors, checks, the machine."""

import logging

log: logging.Logger = logging.getLogger("univoxel")  # of the whole package
