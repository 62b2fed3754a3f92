"""What everything stands on: errors, files, records of tensors, checks, the machine."""
