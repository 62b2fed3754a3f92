"""Processing of many scenes: jobs on one machine or a cluster, and their results."""
