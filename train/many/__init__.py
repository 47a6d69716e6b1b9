"""Training of many networks of one kind as one job: the members of a sweep, or the seeds of a run."""
