"""Rays to surfaces to colours, and light traced through the scene."""
