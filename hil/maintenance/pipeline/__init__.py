"""Stages of a re-identification: each done once, gone on with after a crash."""
