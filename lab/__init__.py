"""The laboratory: what measures the method, in a clone of the repository.

Many trainings side by side, each in a process of its own, and what comes out of them; scenes that
are made harder step by step; what a public benchmark reads. `univoxel lab` and the scripts in
benchmarks/ import it. It is not part of the installed package, of which only that command knows it.
"""
