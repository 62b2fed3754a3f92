"""Where the method breaks: scenes of known truth, made harder along one axis at a time."""
