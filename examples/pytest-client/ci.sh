#!/usr/bin/env bash
# What this project's CI does, in whatever virtual environment is active.
# hil is in no package index: its wheel, or `-e` its checkout, has to be there already.
set -euo pipefail
cd "$(dirname "$0")"
python -m pip install --quiet --disable-pip-version-check ".[test]"
python -m pytest -v "$@"
