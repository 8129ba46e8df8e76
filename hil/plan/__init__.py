"""From spec, station and excitation to an immutable plan."""
