"""What every package stands on: errors, plug-ins, files, locks, YAML with positions, units."""
