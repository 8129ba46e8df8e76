"""Plug-ins of a laboratory, written by the how-to pages alone."""
