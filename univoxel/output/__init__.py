"""Exports of a run: meshes, web pages, reports, animations."""
