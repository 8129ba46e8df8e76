"""Rigid-body identification in coordinates whose every point is an arm that can exist."""
