"""The live viewer: a run in a browser, path traced during interaction."""
