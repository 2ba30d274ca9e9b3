"""A survey: many flights through all stages, planned once and run by a process pool, alone or under Prefect."""
