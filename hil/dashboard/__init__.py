"""The dashboard: stations, live runs, catalogue, models and schedules in a browser (extra `web`).

Every page is a view of the disk; what a person asks of a run goes the way `hil stop` goes.
"""
