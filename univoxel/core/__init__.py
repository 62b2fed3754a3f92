"""What everything stands on: errors, files, records of tensors, checks, the machine."""

import logging

log: logging.Logger = logging.getLogger("univoxel")  # of the whole package
