"""Is a robot still the one its model was fitted to? Short probes, what changed, and how sure."""
