"""Models kept up to date: schedules, stages of a re-identification, runs of a whole fleet."""
