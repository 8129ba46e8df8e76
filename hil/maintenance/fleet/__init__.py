"""Many robots of one station: runs in parallel, fits wherever there are workers, one report."""
