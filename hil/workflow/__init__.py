"""From a spec to a judged model: run → fit → evaluate → report."""
