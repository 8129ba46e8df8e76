"""Runs found, exported and let go: a view of run directories that can always be made anew."""
